# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc run`: a closed loop with its bag and pictures."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.recorded import recorded_run
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.cli.domains import check_network
from blf_dsc_controller.cli.result_folder import BAG, make_folder, refuse_existing
from blf_dsc_controller.cli.softer_gains import print_softer_gains_of
from blf_dsc_controller.cli.start import INTERRUPTED
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    DRIVE,
    PLANT,
    LoopConfig,
    dump,
    ignored_in,
    load,
    load_loop,
    locate,
)
from blf_dsc_controller.configuration.plant import PlantConfig, Truth
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.factory.gains import law_gains
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.reference.approach import end_of_waypoints, plan_start
from blf_dsc_controller.reference.turns import reference_near
from blf_dsc_controller.simulation.loop import simulate_into_bag
from blf_dsc_controller.supervision.supervisor import Reason
from blf_dsc_controller.warnings.expected_errors import expectation
from blf_dsc_controller.warnings.table import config_warnings

STOPPED = 5
"""Exit code if the controller stopped before the end."""

_DURATION = 60.0  # s, if neither the file nor an option sets it


def run(options: Namespace) -> int:
    """Run the closed loop and write the results to a new folder."""
    refuse_existing(options.out)  # before warnings, and what takes seconds
    if options.offline and options.mode == 'realtime':
        raise BlfDscError(
            '--mode realtime needs ROS: leave out --offline, which does not wait for the clock'
        )
    with announced_compilation(print_notice):
        config = loop_configuration(options)
        _show_expectations(options.config, config)
    _check_means(options)
    out = make_folder(options.out, BAG)
    clock = 'plant' if config.plant.mode == 'lockstep' else 'wall'
    recorder = {'output': str(out / BAG), 'clock': clock}
    config = config._replace(recorder=change(config.recorder, recorder))
    dump(out / 'config.yaml', config.by_node)
    print_notice(_begun(config.plant, offline=options.offline))
    completed = _run_loop(config, out, options)
    try:
        stopped = _report(out)
    except BlfDscError as error:
        if completed:
            raise
        print(
            f'blf_dsc run: interrupted, and nothing to draw: {error}', file=sys.stderr
        )
    if not completed:
        return INTERRUPTED
    return STOPPED if stopped else 0


def _check_means(options: Namespace) -> None:
    """Raise BlfDscError if a page or ROS is asked for, and cannot be had."""
    if options.view:
        if options.offline:
            raise BlfDscError('--view shows a run over ROS: leave out --offline')
        from blf_dsc_controller.view.page import require_viser  # slow, as below

        require_viser()
    if not options.offline:
        check_network()


def _run_loop(config: LoopConfig, out: Path, options: Namespace) -> bool:
    """Run a loop into the bag of a folder; return whether it ran to its end."""
    if not options.offline:
        from blf_dsc_controller.cli.session import run_session

        return run_session(config, out, view=options.view)
    with announced_compilation(print_notice):
        simulate_into_bag(
            out / BAG,
            config.controller,
            config.plant,
            compression=config.recorder.compression,
        )
    return True


def _begun(plant: PlantConfig, *, offline: bool) -> str:
    """Return what begins, and how long it takes."""
    if offline:
        return f'simulating {plant.duration:g} s, at some ten times real time'
    length = f'{plant.duration:g} s' if plant.duration else 'until Ctrl-C'
    clock = (
        'without waiting for the clock'
        if plant.mode == 'lockstep'
        else 'by the wall clock'
    )
    return f'starting the nodes, some seconds; then they run {length}, {clock}'


def loop_configuration(options: Namespace) -> LoopConfig:
    """Return the configuration of the three nodes, from file and options.

    Raises:
        BlfDscError: it is invalid, or sets no limit to a simulation.
    """
    names = ('duration', 'mode', 'seed', 'physics')
    chosen = {name: getattr(options, name) for name in names}
    given = {name: value for name, value in chosen.items() if value is not None}
    recorded: dict[str, Any] = {'wait_for_subscribers': 1}
    config = load_loop(options.config, {PLANT: given | recorded, CONTROLLER: recorded})
    if options.duration == 0.0 and options.offline:
        raise BlfDscError(
            '--duration 0 is no limit, which --offline cannot have: give a duration in s'
        )
    if config.plant.duration == 0.0 and options.duration is None:
        config = config._replace(plant=change(config.plant, {'duration': _DURATION}))
    return config


