# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc commission --robot`: the limits, a question, and the robot in each posture."""

from __future__ import annotations

import signal
import sys
from argparse import Namespace
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

from blf_dsc_controller.cli.drive import connect, signals_to
from blf_dsc_controller.cli.main import make_room
from blf_dsc_controller.commissioning import page
from blf_dsc_controller.commissioning.commissioning import (
    REPEATS,
    Commissioning,
)
from blf_dsc_controller.commissioning.planned import Planned
from blf_dsc_controller.commissioning.postures import SPEED, PostureByPosture
from blf_dsc_controller.commissioning.proof import (
    SHARES,
    Step,
    name_of,
    seconds,
)
from blf_dsc_controller.commissioning.strength import MOST
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import DRIVE, PLANT
from blf_dsc_controller.configuration.plant import pick_ups
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.drive.drivers import driver_of
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.numerics.digits import largest_error
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.run import unit_of_all

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def robot(
    options: Namespace, path: Path, commissioning: Commissioning
) -> Iterator[PostureByPosture]:
    """Connect to the robot, at rest.

    Raises BlfDscError if nobody can be asked, or the robot or the file is not as it should
    be.
    """
    folder = prepared_folder(options)
    config = commissioning.config
    # of a simulated arm, which nobody disturbs
    unloaded: dict[str, Mapping[str, object]] = {
        PLANT: pick_ups([], []),
        **topics_of(options),
    }
    driver = driver_of(options.robot, path, config, unloaded)
    with announced_compilation(print_notice):
        ArmController(config).close()
    with closing(driver):
        connect(driver)
        driven = PostureByPosture(driver, commissioning, folder)
        with signals_to(driven.request_end):
            yield driven


def topics_of(options: Namespace) -> dict[str, dict[str, object]]:
    """Return the topics that the options name, as parameters of the driver `ros`."""
    names = ('states', 'commands', 'namespace')
    given = {name: getattr(options, name) for name in names if getattr(options, name)}
    return {DRIVE: given}


def measured_on(
    options: Namespace,
    arm: PostureByPosture,
    commissioning: Commissioning,
) -> list[tuple[str, Path]]:
    """Measure a robot, and return for each posture its name and its bag.

    Raises:
        EndedError: it ended before its time.
        BlfDscError: nobody agrees, or the robot, the file or a run is not as it should be.
    """
    planned = commissioning.motions_from(arm.position())
    duration = arm.duration(planned)
    ask(options, _limits(options, commissioning, planned, duration))
    measured = []
    total = len(planned)
    print(f'0 of {total} postures measured: Ctrl-C stops the arm', flush=True)
    for bag in arm.runs(np.array([each.posture for each in planned])):
        measured.append(bag)
        print(f'{len(measured)} of {total} postures measured', flush=True)
    return measured


def prove(
    arm: PostureByPosture, planned: Sequence[Step], config: ControllerConfig
) -> None:
    """Prove the gains of a configuration on a robot.

    Print the errors of each step, and those of the last one beside those to expect.

    Raises as `measured_on`.
    """
    for step, errors in arm.proof(planned):
        worst = largest_error(errors.measured, config.units)
        print(f'{step.name}: calm, errors of {worst} at most', flush=True)
        if step is planned[-1]:
            print(page.errors_table(config, errors))


def prepared_folder(options: Namespace) -> Path:
    """Return the folder for the bags, which does not exist yet.

    Raises BlfDscError if it does, or if nobody can be asked whether to start.
    """
    if not (options.yes or sys.stdin.isatty()):
        raise BlfDscError(
            'the robot moves, and nobody can be asked here: start it in a terminal, or give --yes'
        )
    folder: Path = options.record or options.out.with_name(f'{options.out.stem}_bags')
    make_room(folder, force=False, try_out=False)
    return folder


def ask(options: Namespace, lines: Iterable[str]) -> None:
    """Say what the robot is about to do, and ask whether to start.

    Raises BlfDscError if nobody agrees.
    """
    print('\n'.join(lines))
    if not options.yes and not agreed():
        raise BlfDscError('not started: nothing has moved')


