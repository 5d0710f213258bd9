# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc commission`: measure an arm, and choose its gains by what was measured."""

from __future__ import annotations

import sys
import textwrap
from argparse import Namespace
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from blf_dsc_controller import __version__
from blf_dsc_controller.cli.commission_robot import measured_on, proven_on, robot
from blf_dsc_controller.cli.drive import CODES
from blf_dsc_controller.cli.main import make_room
from blf_dsc_controller.cli.ros_check import require_ros
from blf_dsc_controller.commissioning import files, page, simulated
from blf_dsc_controller.commissioning.choice import LAGS
from blf_dsc_controller.commissioning.commissioning import Commissioned
from blf_dsc_controller.commissioning.own_loop import (
    Commissioning,
    Measured,
    measured_in,
)
from blf_dsc_controller.commissioning.postures import EndedError, PostureByPosture
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    DRIVE,
    dump,
    load,
    load_loop,
    locate,
    read,
)
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.progress import announce_reading, print_notice, steps
from blf_dsc_controller.supervision.digits import largest_error

_WIDTH = 98

NO_MARGIN = 3
"""Exit code if no gains have the margin."""


def commission(options: Namespace) -> int:
    """Write the motions to run, or measure, choose and write the gains."""
    _check(options)
    path = locate(options.config)
    if not options.ros:
        return _commission(options, path, load(path, CONTROLLER, ControllerConfig))
    require_ros()
    from blf_dsc_controller.cli.commission_ros import config_over_ros, ros_session

    with ros_session(options):
        return _commission(options, path, config_over_ros(path))


def _commission(options: Namespace, path: Path, config: ControllerConfig) -> int:
    """Write the motions of a configuration, or measure, choose and write the gains."""
    commissioning = Commissioning(
        config,
        options.posture,
        torque=options.torque,
        travel=options.travel,
        margin=options.margin,
        lags=_lags(path),
    )
    if options.prove:
        return _prove_on_robot(options, path, commissioning)
    if options.write:
        _write_motions(options, path, commissioning)
        return 0
    picture = options.out.with_suffix('.png')
    make_room(options.out, picture, force=options.force)
    try:
        names, runs, missing = _all_runs(options, path, commissioning)
    except EndedError as error:
        print(f'blf_dsc commission: {error}', file=sys.stderr)
        return CODES[error.end]
    print_notice('choosing the gains by what was measured: some ten seconds')
    found = commissioning.result(runs)
    print(page.table(found))  # also if the gains are too soft for any bound: an error
    lines = _told(options, found, missing)
    print('\n'.join(['', *lines]))
    page.draw(found, names, picture)
    print(f'wrote {picture}')
    if not found.has_margin:
        print(f'not written: {options.out}')
        return NO_MARGIN
    comment = ''.join(f'# {line}\n' for line in (options.line, *lines))
    dump(options.out, files.of_commissioned(read(path), found), comment)
    print(f'wrote {options.out}')
    if _is_simulated(options):
        _prove(options.out)
    return 0


def _lags(path: Path) -> Sequence[float]:
    """Return the lags of the damping to try [s]: motors that close the feedback have none."""
    in_motors = load(path, DRIVE, DriveConfig).feedback == 'motor'
    return () if in_motors else LAGS


def _is_simulated(options: Namespace) -> bool:
    """Whether the options measure the simulated arm."""
    return not (options.bags or options.robot or options.ros)


def _check(options: Namespace) -> None:
    """Raise BlfDscError if options contradict each other."""
    is_robot = options.robot or options.ros
    if options.robot and options.ros:
        raise BlfDscError(
            '--robot is for a driver of blf_dsc drive, --ros for one of ROS: leave out one of them'
        )
    if options.write and (is_robot or options.bags):
        raise BlfDscError(
            '--write measures nothing: leave out bags, --robot and --ros, or leave out --write'
        )
    if options.prove and (not is_robot or options.write or options.bags):
        raise BlfDscError(
            '--prove runs a commissioned file on a robot: give --robot or --ros, no bags and no '
            '--write'
        )
    if not is_robot and (options.yes or options.record):
        raise BlfDscError(
            '--yes and --record are for a robot: give --robot or --ros, too'
        )
    if not options.ros and (options.states or options.commands or options.namespace):
        raise BlfDscError(
            '--states, --commands and --namespace are for topics: give --ros, too'
        )


