# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc commission`: measure an arm, and choose its gains by what was measured."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from blf_dsc_controller.cli.commission_robot import (
    ask,
    measured_on,
    of_proof,
    prove,
    robot,
    topics_of,
)
from blf_dsc_controller.cli.commissioned_file import CommissionedFile
from blf_dsc_controller.cli.drive import CODES
from blf_dsc_controller.cli.main import make_room
from blf_dsc_controller.commissioning import (
    files,
    page,
    proof,
    simulated,
)
from blf_dsc_controller.commissioning.choice import LAGS
from blf_dsc_controller.commissioning.commissioned import Commissioned
from blf_dsc_controller.commissioning.commissioning import Commissioning
from blf_dsc_controller.commissioning.measurement import Measured, measured_in
from blf_dsc_controller.commissioning.picture import draw
from blf_dsc_controller.commissioning.postures import EndedError
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    DRIVE,
    dump,
    ignored_in,
    load,
    load_loop,
    locate,
    read,
)
from blf_dsc_controller.drive.drivers import ROS, config_of
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.numerics.digits import largest_error
from blf_dsc_controller.progress import announce_reading, print_notice, steps

Runs = list[tuple[str, Measured]]
"""Runs with their names."""

_CHOOSING = 'choosing the gains by what was measured: some ten seconds'
_IN_MOTORS = (
    'warning: drive.feedback is motor, but a commissioning measures with torques over the bus, '
    'and chooses gains that are stable there: in the motors higher ones are'
)

NO_MARGIN = 3
"""Exit code if no gains have the margin."""


def commission(options: Namespace) -> int:
    """Write the motions to run, or measure, choose and write the gains."""
    _check(options)
    if options.ros:
        options.robot = ROS
    path = locate(options.config)
    if ignored := ignored_in(path, (CONTROLLER, DRIVE)):
        print_notice(f'warning: {ignored}')
    config = config_of(options.robot or '', path, topics_of(options))
    in_motors = load(path, DRIVE, DriveConfig).feedback == 'motor'
    commissioning = Commissioning(
        config,
        options.posture,
        torque=options.torque,
        travel=options.travel,
        margin=options.margin,
        lags=() if in_motors else LAGS,  # such motors have none
    )
    if in_motors and (options.robot or not options.bags):
        print_notice(_IN_MOTORS)
    if options.write:
        _write_motions(options, path, commissioning)
        return 0
    if options.prove:
        work = _prove_on_robot
    else:
        make_room(options.out, _picture(options.out), force=options.force)
        work = _measure
    try:
        return work(options, path, commissioning)
    except EndedError as error:
        print(f'blf_dsc commission: {error}', file=sys.stderr)
        return CODES[error.end]


def _measure(options: Namespace, path: Path, commissioning: Commissioning) -> int:
    """Commission by the bags that are given, and a robot, or else on the simulated arm."""
    file = CommissionedFile(
        path=options.out,
        source=path,
        name=options.config,
        command=options.line,
        is_simulated=not (options.bags or options.robot),
    )
    announce_reading(options.bags, 'read')
    runs = [(str(bag), measured_in(bag, commissioning.config)) for bag in options.bags]
    if options.robot:
        with robot(options, path, commissioning) as arm:
            measured = measured_on(options, arm, commissioning)
            arm.hold_after()
        runs += [(name, measured_in(bag)) for name, bag in measured]
    elif file.is_simulated:
        runs, missing = _simulated(path, commissioning)
        file = file._replace(missing=tuple(missing))
    print_notice(_CHOOSING)
    names = [name for name, _ in runs]
    found = commissioning.result([run for _, run in runs], names)
    code = _written(file, found, names)
    if code == 0 and file.is_simulated:
        _prove(file.path)
    return code


def _written(file: CommissionedFile, found: Commissioned, names: Sequence[str]) -> int:
    """Print, draw and write what was found, by runs of these names; return the exit code."""
    print(page.table(found))  # also if the gains are too soft for any bound: an error
    content = file.content(found)
    print('\n'.join(['', *content.lines]))
    picture = _picture(file.path)
    draw(found, names, picture)
    print(f'wrote {picture}')
    if not found.has_margin:
        print(f'not written: {file.path}')
        return NO_MARGIN
    file.write(content)
    print(f'wrote {file.path}', flush=True)
    return 0


def _picture(out: Path) -> Path:
    """Return the path of the picture beside a parameter file."""
    return out.with_suffix('.png')


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
    is_over_ros = options.ros or options.robot == ROS
    if topics_of(options)[DRIVE] and not is_over_ros:
        raise BlfDscError(
            '--states, --commands and --namespace are for topics: give --ros, too'
        )


def _prove_on_robot(
    options: Namespace, path: Path, commissioning: Commissioning
) -> int:
    """Raise the gains of a file step by step on a robot, and print its errors."""
    config = commissioning.config
    planned = proof.steps(config)
    with robot(options, path, commissioning) as arm:
        ask(options, [*of_proof(options, config)])
        prove(arm, planned, config)
        arm.hold_after()
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


def _simulated(path: Path, commissioning: Commissioning) -> tuple[Runs, list[str]]:
    """Return the runs of the motions on the simulated arm, and with what it was unstable."""
    loop = load_loop(path)
    planned = commissioning.motions_from(loop.plant.initial.position)
    for k, each in enumerate(planned, 1):
        print(f'posture {k}: {page.description(each)}', flush=True)
    runs: Runs = []
    missing = []
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
            runs.append((name, run))
    return runs, missing


def _prove(path: Path) -> None:
    """Say what the simulated arm does with its new gains."""
    loop = load_loop(path)
    print_notice(
        'simulating the arm with these gains along its own motion: some seconds'
    )
    made = simulated.proof(loop)
    if made.stop:
        print(
            f'with these gains the simulated arm stops on its own motion: {made.stop}'
        )
        return
    print(
        f'with these gains the simulated arm follows its own motion for {made.duration:g} s, '
        f'with {largest_error(made.error, loop.controller.units)} at most'
    )