def agreed() -> bool:
    """Whether somebody types yes; Ctrl-C is an answer, too."""
    before = [signal.signal(each, signal.default_int_handler) for each in _SIGNALS]
    try:
        return input('Type yes to start: ').strip().lower() == 'yes'
    finally:
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)


def of_proof(options: Namespace, config: ControllerConfig) -> Iterator[str]:
    """Yield what the arm is about to do in a proof."""
    yield (
        'before each step the joints move straight to the start of the reference, at '
        f'{_speed(config)} at most: keep the way of the arm free'
    )
    yield (
        f'then the arm follows the reference of {options.config}, for {seconds():g} s in all, with '
        f'{", ".join(map(name_of, SHARES))}'
    )
    yield (
        'an oscillation, any other check of the controller, or Ctrl-C brings the arm to rest and '
        'ends'
    )


def _limits(
    options: Namespace,
    commissioning: Commissioning,
    planned: list[Planned],
    duration: float,
) -> Iterator[str]:
    """Yield what the arm is about to do at most."""
    slid = [commissioning.sliding(each.posture) for each in planned]
    again = REPEATS * sum(each.duration for each in slid)
    again += commissioning.anew_left * (1 + REPEATS) * slid[0].duration
    first = planned[0].config
    bound = ', '.join(f'{each:.2g}' for each in first.barrier.bound)
    unit = unit_of_all(first.units, 'rad')
    yield from _of_motions(options, commissioning.config, planned)
    yield from _of_repeats(options, commissioning, slid)
    yield (
        f'an error of {bound} {unit}, any other check of the controller, or Ctrl-C brings the arm '
        'to rest and ends'
    )
    yield (
        f'the arm moves for {duration:.0f} s in all, and for {duration + again:.0f} s if '
        'every posture is measured as often as that'
    )


def _of_motions(
    options: Namespace, config: ControllerConfig, planned: list[Planned]
) -> Iterator[str]:
    """Yield where the arm moves, and with what torques."""
    for k, each in enumerate(planned, 1):
        yield f'posture {k}: {page.description(each)}'
    most = ', '.join(f'{torque:.3g}' for torque in config.torque.limit)
    yield (
        f'to each posture the joints move straight, at {_speed(config)} at most: keep the way of '
        'the arm free'
    )
    yield (
        f'the motions add torques of {_rated(config, options.torque)} (rms); torque.limit is '
        f'{most} {unit_of_all(config.units, "N m")}'
    )


def _of_repeats(
    options: Namespace, commissioning: Commissioning, slid: list[Planned]
) -> Iterator[str]:
    """Yield when a posture is measured again, and how; `slid` are the motions with swings."""
    most = _rated(commissioning.config, MOST * options.torque)
    yield (
        f'where noise hides too much, a posture is measured again, up to {REPEATS} times, with '
        f'{most} at most; the tool then travels {1e3 * options.travel:.3g} mm at most'
    )
    swing = np.max([each.excitation.swing for each in slid], axis=0)
    swings = ', '.join(f'{torque:.2g}' for torque in swing)
    unit = unit_of_all(commissioning.config.units, 'N m')
    yield (
        f'where friction damps a joint more than its gains do, likewise, with swings of {swings} '
        f'{unit}, and friction, which keep all joints sliding'
    )
    yield (
        'where the arm oscillates, it stops, and goes on with half of the gains of the file, as '
        'often as needed'
    )
    if commissioning.anew_left:
        yield (
            'of this arm only the URDF is known: where friction hides an inertia, posture 1 is '
            f'measured anew, up to {commissioning.anew_left} times, with half of the gains that '
            'are stable by then and the friction that it showed'
        )


def _rated(config: ControllerConfig, share: float) -> str:
    """Return a share of the rated torques in words."""
    rated = config.robot.efforts(config.robot.chain(config.joints))
    torques = ', '.join(f'{torque:.2g}' for torque in share * rated)
    return f'{torques} {unit_of_all(config.units, "N m")}'


def _speed(config: ControllerConfig) -> str:
    """Return the largest speed on the way to a posture in words."""
    return f'{SPEED:g} {unit_of_all(config.units, "rad/s")}'