def _all_runs(
    options: Namespace, path: Path, commissioning: Commissioning
) -> tuple[list[str], list[Measured], list[str]]:
    """Return names and runs: of bags, of the robot or both, else of the simulated arm.

    Also sentences about what was to be measured and could not be.
    """
    if _is_simulated(options):
        return _simulated(path, commissioning)
    names = [str(bag) for bag in options.bags]
    announce_reading(options.bags, 'read')
    runs = [measured_in(bag) for bag in options.bags]
    if not (options.robot or options.ros):
        return names, runs, []
    measured = measured_on(options, _arm(options, path, commissioning), commissioning)
    names += [name for name, _ in measured]
    return names, runs + [run for _, run in measured], []


def _arm(
    options: Namespace, path: Path, commissioning: Commissioning
) -> AbstractContextManager[PostureByPosture]:
    """Return the robot that the options name, still to be entered."""
    if options.robot:
        return robot(options, path, commissioning)
    from blf_dsc_controller.cli.commission_ros import robot_over_ros

    return robot_over_ros(options, commissioning)


def _prove_on_robot(
    options: Namespace, path: Path, commissioning: Commissioning
) -> int:
    """Raise the gains of a file step by step on a robot, and say how far it errs."""
    config = commissioning.config
    try:
        arm = _arm(options, path, commissioning)
        (*_, last), cycles = proven_on(options, arm, config)
    except EndedError as error:
        print(f'blf_dsc commission: {error}', file=sys.stderr)
        return CODES[error.end]
    print(page.errors_table(config, last))
    for each in cycles:
        print(page.of_limit_cycle(each))
    return 0


def _write_motions(
    options: Namespace, path: Path, commissioning: Commissioning
) -> None:
    """Write a parameter file for each motion, and say how far it goes."""
    planned = commissioning.motions
    sections = read(path)
    paths = [
        options.write.with_name(f'{options.write.stem}_{k}.yaml')
        for k in range(1, len(planned) + 1)
    ]
    make_room(*paths, force=options.force)
    for file, each in zip(paths, planned, strict=True):
        line = page.description(each)
        dump(file, files.of_motion(sections, each), f'# {line}\n')
        print(f'wrote {file}: {line}')
    print(
        'run the controller with each of them, for the time it says at least, from its posture '
        'on, and record a bag; then give all bags to blf_dsc commission'
    )


def _simulated(
    path: Path, commissioning: Commissioning
) -> tuple[list[str], list[Measured], list[str]]:
    """Return names and runs of the motions on the simulated arm, and what it did not bear."""
    loop = load_loop(path)
    planned = commissioning.motions_from(loop.plant.initial.position)
    for k, each in enumerate(planned, 1):
        print(f'posture {k}: {page.description(each)}', flush=True)
    names, runs, missing = [], [], []
    with announced_compilation(print_notice):
        made = simulated.runs_of(commissioning, loop)
        total = len(planned) + 1
        longest = max(each.duration for each in planned)
        begun = (
            f'simulating {total} runs of {longest:g} s, at some ten times real time; where '
            'noise or friction hides much, a run is repeated'
        )
        for name, run in steps(made, total, 'run', begun):
            if isinstance(run, BlfDscError):
                missing.append(page.not_measured(name, run))
                print(missing[-1])
                continue
            names.append(name)
            runs.append(run)
    return names, runs, missing


def _told(
    options: Namespace, found: Commissioned, missing: Sequence[str]
) -> Sequence[str]:
    """Return what was commissioned and when, and the sentences of the page; wrapped.

    What is `missing` comes last: it was said long before, and the file is to say it, too.
    """
    origin = (
        f'{options.config} commissioned on {found.date} by blf_dsc_controller {__version__}, with '
        f'a modulus margin of {found.choice.margin.value:.2g}'
    )
    found_out = page.sentences(found, is_simulated=_is_simulated(options))
    told = [origin, *found_out, *missing]
    return [line for each in told for line in textwrap.wrap(each, _WIDTH)]


def _prove(path: Path) -> None:
    """Say what the simulated arm does with its new gains."""
    loop = load_loop(path)
    print_notice(
        'simulating the arm with these gains along its own motion: some seconds'
    )
    proof = simulated.proof(loop)
    if proof.stop:
        print(
            f'with these gains the simulated arm stops on its own motion: {proof.stop}'
        )
        return
    print(
        f'with these gains the simulated arm follows its own motion for {proof.duration:g} s, '
        f'with {largest_error(proof.error, loop.controller.units)} at most'
    )
    for each in proof.cycles:
        print(page.of_limit_cycle(each))
