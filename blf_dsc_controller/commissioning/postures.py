# SPDX-License-Identifier: Apache-2.0
"""Commissioning of a robot from posture to posture: slowly to each, and the motion there.

    rest -> move -> rest -> motion -> rest      for each posture, and the motion again, up to
                                                twice, if noise or friction hide much; all of
                                                it again in the first posture of an arm of
                                                which little was known (`better_known`)

Moves and motions are runs that end at rest whatever happens, and have a bag each.  A motion
is around the posture in which the arm rests by then, so it begins without an error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.commissioning.commissioning import REPEATS, Commissioning
from blf_dsc_controller.commissioning.measurement import (
    OSCILLATES,
    Measured,
    measured_in,
    named,
)
from blf_dsc_controller.commissioning.motion import lines_in
from blf_dsc_controller.commissioning.planned import Planned
from blf_dsc_controller.commissioning.proof import (
    Errors,
    Step,
    errors_of,
    start_of,
)
from blf_dsc_controller.commissioning.response import response_of
from blf_dsc_controller.commissioning.run_parameters import undisturbed_parameters
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.control.slow_move import duration_of
from blf_dsc_controller.drive.driver import Driver
from blf_dsc_controller.drive.loop import DriveLoop, End
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import EventType, decode
from blf_dsc_controller.messages.topics import Topic
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.reference.approach import AT_REST
from blf_dsc_controller.reference.turns import short_way
from blf_dsc_controller.supervision.guard import Guard

Floats = NDArray[np.float64]
Answer = TypeVar('Answer')

SPEED = 0.3
"""Largest speed of a joint on the way to a posture [rad/s]."""

_ACCELERATION = 0.5  # rad/s^2, likewise
_SHORTEST = 1.0  # s, of a move
_REST = 1.0  # s, at its end
_HELD = 'the arm is held until Ctrl-C: engage its brakes first'
_PAUSE = 0.2  # s, in which an arm at rest does not move
_OTHERS = {
    EventType.TRAJECTORY: 'a trajectory was sent to the controller',
    EventType.TARGET: 'a position was sent to the controller',
    EventType.BRAKE: 'somebody called ~/stop',
    EventType.RESET: 'somebody called ~/reset',
    EventType.CONTACT: 'something touched the arm',
}


class EndedError(BlfDscError):
    """A run ended before its time; the message says why, and what is left.

    Attributes:
        end: why, in short.
        oscillation: how the arm oscillated; empty if it did not.
    """

    def __init__(self, end: End, message: str, oscillation: str = '') -> None:
        self.end = end
        self.oscillation = oscillation
        super().__init__(message)


class Move(NamedTuple):
    """The way to a posture."""

    config: ControllerConfig
    duration: float  # s, with the rest at its end


def move(config: ControllerConfig, here: Floats, there: Floats) -> Move:
    """Return the slow way from rest at `here` (n,) [rad] to rest at `there` (n,).

    It has the gains of the configuration, and is straight in the angles of the joints.
    """
    (target,), _ = short_way(there[None], here, config)
    far = np.abs(target - here)
    speed = np.minimum(SPEED, 0.5 * np.array(config.limits.velocity))
    acceleration = np.minimum(_ACCELERATION, 0.5 * np.array(config.limits.acceleration))
    duration = max(_SHORTEST, duration_of(far, speed, acceleration))
    values = undisturbed_parameters(config) | {
        'reference.type': 'waypoints',
        'reference.times': [0.0, duration],
        'reference.waypoints': [*here.tolist(), *target.tolist()],
    }
    return Move(change(config, values), duration + _REST)


def plan_repeat_by_bag(
    commissioning: Commissioning, planned: Planned, bag: Path, posture: Floats
) -> Planned | None:
    """Return `Commissioning.plan_repeat` for the bag of a motion, around a posture (n,) [rad].

    Raises BlfDscError if it is None, and the bag does not show the response.
    """
    measured = measured_in(bag)
    again = commissioning.plan_repeat(planned, measured.run, posture)
    if again is None:
        _check(measured)
    return again


def better_known_by_bag(
    commissioning: Commissioning, planned: Planned, bag: Path
) -> Commissioning | None:
    """Return `Commissioning.better_known` for the bag of a motion.

    Raises BlfDscError if the bag does not show the response.
    """
    return commissioning.better_known(planned, measured_in(bag).run)


def check(bag: Path) -> None:
    """Raise BlfDscError if the run of a bag does not show the response."""
    _check(measured_in(bag))


def _check(measured: Measured) -> None:
    config = measured.config
    response_of(measured.run, lines_in(config), config.sample_time)


def _set_aside(bag: Path, why: str) -> None:
    """Rename a bag that is not in the result, so that its name is free for the next one."""
    there = bag.with_name(f'{why}_{bag.name}')
    while there.exists():
        there = there.with_name(f'again_{there.name}')
    bag.rename(there)


class _Disturbed:
    """An output that ends a run whose motion is changed: it shows nothing."""

    def __init__(self, driver: Driver) -> None:
        """`driver` gets it as its problem."""
        self._driver = driver

    def write(self, _stamp: int, topic: Topic, raw: bytes) -> None:
        if topic in (topics.JOURNAL, topics.TARGETS):
            self._driver.problem = _OTHERS.get(decode(raw).type, self._driver.problem)


class PostureByPosture:
    """A robot at rest, which goes from posture to posture and is measured in each.

    Attributes:
        driver: of the robot; holds the arm between two runs.
    """

    def __init__(
        self, driver: Driver, commissioning: Commissioning, folder: Path
    ) -> None:
        """Use a connected driver, and write bags into `folder`."""
        self.driver = driver
        self._loop: DriveLoop | None = None
        self._commissioning = commissioning
        self._config = commissioning.config
        self._folder = folder
        self._measured = 0
        self._requests = 0
        self._left = ''  # what a proof has found so far; empty: the arm is measured

    def hold_after(self) -> None:
        """Hold an arm after its last run that would fall otherwise, until an end is requested."""
        if self.driver.answers and self._config.robot.drive_compensates == 'none':
            print_notice(_HELD)
            self.driver.wait_until(lambda: self._requests > 0)

    def aside(self, compute: Callable[..., Answer], *given: object) -> Answer:
        """Return the answer of a function that may take longer than a sample, between two runs."""
        if self.driver.worker is None:
            return compute(*given)
        return self._awaited(self.driver.worker.submit(compute, *given))

    def _awaited(self, computed: Future[Answer]) -> Answer:
        """Return an answer; the arm is held until it is there."""
        self.driver.wait_until(computed.done)
        return computed.result()

    def request_end(self) -> None:
        """Bring the arm to rest and end, as for a signal; a second request ends at once."""
        self._requests += 1
        if self._loop is not None:
            self._loop.request_end()

    def position(self) -> Floats:
        """Return the positions (n,) [rad] of the arm.

        Raises BlfDscError if it moves.
        """
        before = np.array(self.driver.positions(), float)
        self.driver.wait(_PAUSE)
        after = np.array(self.driver.positions(), float)
        joint = int(np.abs(after - before).argmax())
        moved = float(after[joint] - before[joint])
        if abs(moved) > AT_REST * _PAUSE:
            unit = self._config.units[joint].position
            raise BlfDscError(
                f'{self._config.joints[joint]} moves by {moved:+.2g} {unit} in {_PAUSE:g} s: let '
                'go of the arm, end what else moves it, and start again when it rests'
            )
        return after

    def duration(self, planned: Sequence[Planned]) -> float:
        """Return the time [s] that all motions take, with the moves to their postures."""
        there = [each.posture for each in planned]
        ways = zip([self.position(), *there[:-1]], there, strict=True)
        moving = sum(move(self._config, *way).duration for way in ways)
        return moving + sum(each.duration for each in planned)

    def runs(self, postures: Floats) -> Iterator[tuple[str, Path]]:
        """Yield for each posture (k, n) [rad] its name and the bag of its motion.

        Raises:
            EndedError: on request, or since the controller or the robot stopped.
            BlfDscError: the law cannot take over, the bag is not whole, or it does not show
                the response.
        """
        for k, posture in enumerate(postures, 1):
            name = f'posture {k}'
            self._move_to(posture, f'move {k}')
            planned, bag = self._measure(name)
            while k == 1:
                with named(name):
                    better = self.aside(
                        better_known_by_bag, self._commissioning, planned, bag
                    )
                if better is None:
                    break
                self._commissioning = better
                _set_aside(bag, 'soft')
                planned, bag = self._measure(name)
            self._measured = k
            yield name, bag

    def _measure(self, name: str) -> tuple[Planned, Path]:
        """Measure the arm where it rests, repeatedly if need be; return the last motion and bag."""
        planned, bag = self._run_motion(name)
        for _ in range(REPEATS):
            with named(name):
                again = self.aside(
                    plan_repeat_by_bag,
                    self._commissioning,
                    planned,
                    bag,
                    self.position(),
                )
            if again is None:
                return planned, bag
            _set_aside(bag, 'weak')
            # `plan_repeat` has set it, but of a copy if another process has computed it
            self._commissioning.go_on_with(again)
            planned, bag = self._run_motion(name)
        with named(name):
            self.aside(check, bag)
        return planned, bag

    def _run_motion(self, name: str) -> tuple[Planned, Path]:
        """Excite the arm where it rests, softer if it oscillates; return the motion and its bag."""
        while True:
            with named(name):
                planned = self.aside(self._commissioning.motion, self.position())
            bag = self._run_calmly(planned.config, planned.duration, name)
            if bag is not None:
                return planned, bag

    def _move_to(self, posture: Floats, name: str) -> None:
        """Move slowly to a posture (n,) [rad], softer if the arm oscillates."""
        bag = None
        while bag is None:
            held = self._commissioning.held_with
            way = self.aside(move, held, self.position(), posture)
            bag = self._run_calmly(way.config, way.duration, name)

    def _run_calmly(
        self, config: ControllerConfig, duration: float, name: str
    ) -> Path | None:
        """Return the bag of a run as `_run`; None, with half of the gains, if it oscillated."""
        try:
            return self._run(config, duration, name)
        except EndedError as error:
            if not error.oscillation:
                raise
            _set_aside(self._bag(name), 'shaken')
            with named(name):
                self._commissioning.soften(error.oscillation)
            return None

    def proof(self, steps: Sequence[Step]) -> Iterator[tuple[Step, Errors]]:
        """Yield the errors of each step, to whose start the arm goes slowly.

        Raises EndedError or BlfDscError as `runs`.
        """
        held = 'no share of the gains was calm so far'
        for step in steps:
            self._left = f'The gains are not proven: {held}; bags are in {self._folder}'
            here = self.position()
            there = start_of(step.config, here)
            way = self.aside(move, step.config, here, there)
            self._run(way.config, way.duration, f'way with {step.name}')
            bag = self._run(step.config, step.duration, step.name)
            yield step, self.aside(errors_of, bag, step.config)
            held = f'{step.share:.0%} of them were calm'

    def _run(self, config: ControllerConfig, duration: float, name: str) -> Path:
        """Control the robot for so long [s]; return the bag."""
        bag = self._bag(name)
        self._control(config, duration, bag, name)
        return bag

    def _control(
        self, config: ControllerConfig, duration: float, bag: Path, name: str
    ) -> None:
        """Control the robot from rest to rest, for so long [s], and record it.

        Raises EndedError or BlfDscError if it ended before its time.
        """
        with (
            ThreadPoolExecutor(1) as thread,
            self._awaited(
                thread.submit(ArmController, config, record=bag, stamps='wall')
            ) as controller,
        ):
            loop = self._loop = DriveLoop(
                self.driver,
                controller,
                duration=duration,
                feedback='host',  # what moves the arm is the torque alone, as recorded
            )
            if self.driver.answers:
                controller.add_output(_Disturbed(self.driver))
            if self._requests:
                raise self._ended(name, End.REQUESTED, '', None)
            with named(name):
                outcome = loop.run()
            self._loop = None
        if outcome.end is not End.DURATION:
            raise self._ended(name, outcome.end, outcome.text, controller.guard)
        if controller.output_problem:
            raise self._not_whole(name)

    def _bag(self, name: str) -> Path:
        return self._folder / name.replace(' ', '_').replace('%', '')

    def _ended(self, name: str, end: End, text: str, guard: Guard | None) -> EndedError:
        """Return the error of a run that ended for this reason, with what is left."""
        reason = f': {text}' if text else ''
        message = f'{name}: {end}{reason}. {self._what_is_left()}'
        is_shaken = guard is not None and guard.supervisor.reason in OSCILLATES
        return EndedError(end, message, text if is_shaken else '')

    def _not_whole(self, name: str) -> BlfDscError:
        """Return the error of a run whose bag is not whole; why was told when it happened."""
        return BlfDscError(
            f'{name}: its bag is not whole, so the run shows nothing: name a folder on another '
            f'disk with --record. {self._what_is_left()}'
        )

    def _what_is_left(self) -> str:
        return self._left or (
            f'No gains were chosen or written; whole bags of {self._measured} postures are in '
            f'{self._folder}'
        )