def _show_expectations(given: str, config: LoopConfig) -> None:
    """Print warnings of a configuration, read from the file `given`, and the errors to expect.

    Raises:
        StartError: the controller would not take over at the true start.
        MotionError: no approach from there keeps the limits.
    """
    path = locate(given)
    if ignored := ignored_in(path, (PLANT, CONTROLLER)):
        print_notice(f'warning: {ignored}')
    if load(path, DRIVE, DriveConfig).feedback == 'motor':
        raise BlfDscError(
            'drive.feedback is motor, and over a bus, which this simulates, its gains may make '
            'the arm oscillate: '
            f'blf_dsc drive --robot simulated --config {given} simulates the motors'
        )
    controller = config.controller
    if turned := _turned_reference(config):
        print(f'the reference {turned}')
    for warning in config_warnings(controller):
        print(f'warning: {warning}', file=sys.stderr)
    if controller.model == 'urdf':
        print(f'errors to expect: {expectation(controller)}')
        for note in notes_on_ideal_arm(config):
            print_notice(f'note: {note}')
    if end := end_of_waypoints(controller):
        print(end)


def _turned_reference(config: LoopConfig) -> str:
    """Plan the true start; return by which turns the reference is shifted for it, or nothing.

    Raises StartError or MotionError as the controller would.
    """
    controller, plant = config.controller, config.plant
    order = [plant.joints.index(joint) for joint in controller.joints]
    q, dq = (
        np.array(values)[order]
        for values in (plant.initial.position, plant.initial.velocity)
    )
    plan_start(controller, np.array(law_gains(controller).initial_bound), q, dq)
    return reference_near(controller, q)[1]


def notes_on_ideal_arm(config: LoopConfig) -> Iterator[str]:
    """Yield why a simulated arm of a URDF has smaller errors than a real one."""
    plant = config.plant
    if plant.truth == Truth() and not any(plant.joint.stiffness):
        yield (
            'the simulated arm is exactly that of the URDF, on rigid gears: give sim_plant truth, '
            'joint and sensor to make it like a real one (doc/simulation.md)'
        )
    reference = config.controller.reference
    if reference.type == 'hold':
        yield 'reference.type is hold: the arm stays where it is until it is sent a motion'
    if reference.type == 'sinusoids' and not any(reference.amplitude):
        yield (
            'reference.amplitude is 0 for each joint: the arm stays at reference.offset. Give '
            'both, or let blf_dsc excite find them'
        )


def _report(out: Path) -> bool:
    """Draw and summarise the bag of a run; return whether the controller stopped in it."""
    # slow: the libraries of the pictures
    from blf_dsc_controller.analysis.figures import draw
    from blf_dsc_controller.analysis.metrics import measure
    from blf_dsc_controller.analysis.metrics_table import format_table
    from blf_dsc_controller.analysis.output import write_json

    print_notice('reading the bag and drawing the pictures: some seconds')
    content = read_content(out / BAG)
    recorded = recorded_run(content)
    metrics = measure(recorded)
    write_json(metrics, out / 'summary.json')
    pictures = draw(recorded, out, metrics)
    print(format_table(metrics))
    print_softer_gains_of(recorded, content)
    for topic, text in content.losses.items():
        print(f'warning: messages of {topic} are missing in the bag: {text}')
    print(
        f'wrote       {out}: bag, summary.json, {", ".join(path.name for path in pictures)}'
    )
    last = recorded.stamp[-1]  # the plant ends after it, so the controller times out
    return any(
        stop.stamp < last or stop.reason != Reason.STATE_TIMEOUT
        for stop in recorded.stops
    )
