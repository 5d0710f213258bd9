# SPDX-License-Identifier: Apache-2.0
"""An arm under the guarded law, commanded from a script: the loop is in its own process.

The script may be slow, stop, crash or be killed: the loop keeps its rate, and then
brakes the arm.
"""

from __future__ import annotations

import functools
import weakref
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from blf_dsc_controller.drive.arguments import (
    checked_begin,
    checked_config,
    checked_interval,
    checked_joints,
    checked_load,
    checked_overrides,
    checked_positions,
    checked_record,
    checked_robot,
    checked_speed,
    checked_timeout,
    hint_at_degrees,
)
from blf_dsc_controller.drive.loop_process import LoopProcess
from blf_dsc_controller.errors import (
    DriveError,
    LoopEndedError,
    MotionFailedError,
    NotInTimeError,
)
from blf_dsc_controller.extras import import_extra
from blf_dsc_controller.messages import script_link
from blf_dsc_controller.messages.script_link import ArmState
from blf_dsc_controller.messages.tip_load import TAKEN_UP

if TYPE_CHECKING:
    from blf_dsc_controller.drive.pose import Pose, Poses


class Drive:
    """A robot, or a simulated arm, that does what a script says.

    Use it as a context manager::

        with blf.Drive('my.yaml', robot='172.16.0.2') as arm:
            arm.move_to([0.0, -0.7, 0.0, -2.2, 0.0, 1.6, 0.7])
            print(arm.state.q)

    It starts the loop of `blf_dsc drive` in a process of its own, and waits until the
    arm is held where it rests.  At the end of the block, or of the script, the arm is
    brought to rest, and the robot holds it by its own means.  Warnings and remarks of
    the loop go to the logger `blf_dsc_controller`.

    Several arms have a `Drive` each.  An exception in the block of one brakes them all.
    """

    _loops: ClassVar[weakref.WeakSet[LoopProcess]] = weakref.WeakSet()

    def __init__(
        self,
        config: str | Path,
        overrides: Mapping[str, Mapping[str, object]] | None = None,
        *,
        robot: str,
        record: str | Path | None = None,
    ) -> None:
        """Start the loop; the first time, kernels may be compiled for minutes.

        Args:
            config: parameter file, or a preset.
            overrides: values by node and dotted name, which take precedence over the file.
                The reference of the file is not followed: the arm holds.
            robot: its address, for the driver that the file names; or `simulated`, for the
                simulated arm of the file, no faster than real time.
            record: new folder for a bag.

        Raises:
            DriveError: file, robot or arm are not as they should be.
        """
        self._config = checked_config(config)
        self._overrides = checked_overrides(overrides)
        self._robot = checked_robot(robot)
        self._record = checked_record(record)
        self._starts = 0
        self._last: Future[str] | None = None  # result of the last motion
        self._hint = ''  # what its error ends with
        self._loop = self._start()

    def __setattr__(self, name: str, value: object) -> None:
        """Refuse what other packages have as settings: here it would change nothing."""
        if not name.startswith('_'):
            raise DriveError(
                f'{name}: a Drive has no such setting. The speed is given with each motion, as in '
                'move_to(q, speed=0.1), and limits in the parameter file, or in overrides'
            )
        super().__setattr__(name, value)

    def __enter__(self) -> Drive:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        ended = self.ended
        if kind is not None:
            for each in list(self._loops):
                each.brake()
        self.close()
        if kind is None and ended:
            raise LoopEndedError(ended)

    # Motions.

    def move_to(
        self,
        positions: ArrayLike,
        *,
        speed: float = 0.5,
        wait: bool = True,
        timeout: float | None = None,
    ) -> None:
        """Go straight to rest at positions (n,) [rad].

        Args:
            positions: of all joints; a continuous joint goes the short way.
            speed: share of `limits.velocity` and `limits.acceleration`, up to 1.
            wait: return once the arm is there; False: at once, see `wait`.
            timeout: longest time to wait [s], then the arm brakes.

        Raises:
            MotionFailedError: it leaves the limits, something else replaced it, or touched the arm.
            NotInTimeError: after `timeout`.
            LoopEndedError: the loop has ended.
        """
        values = checked_positions(positions, self.joints)
        wanted = {'positions': values.tolist(), 'speed': checked_speed(speed)}
        hint = hint_at_degrees(values)
        self._begin(script_link.MOVE, wanted, wait=wait, timeout=timeout, hint=hint)

    def follow(
        self,
        points: Sequence[Sequence[Any]],
        joints: Sequence[str] = (),
        *,
        begin: float | None = None,
        wait: bool = True,
        timeout: float | None = None,
    ) -> None:
        """Follow a trajectory from now on; it replaces a motion that is not over.

        Args:
            points: each a `TrajectoryPoint`, or likewise the time [s] from now, positions
                [rad], and perhaps velocities [rad/s] and accelerations [rad/s^2].
            joints: names, in the order of the values; by default the arm's.
            begin: when the times begin instead of now, on the wall clock (`time.time()`) [s], so
                that several arms move in step.
            wait, timeout: as for `move_to`.

        Raises:
            MotionFailedError, NotInTimeError, LoopEndedError: as for `move_to`.
        """
        try:
            given = [
                [float(time), *(_listed(each) for each in values)]
                for time, *values in points
            ]
        except (TypeError, ValueError) as error:
            raise DriveError(
                f'points: {error}; each must be a time and positions, as in (1.0, [0.1, 0.2])'
            ) from error
        if not given:
            raise DriveError('points: got none; stop() brakes the arm')
        if given[-1][0] == 0.0:
            raise DriveError(
                'points: the last one is at 0 s, but the arm needs time to be there: give times '
                'from now on, as in (1.0, [0.1, 0.2])'
            )
        wanted = {
            'points': given,
            'joints': checked_joints(joints) or list(self.joints),
            'begin': checked_begin(begin),
        }
        self._begin(script_link.FOLLOW, wanted, wait=wait, timeout=timeout)

    def move_to_pose(
        self,
        position: ArrayLike,
        rotation: ArrayLike | None = None,
        *,
        speed: float = 0.3,
        wait: bool = True,
        timeout: float | None = None,
    ) -> None:
        """Move the tip straight to rest at a pose, in the base frame.

        The way is solved by pink before the arm moves (an extra: `pose`).  The joints have
        only been checked against their limits: keep the line free.

        Args:
            position: (3,) [m], of `robot.tip`.
            rotation: (3, 3), its columns are the axes of the tip; by default it does not turn.
            speed: share of the limits of the joints, up to 1, roughly.
            wait, timeout: as for `move_to`.

        Raises:
            MotionFailedError: the line leaves the limits, or as for `move_to`.
            NotInTimeError, LoopEndedError: as for `move_to`.
            MissingExtraError: pink is not installed.
        """
        begin = np.array(self.state.reference)
        points = self._poses.line(begin, position, rotation, checked_speed(speed))
        self.follow(points, wait=wait, timeout=timeout)

    def stream(self, positions: ArrayLike) -> None:
        """Give the next positions (n,) [rad] of a stream, and return at once.

        Call it at a steady rate, such as 30 Hz.  The reference follows as far behind as it
        needs to brake, and comes to rest at the last target.  A target that cannot be
        followed is logged, and so is one far beyond the limits, such as degrees, which is
        not followed.

        Raises:
            LoopEndedError: the loop has ended.
            MissingExtraError: ruckig is not installed.
        """
        values = checked_positions(positions, self.joints)
        import_extra('ruckig', 'streams', 'a stream')
        self._loop.put(script_link.POSITIONS, values.tobytes())

    def wait(self, timeout: float | None = None) -> None:
        """Wait for the end of the last `move_to` or `follow` that did not.

        Raises:
            MotionFailedError, NotInTimeError, LoopEndedError: as for `move_to`.
        """
        if self._last is not None:
            self._await_motion(self._last, timeout)

    def stop(self, timeout: float | None = None) -> None:
        """Brake within the limits, and return once the reference rests; the arm holds.

        Raises:
            NotInTimeError, LoopEndedError: as for `move_to`.
        """
        self._ask(script_link.BRAKE, None, timeout)

    def load(
        self,
        mass: float,
        centre: Sequence[float] = (0.0, 0.0, 0.0),
        timeout: float | None = None,
    ) -> None:
        """Declare what the tip holds to the robot's drives; return once they add its weight.

        The law subtracts what they add, in small steps, so no joint torque changes.  For
        robots whose drives compensate gravity; the law itself needs no declaration.

        Args:
            mass: all that the URDF lacks [kg]; 0: nothing.
            centre: of this mass, in the frame of `robot.tip` [m].
            timeout: longest time to wait [s].

        Raises:
            MotionFailedError: these drives cannot be told, or refuse.
            NotInTimeError, LoopEndedError: as for `move_to`.
        """
        self._ask(script_link.LOAD, checked_load(mass, centre), timeout)

    def expect_load(
        self,
        mass: float = 0.0,
        centre: Sequence[float] = (0.0, 0.0, 0.0),
        interval: float = TAKEN_UP,
        *,
        remember: bool = False,
        timeout: float | None = None,
    ) -> None:
        """Say what the tip takes up now, as when a gripper closes, or that it holds nothing.

        The law carries it at once, instead of finding it by the error that it causes, and learning
        corrects it.  `load` is for the drives of the robot; this is for the law.

        Args:
            mass: what the tip will hold besides what it held at the start [kg].
            centre: of this mass, in the frame of `robot.tip` [m].
            interval: time in which the tip takes it up [s].
            remember: the load that the law has weighed last, instead of `mass` and `centre`.
            timeout: longest time to wait [s].

        Raises:
            MotionFailedError: this arm cannot hold that, the law is not in command, or none has
                been weighed.
            NotInTimeError, LoopEndedError: as for `move_to`.
        """
        wanted = {
            **checked_load(mass, centre),
            'interval': checked_interval(interval),
            'remember': bool(remember),
        }
        self._ask(script_link.EXPECT, wanted, timeout)

    def tare(self, timeout: float | None = None) -> None:
        """Take the external torque for zero where the arm rests now, as before an insertion.

        `state.external` is then relative to this moment.

        Raises:
            MotionFailedError: the arm moves or has just come to rest, something touches it, or
                `contact.enabled` is false.
            NotInTimeError, LoopEndedError: as for `move_to`.
        """
        self._ask(script_link.TARE, None, timeout)

    # State.

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the n joints, in the order of all arrays."""
        return self._loop.joints

    @property
    def state(self) -> ArmState:
        """The last state, some milliseconds old.

        Raises:
            LoopEndedError: the loop has ended.
        """
        return self._loop.state

    @property
    def pose(self) -> Pose:
        """Where the tip is by the last state.

        Raises:
            LoopEndedError: the loop has ended.
        """
        return self._poses.at(np.array(self.state.q))

    @functools.cached_property
    def _poses(self) -> Poses:
        """The kinematics of the file, imported when they are needed."""
        from blf_dsc_controller.configuration.controller import ControllerConfig
        from blf_dsc_controller.configuration.nodes import CONTROLLER, load, locate
        from blf_dsc_controller.drive.pose import Poses

        given = self._overrides.get(CONTROLLER)
        return Poses(load(locate(self._config), CONTROLLER, ControllerConfig, given))

    @property
    def is_moving(self) -> bool:
        """Whether the last `move_to` or `follow` is not over.

        Raises:
            LoopEndedError: the loop has ended.
        """
        self._loop.check()
        return self._last is not None and not self._last.done()

    @property
    def ended(self) -> str:
        """Why the loop has ended; empty while it runs."""
        return self._loop.ended

    def recover(self) -> None:
        """Take command again after an end, such as a stop of the controller or a reflex.

        The arm then holds where it is.  What was learned is kept, unless the process died.

        Raises:
            DriveError: the cause is still there.
        """
        if not self.ended:
            return
        self._last = None
        if self._loop.can_recover:
            self._loop.recover()
        else:
            self._loop.end()
            self._loop = self._start()

    def close(self) -> None:
        """Bring the arm to rest, and end its loop; a second Ctrl-C ends it at once."""
        self._loop.close()

    def _start(self) -> LoopProcess:
        """Return another process, which records into a folder of its own."""
        self._starts += 1
        record = self._record
        if record is not None and self._starts > 1:
            record = record.with_name(f'{record.name}_{self._starts}')
        loop = LoopProcess(
            {
                'config': self._config,
                'overrides': self._overrides,
                'robot': self._robot,
                'record': str(record) if record else None,
            }
        )
        self._loops.add(loop)
        return loop

    def _begin(
        self,
        kind: int,
        wanted: dict[str, Any],
        *,
        wait: bool,
        timeout: float | None,
        hint: str = '',
    ) -> None:
        """Begin a motion; `hint` is what its error ends with."""
        checked_timeout(timeout)
        self._last = self._loop.request(kind, wanted)
        self._hint = hint
        if wait:
            self._await_motion(self._last, timeout)

    def _await_motion(self, result: Future[str], timeout: float | None) -> None:
        try:
            self._await_result(result, timeout, self._hint)
        except NotInTimeError as error:
            self.stop()
            raise NotInTimeError(f'{error}: the arm has braked') from None
        except KeyboardInterrupt:
            # where no block ends with it, as in a notebook, the arm would go on
            self._loop.brake()
            raise

    def _ask(self, kind: int, wanted: Any, timeout: float | None) -> None:
        checked_timeout(timeout)
        self._await_result(self._loop.request(kind, wanted), timeout)

    def _await_result(
        self, result: Future[str], timeout: float | None, hint: str = ''
    ) -> None:
        problem = self._loop.await_result(result, timeout)
        if problem:
            raise MotionFailedError(problem + hint)


def _listed(values: Any) -> list[float]:
    """Return a field of a point as a list; TypeError or ValueError if it is none."""
    field = np.asarray(values, float)
    if field.ndim != 1:
        raise ValueError(f'got {values} where a list of numbers belongs')
    return [float(each) for each in field]
