# SPDX-License-Identifier: Apache-2.0
"""The controller with its guard on the joint states of a bag: starts, stops, ramps and all.

This is the very guard that the node runs, given the states that the node was given.  While the law
is in command these are the ones that the controller tells of, for in real time it passes over what
it has no time for.  While it is not, it tells of none; they are then all taken to have come, which
is so in lock-step, and elsewhere if the commands match.  The clocks stand still: what the watch on
the steady clock does is not replayed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.messages.topics import FOREVER, TRACKING_ERROR
from blf_dsc_controller.reference.trajectory import TrajectoryError
from blf_dsc_controller.replay.comparison import Commands, Difference
from blf_dsc_controller.replay.history import (
    OUT_OF_ORDER,
    SILENT,
    UNREADABLE,
    Event,
    History,
    Order,
    Stop,
)
from blf_dsc_controller.replay.law import Replayed
from blf_dsc_controller.replay.log import Log
from blf_dsc_controller.replay.states import Arrivals, States
from blf_dsc_controller.run import Stamps
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.reasons import Phase


@dataclass(frozen=True)
class Rerun:
    """What the controller did.

    Attributes:
        states: that the law answered.
        replayed: what it told of them.
        monitored: messages of the monitor, by the number of their state.
        commands: every torque.
        done: what was done to it, and its stops, as far as the replay came.
        departure: where it did otherwise than the bag tells, so that the replay ends; or None.
        end: why else the replay ended before the bag did, in words; empty if it did not.
    """

    states: States
    replayed: Replayed
    monitored: dict[int, bytes]
    commands: Commands
    done: tuple[Event, ...]
    departure: Difference | None
    end: str


def rerun(
    config: ControllerConfig,
    came: Arrivals,
    told: Stamps | None,
    history: History,
    *,
    in_step: bool,
) -> Rerun:
    """Run the guarded controller over joint states.

    Args:
        config: in force at first.
        came: joint states.
        told: stamps of those that the law answered [ns], in order; None if the bag does not tell.
        history: what was done to the controller, and its stops.
        in_step: whether the plant waited for each command.
    """
    return _Run(config, came, told, history, in_step=in_step).go()


class _Run:
    def __init__(
        self,
        config: ControllerConfig,
        came: Arrivals,
        told: Stamps | None,
        history: History,
        *,
        in_step: bool,
    ) -> None:
        self._in_step = in_step
        self._config = config
        self._came = came
        self._told = None if told is None else frozenset(told.tolist())
        self._queue = deque(history.events)
        self._guard = Guard(config, _no_time, _no_time)
        self._log = Log(config, self._guard, len(came.stamp))
        self._known: int | None = None
        self._doubt = ''
        self._done: list[Event] = []
        self._passed_over = 0
        self._first = next((one for k, one in enumerate(came.stamp) if k not in came.errors), 0)
        absent = np.setdiff1d([] if told is None else told, came.stamp)
        self._lost = int(absent[0]) if absent.size else None
        self._lost_from = FOREVER if self._lost is None else self._lost
        self._departure: Difference | None = None
        self._end = history.end

    def go(self) -> Rerun:
        end = self._end
        self._end = ''
        while self._queue and self._is_before(self._queue[0]):
            self._take(self._queue.popleft())
        for k, stamp in enumerate(self._came.stamp):
            self._pass_on(k, stamp)
            if self._queue:
                self._catch_up(k, stamp)
            if self._end or self._departure:
                break
        else:
            self._end = end
            self._look_for_what_is_missing()
        return self._result()

    # One joint state.

    def _pass_on(self, k: int, stamp: int) -> None:
        guard = self._guard
        if k in self._came.errors:
            if self._is_out_of_command() or self._is_stop_by_message():
                self._log.commanded(guard.last_seen, guard.unusable(self._came.errors[k]))
            return
        if self._is_out_of_command():
            self._log.commanded(stamp, guard.answer(stamp, self._came.measurement[k]))
        elif self._told is None or (stamp in self._told and stamp != self._log.last):
            self._answer(k, stamp)
        elif self._is_stop_by(stamp):
            self._log.commanded(stamp, guard.answer(stamp, self._came.measurement[k]))
        else:
            self._passed_over += 1

    def _answer(self, k: int, stamp: int) -> None:
        if (
            self._told is not None
            and (self._queue or not self._log.last < stamp <= self._lost_from)
            and self._is_obstructed(stamp)
        ):
            return
        guard = self._guard
        torque = guard.answer(stamp, self._came.measurement[k])
        if torque is not None and guard.answered:
            self._log.answered(k, stamp, torque)
            return
        self._log.commanded(stamp, torque)
        # A state that led to a stop may come once more, after a reset, and be answered then.
        if self._told is not None and not self._is_stop_by(stamp):
            self._departure = self._difference(f'answered ({guard.supervisor.text})', stamp)

    def _is_obstructed(self, stamp: int) -> bool:
        """Whether something is in the way of the law's answer that the bag tells of."""
        head = self._queue[0] if self._queue else None
        if stamp <= self._log.last:
            self._end = f'the stamps begin again with {stamp} ns'
        elif stamp > self._lost_from:
            self._end = f'the state of stamp {self._lost} ns was answered but is not in the bag'
        elif isinstance(head, Stop) and head.reason in OUT_OF_ORDER:
            return False
        elif head is not None and head.after < stamp:
            if isinstance(head, Stop) and head.after in self._came.stamp:
                self._departure = self._difference(f'stop: {head.reason.value}', head.after)
            else:
                self._end = f'the state of stamp {head.after} ns came but is not in the bag'
        else:
            return False
        return True

    # What was done.

    def _is_out_of_command(self) -> bool:
        phase = self._guard.supervisor.phase
        return phase is Phase.SAFE_STOP or phase is Phase.INACTIVE

    def _is_stop_by(self, stamp: int) -> bool:
        head = self._queue[0] if self._queue else None
        return isinstance(head, Stop) and head.after == stamp

    def _is_stop_by_message(self) -> bool:
        head = self._queue[0] if self._queue else None
        if not isinstance(head, Stop) or head.reason not in UNREADABLE:
            return False
        return head.after == self._guard.last_seen

    def _catch_up(self, k: int, stamp: int) -> None:
        """Take what follows this state."""
        if k in self._came.errors:
            stamp = self._guard.last_seen
        while self._queue and self._queue[0].after == stamp and self._departure is None:
            head = self._queue[0]
            if k + 1 in self._came.errors and self._came.received[k + 1] < head.told:
                return  # that message has no stamp to tell whether it came before, but came first
            if isinstance(head, Stop) and head.reason not in SILENT:
                if self._guard.supervisor.phase is not Phase.SAFE_STOP:
                    return  # the next message of this stamp may be what leads to it
                if self._guard.supervisor.reason is not head.reason:
                    self._departure = self._difference(f'stop: {head.reason.value}', stamp)
            self._take(self._queue.popleft())

    def _take(self, event: Event) -> None:
        guard = self._guard
        self._done.append(event)
        if isinstance(event, Order):
            try:
                event.act(guard)
            except TrajectoryError as error:
                self._departure = self._difference(f'trajectory accepted ({error})', event.after)
        elif event.reason in SILENT:
            guard.supervisor.stop(event.reason, 'as recorded')
            self._known = self._log.torques if self._known is None else self._known
            self._doubt = f'the stop is due to no state: {event.reason.value}'

    def _is_before(self, event: Event) -> bool:
        return isinstance(event, Order) and event.after < self._first

    def _look_for_what_is_missing(self) -> None:
        """Find what the bag tells of and the replay did not come to."""
        head = self._queue[0] if self._queue else None
        answered = {self._came.stamp[k] for k in self._log.numbers}
        missing = (one for one in self._came.stamp if one in (self._told or ()))
        first = next((one for one in missing if one not in answered), None)
        if isinstance(head, Stop) and head.after in self._came.stamp:
            self._departure = self._difference(f'stop: {head.reason.value}', head.after)
        elif first is not None:
            self._departure = self._difference('answered', first)

    def _difference(self, what: str, stamp: int) -> Difference:
        time = (stamp - self._first) * 1e-9
        return Difference(TRACKING_ERROR.resolved, what, stamp, time, 1.0, 0.0)

    def _result(self) -> Rerun:
        log = self._log
        stamps = np.array(self._came.stamp, dtype=np.int64)[log.numbers]
        measurement = self._came.measurement[log.numbers]
        moments, torque, of_law = log.commands()
        known = len(moments) if self._known is None else self._known
        doubt = self._doubt or self._end or ('the replay ends there' if self._departure else '')
        return Rerun(
            States(stamps, measurement, self._passed_over, self._lost),
            log.replayed(),
            log.monitored,
            Commands(moments, torque, of_law, known, doubt, self._in_step),
            tuple(self._done),
            self._departure,
            self._end,
        )


def _no_time() -> int:
    return 0
