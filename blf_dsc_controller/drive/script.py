# SPDX-License-Identifier: Apache-2.0
"""A script beside the loop: its motions, its stops, its end; samples for it.

When the script ends, in whatever way, the reference brakes and the loop ends at rest.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.control.goal_messages import (
    Answer,
    End,
    Goal,
    Message,
    Outcome,
)
from blf_dsc_controller.control.goals import Goals
from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.control.slow_move import duration_of
from blf_dsc_controller.drive.beside import Beside
from blf_dsc_controller.drive.loop import DriveLoop
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.contact import is_touched
from blf_dsc_controller.messages import script_link, topic_link
from blf_dsc_controller.messages.link import Link
from blf_dsc_controller.messages.script_link import ArmState, encode_sample
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryPoint
from blf_dsc_controller.reference.turns import short_way
from blf_dsc_controller.run import TURNING

_PERIOD = 0.005  # s of the robot's time between two samples
_SHORTEST = 0.1  # s, of a move
_SOURCE = 'the script'
_TURN = 2.0 * math.pi  # rad
_BEYOND = 2.0  # times what a joint reaches, and at least turns: no target

Condition = Callable[[], bool]
"""Whether a request is done; raises BlfDscError if it cannot be."""


class Script(Beside):
    """What a script wants of the loop, and is told of it."""

    def __init__(
        self,
        link: Link,
        controller: ArmController,
        inputs: MotionInput | None = None,
    ) -> None:
        """Take the commands that come over a link of the parent process."""
        super().__init__(link, controller, inputs)
        self._controller = controller
        self._goals = Goals(self._inputs, controller.joints, self._tell_goal, self.log)
        self._parent = os.getppid()
        self._told = -math.inf  # s, time of the last sample that was sent
        self._orders: dict[int, Callable[[Any], Condition | None]] = {
            script_link.BRAKE: self._brake,
            script_link.TARE: self._tare,
            script_link.EXPECT: self._expect,
            script_link.LOAD: self._declare,
        }
        self._waiting: dict[int, Condition] = {}  # by the number of the request
        self._loop: DriveLoop | None = None
        self._asked = 0  # to close, by a signal
        self._closes = 0
        self._rests_at = math.nan  # s, when the loop may end
        self._tells_running = False
        self._has_told_problem = False  # of the last target of a stream

    def begin(self, loop: DriveLoop) -> None:
        """Begin a loop."""
        self._loop = loop
        self._tells_running = True
        self._told = -math.inf
        self._waiting.clear()

    @property
    def is_over(self) -> bool:
        """Whether the script wants nothing more, or has ended."""
        return self._closes > 0 or self._asked > 0 or self._is_alone

    @property
    def _is_alone(self) -> bool:
        return self._link.broken or os.getppid() != self._parent

    def request_close(self) -> None:
        """Close after the next torque; the second time end at once; for signals."""
        self._asked += 1
        if self._asked > 1:
            self._end_at_once()

    def follow(self) -> None:
        """Do what the script wants; end with it."""
        super().follow()
        if (self._is_alone or self._asked) and not self._closes:
            self._close()
        if self._guard.reference.time >= self._rests_at:
            self._rests_at = math.nan
            self._end_loop()

    def _close(self) -> None:
        """Brake, then end at rest; the second time end at once."""
        self._closes += 1
        if self._closes > 1:
            self._end_at_once()
        elif not self._guard.supervisor.running:
            self._end_loop()
        else:
            self._rests_at = self._inputs.stop(self._guard, 'the end of the script')

    def _end_at_once(self) -> None:
        self._end_loop()
        self._end_loop()  # a second request ends at once

    def _end_loop(self) -> None:
        if self._loop is not None:
            self._loop.request_end()

    def _take(self, kind: int, content: bytes) -> None:
        if kind == script_link.POSITIONS:
            self._stream(np.frombuffer(content))
        elif kind == script_link.CLOSE:
            self._close()
        else:
            self._take_request(kind, *script_link.request_in(content))

    def _take_request(self, kind: int, number: int, content: bytes) -> None:
        """Begin what a request asks for."""
        if kind == script_link.FOLLOW:
            shift = self._guard.reference.time - time.time()
            self._begin_goal(number, lambda: _trajectory(content, shift))
            return
        wanted = topic_link.decode(content)
        if kind == script_link.MOVE:
            trajectory = self._move(wanted)
            self._begin_goal(number, lambda: trajectory)
            return
        try:
            condition = self._orders[kind](wanted)
        except BlfDscError as error:
            self._tell_done(number, str(error))
            return
        if condition is None:
            self._tell_done(number)
        else:
            self._waiting[number] = condition

    def _stream(self, positions: np.ndarray) -> None:
        """Follow positions (n,) [rad], unless they cannot be meant; say so once."""
        problem = _far_beyond(positions, self._guard.config)
        if not problem:
            self._inputs.stream(self._guard, positions, _SOURCE)
        elif not self._has_told_problem:
            self.log.warning(problem)
        self._has_told_problem = bool(problem)

    def _begin_goal(self, number: int, make: Callable[[], Trajectory]) -> None:
        goal = Goal(number, b'', (), (), 0.0)
        self._goals.follow(self._guard, goal, make, _SOURCE)

    def _move(self, wanted: dict[str, Any]) -> Trajectory:
        """Return the way from the present reference to rest at some positions."""
        guard, config = self._guard, self._guard.config
        here = guard.controller.reference_at(guard.reference.time)[0]
        (there,), _ = short_way(np.array([wanted['positions']]), here, config)
        limits = config.limits.velocity, config.limits.acceleration
        speed, acceleration = wanted['speed'] * np.array(limits)
        duration = duration_of(np.abs(there - here), speed, acceleration)
        points = (TrajectoryPoint(max(_SHORTEST, duration), tuple(there.tolist())),)
        return Trajectory(config.joints, points)

    def _brake(self, _: None) -> Condition:
        end = self._inputs.stop(self._guard, 'stop()')
        return lambda: self._guard.reference.time >= end

    def _tare(self, _: None) -> None:
        self._guard.findings.tare()

    def _expect(self, wanted: dict[str, Any]) -> None:
        load = None if wanted['remember'] else _load(wanted)
        self._guard.expect_load(load, wanted['interval'])

    def _declare(self, wanted: dict[str, Any]) -> Condition:
        self._guard.loads.declare(_load(wanted))
        return self._is_declared

    def _is_declared(self) -> bool:
        """Whether the drives have a load; BlfDscError says why they are told none any more."""
        if self._loop is not None and self._loop.remark:
            raise BlfDscError(self._loop.remark)
        return self._guard.loads.is_declared

    def _follow_waiting(self) -> None:
        """Tell which requests are done by now, or cannot be."""
        for number, condition in [*self._waiting.items()]:
            problem = ''
            try:
                if not condition():
                    continue
            except BlfDscError as error:
                problem = str(error)
            del self._waiting[number]
            self._tell_done(number, problem)

    def _tell_changes(self) -> None:
        guard = self._guard
        self._goals.watch(guard)
        self._follow_waiting()
        if not guard.has_sample:
            return
        if self._tells_running:
            self._tells_running = False
            self.tell(script_link.RUNNING, list(self._controller.joints))
        # An old state is worth nothing: send none before the last one is taken.
        if guard.reference.time - self._told >= _PERIOD and self._link.flush():
            self._tell_sample()

    def _tell_sample(self) -> None:
        if self._guard.has_sample:
            self._told = self._guard.reference.time
            self._link.put(script_link.SAMPLE, encode_sample(self._state()))

    def _state(self) -> ArmState:
        guard, controller = self._guard, self._guard.controller
        signals, sample = controller.signals, controller.sample
        load = self._controller.load
        senses = guard.config.contact.enabled
        return ArmState(
            guard.reference.time,
            str(guard.supervisor.phase),
            signals.q,
            signals.dq,
            controller.state.torque,
            signals.qr,
            sample.xi1,
            sample.bound,
            sample.external if senses else np.full_like(signals.q, math.nan),
            load.mass,
            load.interval,
            senses and is_touched(controller.state.contact),
        )

    def tell(self, kind: int, content: Any) -> None:
        """Tell the script something."""
        self._link.put(kind, topic_link.encode(content))

    def _tell_done(self, number: int, problem: str = '') -> None:
        self._tell_sample()  # that of the end
        self.tell(script_link.DONE, {'number': number, 'problem': problem})

    def _tell_goal(self, message: Message) -> None:
        if isinstance(message, Answer) and not message.accepted:
            self._tell_done(message.number, message.reason)
        elif isinstance(message, End) and self._guard.supervisor.running:
            # else the loop ends, and says why
            succeeded = message.outcome == Outcome.SUCCEEDED
            self._tell_done(message.number, '' if succeeded else message.text)


def _load(wanted: dict[str, Any]) -> TipLoad:
    return TipLoad(wanted['mass'], tuple(wanted['centre']))


def _far_beyond(positions: np.ndarray, config: ControllerConfig) -> str:
    """Return why positions (n,) [rad] are no target of a stream, such as degrees; or empty.

    Others beyond the limits are a target, on the way to which the reference brakes.
    """
    lower, upper = config.limits.position_lower, config.limits.position_upper
    reach = np.maximum(np.negative(lower), upper)
    beyond = np.flatnonzero(np.abs(positions) > _BEYOND * np.maximum(reach, _TURN))
    if not beyond.size:
        return ''
    k = int(beyond[0])
    units = config.units[k]
    remedy = 'degrees, give np.deg2rad of them' if units == TURNING else 'mm, give m'
    return (
        f'stream: {config.joints[k]} is to be at {positions[k]:.4g} {units.position}, and its '
        f'limits are {lower[k]:g} to {upper[k]:g}: not followed. If these are {remedy}'
    )


def _trajectory(content: bytes, shift: float) -> Trajectory:
    """Return the trajectory of a request; `shift` [s] turns wall time into time since the start."""
    wanted = topic_link.decode(content)
    begin = None if wanted['begin'] is None else wanted['begin'] + shift
    points = tuple(TrajectoryPoint(*map(_field, each)) for each in wanted['points'])
    return Trajectory(tuple(wanted['joints']), points, begin)


def _field(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
