# SPDX-License-Identifier: Apache-2.0
"""Commissioning of a robot over its driver: slowly to each posture, and the motion there.

    rest -> move -> rest -> motion -> rest      for each posture, and the motion once more if
                                                noise hides much

Move and motion are runs of `drive.loop`, which end at rest whatever happens, and have a
bag each.  Between two of them the robot holds itself by its own means.  A motion is
around the posture in which the arm rests by then, so it begins without an error.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.commissioning import motion
from blf_dsc_controller.commissioning.commissioning import Planned
from blf_dsc_controller.commissioning.own_loop import Commissioning, Measured
from blf_dsc_controller.commissioning.response import response_of
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.control.slow_move import duration_of
from blf_dsc_controller.drive.driver import Driver
from blf_dsc_controller.drive.loop import DriveLoop, End
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.reference.approach import AT_REST
from blf_dsc_controller.reference.turns import short_way
from blf_dsc_controller.run import Run

Floats = NDArray[np.float64]

SPEED = 0.3
"""Largest speed of a joint on the way to a posture [rad/s]."""

_ACCELERATION = 0.5  # rad/s^2, likewise
_SHORTEST = 1.0  # s, of a move
_REST = 1.0  # s, at its end
_PAUSE = 0.2  # s, in which an arm at rest does not move


class EndedError(BlfDscError):
    """A run ended before its time; the message says why, and what is left."""

    def __init__(self, end: End, message: str) -> None:
        self.end = end
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
    values = motion.watched(config) | {
        'reference.type': 'waypoints',
        'reference.times': [0.0, duration],
        'reference.waypoints': [*here.tolist(), *target.tolist()],
    }
    return Move(change(config, values), duration + _REST)


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Let an error say in which posture it is."""
    try:
        yield
    except BlfDscError as error:
        raise BlfDscError(f'{name}: {error}') from error


class Driven:
    """A robot at rest, which goes from posture to posture and is measured in each."""

    def __init__(
        self,
        driver: Driver,
        commissioning: Commissioning,
        folder: Path,
    ) -> None:
        """Use a connected driver, and write bags into `folder`."""
        self._driver = driver
        self._commissioning = commissioning
        self._config = commissioning.config
        self._folder = folder
        self._measured = 0
        self._loop: DriveLoop | None = None
        self._requests = 0

    def request_end(self) -> None:
        """Bring the arm to rest and end; a second request ends at once.

        For signal handlers.
        """
        self._requests += 1
        if self._loop is not None:
            self._loop.request_end()

    def position(self) -> Floats:
        """Return the positions (n,) [rad] of the arm.

        Raises BlfDscError if it moves.
        """
        before = np.array(self._driver.positions(), float)
        time.sleep(_PAUSE)
        after = np.array(self._driver.positions(), float)
        joint = int(np.abs(after - before).argmax())
        moved = float(after[joint] - before[joint])
        if abs(moved) > AT_REST * _PAUSE:
            raise BlfDscError(
                f'{self._config.joints[joint]} moves by {moved:+.2g} rad in {_PAUSE:g} s: let go '
                'of the arm, end what else moves it, and start again when it rests'
            )
        return after

    def duration(self, planned: Sequence[Planned]) -> float:
        """Return the time [s] that all motions take, with the moves to their postures."""
        there = [each.posture for each in planned]
        ways = zip([self.position(), *there[:-1]], there, strict=True)
        moving = sum(move(self._config, *way).duration for way in ways)
        return moving + sum(each.duration for each in planned)

    def runs(self, postures: Floats) -> Iterator[tuple[str, Measured]]:
        """Yield for each posture (k, n) [rad] its name and what was measured there.

        Raises:
            EndedError: on request, or since the controller or the robot stopped.
            BlfDscError: the law cannot take over, the bag is not whole, or it does not show
                the response.
        """
        for k, posture in enumerate(postures, 1):
            name = f'posture {k}'
            way = move(self._config, self.position(), posture)
            self._run(way.config, way.duration, f'move {k}')
            here = self._commissioning.motion(self.position())
            run = self._shaken(here, name)
            with _named(name):
                again = self._commissioning.stronger(here, run, self.position())
            if again is not None:
                bag = self._bag(name)
                bag.rename(bag.with_name(f'weak_{bag.name}'))
                here = again
                run = self._shaken(here, name)
            with _named(name):
                response_of(run, motion.lines_in(here.config), here.config.sample_time)
            self._measured = k
            yield name, (run, here.config)

    def _shaken(self, planned: Planned, name: str) -> Run:
        """Run a motion, and return what it shows."""
        return read_run(self._run(planned.config, planned.duration, name))

    def _run(self, config: ControllerConfig, duration: float, name: str) -> Path:
        """Control the robot for so long [s]; return the bag."""
        bag = self._bag(name)
        with ArmController(config, record=bag, stamps='wall') as controller:
            self._loop = DriveLoop(
                self._driver,
                controller,
                duration=duration,
                settle_time=self._driver.config.settle_time,
                feedback='host',  # what moves the arm is the torque alone, as recorded
            )
            if self._requests:
                raise self._ended(name, End.REQUESTED, '')
            outcome = self._loop.run()
            self._loop = None
        if outcome.end is not End.DURATION:
            raise self._ended(name, outcome.end, outcome.text)
        if controller.output_problem:
            raise BlfDscError(f'{name}: {controller.output_problem}')
        return bag

    def _bag(self, name: str) -> Path:
        return self._folder / name.replace(' ', '_')

    def _ended(self, name: str, end: End, text: str) -> EndedError:
        reason = f': {text}' if text else ''
        return EndedError(
            end,
            f'{name}: {end}{reason}. No gains were chosen or written; whole bags of '
            f'{self._measured} postures are in {self._folder}',
        )
