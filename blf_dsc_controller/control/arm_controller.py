# SPDX-License-Identifier: Apache-2.0
"""An arm under the guarded law in a loop of your own, without ROS."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from numbers import Real
from pathlib import Path
from types import NoneType, TracebackType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.bags.writer import BagWriter, TopicRecorder
from blf_dsc_controller.compiled.announcement import logged_compilation
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, load, locate
from blf_dsc_controller.configuration.rules import When
from blf_dsc_controller.control.guarded_loop import GuardedLoop
from blf_dsc_controller.control.outputs import Output
from blf_dsc_controller.errors import (
    ArgumentTypeError,
    BlfDscError,
    LoopEndedError,
    check_type,
)
from blf_dsc_controller.law.payload import DEVIATION, MASS, mass_interval
from blf_dsc_controller.messages.named_values import disturbance_names
from blf_dsc_controller.messages.tip_load import TAKEN_UP, TipLoad
from blf_dsc_controller.reference.retargeting import TrajectoryError
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryPoint
from blf_dsc_controller.run import FIRST_STAMP, LATEST
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.supervisor import Phase
from blf_dsc_controller.warnings.table import config_warnings, refuse

Vector = NDArray[np.float64]


class StateError(BlfDscError):
    """A joint state that no arm of this configuration can have."""


class Load(NamedTuple):
    """What the tip holds, with half the width of its 95 % interval; NaN while it is unknown."""

    mass: float  # kg
    interval: float  # kg


class Reference(NamedTuple):
    """Where the arm should be, how fast, and accelerated by how much: each (n,)."""

    q: Vector  # rad
    dq: Vector  # rad/s
    ddq: Vector  # rad/s^2


class ToolError(NamedTuple):
    """Error at the tool, with what the joint bounds keep it within at this posture.

    NaN without `barrier.tool_bound` and `barrier.tool_angle_bound`.
    """

    error: float  # m
    bound: float  # m
    angle: float  # rad
    angle_bound: float  # rad


class ArmController:
    """Joint states in, torques out: the law with learning, checks and safe stops.

    Use it as a context manager::

        with ArmController('my.yaml', record='my_bag') as controller:
            while running:
                torque = controller.update(stamp, q, dq, effort)
                if torque is not None:
                    robot.command(torque)

    It does what the node `blf_dsc_controller` does with each joint state, and computes
    the same bits.  `update` is called for every state, at the rate of `sample_time`; a
    state that fails to arrive is noticed with the next one.  A recorded bag is that of
    a run over ROS: `blf_dsc` reports, plots, replays and identifies from it.  If it
    cannot be written any further, as on a full disk, the loop goes on without it:
    `output_problem`.  Whether the arm was measured to be stable with its gains is
    logged at level INFO, since the arm may be simulated.

    Attributes:
        config: the configuration in force.
        joints: names of the n joints, in the order of all arrays.
    """

    @logged_compilation()
    def __init__(
        self,
        config: ControllerConfig | str | Path,
        *,
        record: str | Path | None = None,
        stamps: Literal['given', 'wall'] = 'given',
    ) -> None:
        """Compile the law of a configuration, file or preset, and take command.

        `record` is the folder of a bag, which must not exist.  Messages have the stamps
        that are given; with `wall`, as much later as the wall clock was at the first.

        Raises:
            ArgumentTypeError: `config`, `record` or `stamps` is none of these.
            ConfigurationError: with all problems of the file.
            StartError: no arm is stable with the gains.
            BagError: there is such a folder.
            OSError: the folder cannot be made.
        """
        check_type('record', record, (str, Path, NoneType), 'give a folder, or None')
        if stamps not in ('given', 'wall'):
            raise ArgumentTypeError(
                f'stamps: got {stamps!r}, but given or wall is needed'
            )
        check_type(
            'config',
            config,
            (ControllerConfig, str, Path),
            'give the name of a preset, a file, or the .controller of load_loop',
        )
        if not isinstance(config, ControllerConfig):
            config = load(locate(config), CONTROLLER, ControllerConfig)
        self.config = config
        self.joints = config.joints
        self._loop = GuardedLoop(config)
        refuse(config)
        self._recorder: TopicRecorder | None = None
        if record is not None:
            self._recorder = TopicRecorder(BagWriter(record, in_background=True))
            self._loop.outputs.add(self._recorder)
        self._is_on_wall = stamps == 'wall'
        self._shift: int | None = None  # ns, of the stamps
        self._logged_turns: set[str] = set()
        # stops so far, phase, and whether for a reason
        self._logged = (0, Phase.STARTING, False)
        self._is_closed = False
        self._loop.guard.starting.activate()
        for text in config_warnings(config, When.ROBOT):
            logging.getLogger(__name__).info(text)

    def __enter__(self) -> ArmController:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def update(
        self,
        stamp: float,
        q: ArrayLike,
        dq: ArrayLike,
        effort: ArrayLike | None = None,
        motors: ArrayLike | None = None,
        *,
        send: Callable[[Vector | None], None] | None = None,
    ) -> Vector | None:
        """Return the torques (n,) [N m] for a joint state; None: command nothing.

        Args:
            stamp: time of the state [s], on any clock that only goes forward.
            q: positions (n,) [rad], or [m] of prismatic joints.
            dq: velocities (n,) [rad/s].
            effort: torques (n,) [N m] over the last interval, as `robot.effort`
                describes them. They show whether commands reach the arm, and the load to
                the observer of `disturbance.observer_bandwidth`; all else is learned
                from the torques that were commanded.
            motors: positions and velocities (2, n) of the motors, where these have encoders
                and q is of the links. They are recorded for `blf_dsc identify`, which finds
                the stiffness of gears, and are not used.
            send: called with the torques as soon as they are known, before learning, weighing
                and recording, which take longer. Its errors are raised after these.

        Raises:
            StateError: an array has another shape, or the stamp is not finite.
            LoopEndedError: the controller is closed.
        """
        self._check_open()
        if not _is_time(stamp):
            raise StateError(
                f'stamp: got {stamp}, but a finite time in s is needed; 1 ns is 1e-9 s'
            )
        n = len(self.joints)
        values = self._measurement(q, dq, effort)
        of_motors = None
        if motors is not None:
            of_motors = self._checked('motors', motors, (2, n))
        nanoseconds = self._nanoseconds(stamp)
        torque = self._loop.guard.update(nanoseconds, values)
        answer = None if torque is None else np.array(torque)
        try:
            if send is not None:
                send(answer)
        finally:
            self._loop.guard.perceive()
            self._loop.write_state(nanoseconds, values, of_motors, torque)
            self._log_turns('the reference', self._loop.guard.reference.turned)
            self._log_reason()
        return answer

    def prepare(self, q: ArrayLike) -> None:
        """Plan the start of an arm that rests at positions q (n,) [rad].

        Call it before the first `update`, if the robot waits for a torque from its
        first state on: planning the approach takes several milliseconds.

        Raises:
            StateError: q has another shape.
            StartError: the law cannot take over there.
            MotionError: no approach from there keeps the limits.
            LoopEndedError: the controller is closed.
        """
        self._check_open()
        self._loop.guard.starting.prepare(self._checked('q', q))

    def _nanoseconds(self, stamp: float) -> int:
        """Return the stamp [ns].

        A clock from zero, which ROS takes for none, starts at 1 s.
        """
        nanoseconds = round(stamp * 1e9)
        if self._shift is None and self._is_on_wall:
            self._shift = time.time_ns() - nanoseconds
        elif self._shift is None:
            self._shift = 0 if nanoseconds > 0 else FIRST_STAMP - nanoseconds
        return nanoseconds + self._shift

    def _measurement(
        self, q: ArrayLike, dq: ArrayLike, effort: ArrayLike | None
    ) -> Vector:
        """Return [q, dq, effort] (3 n,); efforts are NaN where there are none."""
        values = np.empty((3, len(self.joints)))
        values[0] = self._checked('q', q)
        values[1] = self._checked('dq', dq)
        values[2] = math.nan if effort is None else self._checked('effort', effort)
        return values.reshape(-1)

    def _checked(
        self, name: str, values: ArrayLike, shape: tuple[int, ...] = ()
    ) -> Vector:
        """Return an array of a shape, by default (n,)."""
        needed = shape or (len(self.joints),)
        try:
            array = np.asarray(values, dtype=np.float64)
            got = f'an array of shape {array.shape}'
        except (TypeError, ValueError, OverflowError):
            array, got = np.empty(0), 'what is no array of numbers'
        if array.shape != needed:
            raise StateError(
                f'{name}: got {got}, but {needed} is needed: one value for each of '
                f'{", ".join(self.joints)}'
            )
        return array

    def follow(
        self,
        points: Sequence[Sequence[Any]],
        joints: Sequence[str] = (),
        begin: float | None = None,
    ) -> None:
        """Follow a trajectory.

        Each point is a `TrajectoryPoint`, or likewise its time [s], positions [rad], and perhaps
        velocities [rad/s] and accelerations [rad/s^2], in the order of `joints`, by default the
        arm's.

        It begins at once, or at the time `begin` [s] since the start.

        Raises:
            ArgumentTypeError: the points are no sequence.
            TrajectoryError: with the reasons why it cannot be followed; the reference
                stays.
            LoopEndedError: the controller is closed.
        """
        self._check_open()
        check_type('points', points, Sequence, 'give a list of points')
        names = tuple(joints) or self.joints
        try:
            given = tuple(_point(*point) for point in points)
        except (TypeError, ValueError) as error:
            expected = 'each point is a time and positions, as in (1.0, [0.1, 0.2])'
            raise TrajectoryError([f'{error}; {expected}']) from error
        if not isinstance(begin, (Real, NoneType)):
            raise TrajectoryError([f'begin: got {begin!r}, but a time in s is needed'])
        trajectory = Trajectory(names, given, begin)
        guard = self._loop.guard
        plan = guard.motions.plan(trajectory)
        guard.motions.adopt(plan)
        self._log_turns('a motion', plan.motion.turned)

    def _log_turns(self, what: str, turned: str) -> None:
        """Log once that the reference or a motion is shifted by whole turns."""
        if turned and what not in self._logged_turns:
            self._logged_turns.add(what)
            logging.getLogger(__name__).warning('%s %s', what, turned)

    def _log_reason(self) -> None:
        """Log why it stops or does not start, once: numbers in it may change at each state."""
        reason = self.reason
        now = self._loop.guard.supervisor.stops, self.phase, bool(reason)
        if now != self._logged:
            self._logged = now
            if reason:
                logging.getLogger(__name__).warning('%s: %s', self.phase, reason)

    def load_to_tell(self) -> TipLoad | None:
        """Return the load to declare to the drives next, a step at a time.

        None: there is none, or `load.tell_drive` is false.
        """
        return self._loop.guard.load_to_tell()

    def take_over(self, load: TipLoad) -> None:
        """Subtract the weight of a load that the drives add from the next state on.

        Raises:
            BlfDscError: the drives add no weight.
        """
        self._loop.guard.take_over(load)

    def expect_load(
        self,
        mass: float = 0.0,
        centre: Sequence[float] = (0.0, 0.0, 0.0),
        interval: float = TAKEN_UP,
        *,
        remember: bool = False,
    ) -> None:
        """Say what the tip takes up now, as when a gripper closes, or that it holds nothing.

        The law carries it at once, instead of finding it by the error that it causes.  What is
        said is the mean of the prior: learning corrects it.

        Args:
            mass: what the tip will hold besides what it held at the start [kg].
            centre: of this mass, in the frame of `robot.tip` [m].
            interval: time in which the tip takes it up [s].
            remember: the load that the law has weighed last, instead of `mass` and `centre`.

        Raises:
            BlfDscError: this arm cannot hold that, the law is not in command, or none has been
                weighed.
        """
        self._check_open()
        load = None if remember else TipLoad.given(mass, centre)
        self._loop.guard.expect_load(load, interval)

    def tare(self) -> None:
        """Take the external torque for zero where the arm rests now.

        What an insertion needs: the wrench is then relative to this moment, with a narrower
        interval as long as the arm stays near.  It is forgotten when the arm is found to have
        changed, as by a load that it grips, and at the next start.

        Raises:
            TareError: the arm moves or has just come to rest, something touches it, the law
                is not in command, or `contact.enabled` is false.
        """
        self._loop.guard.findings.tare()

    @property
    def is_tared(self) -> bool:
        """Whether a tare is in force."""
        return self._loop.guard.controller.is_tared

    @property
    def is_at_rest(self) -> bool:
        """Whether the reference and the arm rest."""
        return self._loop.guard.is_at_rest

    def stop(self) -> None:
        """Ramp to the safe torque, which `update` then returns until `start`."""
        self._loop.guard.deactivate()

    def start(self) -> None:
        """Take command with the next state, with what was learned.

        Raises:
            LoopEndedError: the controller is closed.
        """
        self._check_open()
        self._loop.guard.starting.activate()

    def reset(self) -> None:
        """Forget what was learned, and any fault; take command with the next state.

        Raises:
            LoopEndedError: the controller is closed.
        """
        self._check_open()
        self._loop.guard.starting.reset()

    def fail(self, text: str) -> Vector | None:
        """Stop for a reason `text` of your own.

        Return the next torque (n,) [N m] of the ramp to the safe torque; None: nothing
        has been commanded yet, so command nothing.
        """
        torque = self._loop.guard.fail(text)
        self._loop.write_end(torque)
        return None if torque is None else np.array(torque)

    def withdraw(self, text: str) -> None:
        """Command nothing until `reset` or `start`, because of `text`.

        Use it when another program takes command of the arm.
        """
        self._loop.guard.withdraw(text)

    @property
    def is_settled(self) -> bool:
        """Whether the law is not in command, and the arm is at rest.

        The arm rests under the safe torque, or it has never been commanded.
        """
        guard = self._loop.guard
        if guard.commanding:
            return guard.is_settled
        return not guard.supervisor.running

    @property
    def missed(self) -> int:
        """Number of states missing since the start, by the stamps of the others."""
        return self._loop.guard.states.missed

    @property
    def phase(self) -> Phase:
        """What the controller does, such as `Phase.TRACKING` or `Phase.SAFE_STOP`."""
        return self._loop.guard.supervisor.phase

    @property
    def reason(self) -> str:
        """Why the controller stopped or does not start; empty while all is well."""
        guard = self._loop.guard
        return guard.supervisor.text or guard.starting.waiting_for

    @property
    def reference(self) -> Reference:
        """Reference q_r, dq_r, ddq_r of the last sample; NaN before the first of a start."""
        law = self._loop.guard.controller
        now = law.signals.qr, law.signals.dqr, law.signals.ddqr
        if not law.samples:
            return Reference(*np.full((3, len(self.joints)), math.nan))
        return Reference(*np.array(now))

    @property
    def error(self) -> Vector:
        """Tracking error (n,) [rad] of the last sample."""
        return np.array(self._loop.guard.controller.sample.xi1)

    @property
    def bound(self) -> Vector:
        """Bound (n,) [rad] on the error at the last sample."""
        return np.array(self._loop.guard.controller.sample.bound)

    @property
    def tool(self) -> ToolError:
        """Error at the tool at the last sample."""
        errors = self._loop.guard.samples.tool_errors
        unknown = (math.nan,) * 4
        return ToolError(*(unknown if errors is None else errors.tolist()))

    @property
    def disturbance(self) -> dict[str, float]:
        """Torque that the model does not explain [N m], by its name."""
        values = self._loop.guard.controller.sample.disturbance
        names = disturbance_names(self.joints)
        return dict(zip(names, values.tolist(), strict=True))

    @property
    def estimates(self) -> dict[str, float]:
        """Learned parameters and friction by their names; NaN where a column was rejected."""
        values = self._loop.guard.controller.sample.estimate
        return dict(zip(self._loop.estimates, values.tolist(), strict=True))

    @property
    def load(self) -> Load:
        """What the tip has picked up since the first window, by weighing."""
        values = self._loop.guard.controller.state.payload.load
        if values[DEVIATION] <= 0.0:
            return Load(math.nan, math.nan)
        return Load(float(values[MASS]), mass_interval(values))

    def close(self) -> Vector | None:
        """Return the torque (n,) [N m] that a drive may hold from now on.

        End the recording; `output_problem` says whether it is whole.  What was found can still
        be read, but the arm is commanded no more: that takes another `ArmController`.
        """
        self._is_closed = True
        torque = self._loop.guard.release()
        self._loop.write_end(torque)
        if self._recorder is not None:
            self._loop.outputs.end(self._recorder, self._recorder.close)
            self._recorder = None
        return None if torque is None else np.array(torque)

    def _check_open(self) -> None:
        if self._is_closed:
            raise LoopEndedError(
                'this ArmController is closed, as at the end of its with block: make another one'
            )

    def add_output(self, output: Output) -> None:
        """Give all messages from now on to an output, too: those that a bag has.

        One that raises an error is dropped, and the loop goes on: `output_problem`.
        """
        self._loop.outputs.add(output)

    @property
    def output_problem(self) -> str:
        """Why the recording or another output ended before the loop; or empty."""
        return self._loop.outputs.problem

    @property
    def guard(self) -> Guard:
        """The law between its checks, for shells such as `blf_dsc drive`."""
        return self._loop.guard

    @property
    def loop(self) -> GuardedLoop:
        """The law with its telemetry, for a node that answers joint states by it."""
        return self._loop


def _is_time(stamp: float) -> bool:
    """Whether a stamp is a time [s] that ROS knows, in whole ns; it may be anything."""
    try:
        return math.isfinite(stamp) and abs(stamp) < LATEST
    except (TypeError, OverflowError):
        return False


def _point(time: float, *values: Any) -> TrajectoryPoint:
    """Return a point whose fields may be arrays; TypeError or ValueError if it is none."""
    fields = (tuple(np.asarray(each, float).tolist()) for each in values)
    return TrajectoryPoint(float(time), *fields)
