# SPDX-License-Identifier: Apache-2.0
"""`closed_loop`: arm, controller and recorder in one command, with a bag and pictures of it."""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.figures import draw
from blf_dsc_controller.analysis.summary import summarize, write_summary
from blf_dsc_controller.analysis.table import format_table
from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.cli.domain import own_domain
from blf_dsc_controller.cli.entry import require_ros
from blf_dsc_controller.cli.output_folder import DEFAULT, OutputError, make_folder
from blf_dsc_controller.cli.processes import NodeFailedError
from blf_dsc_controller.cli.progress import Progress
from blf_dsc_controller.cli.session import run_session
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, LoopConfig
from blf_dsc_controller.configuration.params_file import dump, load_loop, locate
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.law.rejected_columns import refusals
from blf_dsc_controller.nodes import compilation
from blf_dsc_controller.reference.approach import plan_start
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import Record, loop, simulate
from blf_dsc_controller.supervision.config_warnings import concerns
from sim_plant import plant as plant_kernels

_INTERRUPTED = 130
_ROOM = 1_000_000  # bytes that a log needs at least
_DURATION = 60.0  # s, where neither the file nor an option says how long


def parser() -> argparse.ArgumentParser:
    """Command-line options."""
    options = argparse.ArgumentParser(
        prog='closed_loop',
        description='Run the simulated arm, the controller and the recorder over ROS 2, and draw '
        'what they did.',
    )
    options.add_argument(
        '--config', default='recommended', help='parameter file, or a preset (recommended)'
    )
    options.add_argument(
        '--duration', type=float, help='simulated time [s] (as configured, or else 60)'
    )
    options.add_argument(
        '--mode', choices=('realtime', 'lockstep'), help='of the plant (as configured)'
    )
    options.add_argument('--seed', type=int, help='of the sensor noise (as configured)')
    options.add_argument(
        '--offline', action='store_true', help='the same without ROS: no processes, no topics'
    )
    options.add_argument('--domain', type=int, help='ROS domain (one that is free)')
    options.add_argument(
        '--out', type=Path, help=f'new folder for the results ({DEFAULT}, {DEFAULT}-2, ...)'
    )
    return options


def configure(options: argparse.Namespace) -> LoopConfig:
    """Configuration of the three nodes, from the file and the options that override it.

    Raises:
        ConfigurationError: the file and the options do not describe a loop.
        OutsideBarrierError: the arm starts outside the bound, and there is to be no approach.
        MotionError: there is no approach within the limits.
    """
    chosen = {'duration': options.duration, 'mode': options.mode, 'seed': options.seed}
    plant = {name: value for name, value in chosen.items() if value is not None}
    path = locate(options.config)
    overrides: dict[str, dict[str, Any]] = {
        PLANT: {**plant, 'wait_for_subscribers': 1},
        CONTROLLER: {'wait_for_subscribers': 1},
    }
    config = load_loop(path, overrides)
    if config.plant.duration == 0.0:
        overrides[PLANT]['duration'] = _DURATION
        config = load_loop(path, overrides)
    _check_start(config)
    return config


def _check_start(config: LoopConfig) -> None:
    """Find a start that will be refused now, by the true state; the controller measures it."""
    controller, plant = config.controller, config.plant
    order = [plant.joints.index(joint) for joint in controller.joints]
    plan_start(
        controller,
        np.array(controller.barrier.widest),
        np.array(plant.initial.position)[order],
        np.array(plant.initial.velocity)[order],
    )


def run_offline(config: LoopConfig, bag: Path) -> None:
    """Run the compiled loop and write its bag."""
    _announce(loop)
    progress = Progress(config.plant)

    def show(record: Record, rows: int) -> None:
        n = record.joints
        errors = abs(record.samples[:rows, 2 * n : 3 * n] / record.samples[:rows, 6 * n : 7 * n])
        estimate = record.sample(rows - 1).estimate[:3]
        progress.show(record.stamps[rows - 1] * 1e-9, errors.max(), estimate)

    record = simulate(config.controller, config.plant, show)
    progress.close()
    for refusal in refusals(record.controller, estimate_names(config.controller)):
        print(f'warning: {refusal}')
    write_bag(bag, record, config.controller, config.recorder.compression, config.plant)


def run_over_ros(config: LoopConfig, out: Path, domain: int | None) -> bool:
    """Run the three nodes, in a free domain if none is given; False if a signal ended it."""
    _announce(*compilation.CONTROLLER, *plant_kernels.KERNELS)
    with own_domain() if domain is None else nullcontext(domain) as chosen:
        return run_session(config.plant, out, chosen)


def _announce(*kernels: Any) -> None:
    if not compilation.is_compiled(*kernels):
        print(compilation.NOTICE, file=sys.stderr, flush=True)


def report(out: Path) -> None:
    """Draw and summarise the bag of a run."""
    run = read_run(out / 'bag')
    summary = summarize(run)
    write_summary(summary, out / 'summary.json')
    pictures = draw(run, out)
    print(format_table(summary))
    for topic, text in read_context(out / 'bag').losses.items():
        print(f'warning: the bag does not hold all of {topic}: {text}')
    print(f'wrote       {out}: bag, summary.json, {", ".join(path.name for path in pictures)}')


def _run(options: argparse.Namespace) -> int:
    config = configure(options)
    order = [config.plant.joints.index(joint) for joint in config.controller.joints]
    for concern in concerns(config.controller, np.array(config.plant.initial.position)[order]):
        print(f'warning: {concern}', file=sys.stderr)
    if not options.offline:
        require_ros()
    out = make_folder(options.out)
    try:
        recorder = {'output': str(out / 'bag')}
        config = config._replace(recorder=change(config.recorder, recorder))
        dump(out / 'config.yaml', config.by_node)
        completed = True
        if options.offline:
            run_offline(config, out / 'bag')
        else:
            completed = run_over_ros(config, out, options.domain)
        _report_of(out, completed=completed)
    except NodeFailedError:
        if shutil.disk_usage(out).free < _ROOM:
            print(f'there is no room left on the disk of {out}', file=sys.stderr)
        if (out / 'bag' / 'metadata.yaml').exists():
            print(f'what was recorded until then is in {out / "bag"}', file=sys.stderr)
        raise
    except OSError as error:
        raise OutputError(out, error) from error
    return 0 if completed else _INTERRUPTED


def _report_of(out: Path, *, completed: bool) -> None:
    try:
        report(out)
    except BlfDscError as error:
        if completed:
            raise
        print(f'closed_loop: interrupted, and nothing to draw: {error}', file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return _run(options)
    except BlfDscError as error:
        print(f'closed_loop: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('closed_loop: interrupted', file=sys.stderr)
        return _INTERRUPTED


if __name__ == '__main__':
    sys.exit(main())
