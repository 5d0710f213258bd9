# SPDX-License-Identifier: Apache-2.0
"""`closed_loop`: arm, controller and recorder in one command, with a bag and pictures of it."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from blf_dsc_controller.bags.offline import write_bag
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.dump import dump
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, RECORDER, LoopConfig
from blf_dsc_controller.configuration.params_file import load_loop, locate
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.reports.figures import draw
from blf_dsc_controller.reports.summary import summarize, write_summary
from blf_dsc_controller.reports.table import format_table
from blf_dsc_controller.simulation import Record, simulate
from blf_dsc_controller.tools.entry import require_ros
from blf_dsc_controller.tools.processes import NodeProcess
from blf_dsc_controller.tools.progress import Progress

_MODULES = {
    RECORDER: 'blf_dsc_controller.nodes.recorder_node',
    CONTROLLER: 'blf_dsc_controller.nodes.controller_node',
    PLANT: 'sim_plant.node',
}
_INTERRUPTED = 130
_DOMAINS = 100  # below the ports that the system hands out


class OutputExistsError(BlfDscError):
    """The folder for the results is there already."""

    def __init__(self, path: Path) -> None:
        self.path = path
        super().__init__(f'{path} exists already and is not overwritten: choose another --out')


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
    options.add_argument('--duration', type=float, help='simulated time [s] (60)')
    options.add_argument(
        '--mode', choices=('realtime', 'lockstep'), help='of the plant (as configured)'
    )
    options.add_argument('--seed', type=int, help='of the sensor noise (as configured)')
    options.add_argument(
        '--offline', action='store_true', help='the same without ROS: no processes, no topics'
    )
    options.add_argument('--domain', type=int, help='ROS domain (one of its own)')
    options.add_argument(
        '--out', type=Path, default=Path('closed_loop'), help='new folder for the results'
    )
    return options


def configure(options: argparse.Namespace) -> LoopConfig:
    """Configuration of the three nodes, from the file and the options that override it."""
    plant = {
        name: value
        for name, value in (
            ('duration', options.duration),
            ('mode', options.mode),
            ('seed', options.seed),
        )
        if value is not None
    }
    path = locate(options.config)
    if 'duration' not in plant and load_loop(path).plant.duration == 0.0:
        plant['duration'] = 60.0
    overrides: dict[str, dict[str, Any]] = {
        PLANT: {**plant, 'wait_for_subscribers': 1},
        CONTROLLER: {'wait_for_subscribers': 1},
        RECORDER: {'output': str(options.out / 'bag')},
    }
    return load_loop(path, overrides)


def run_offline(config: LoopConfig, bag: Path) -> None:
    """Run the compiled loop and write its bag."""
    progress = Progress(config.plant)
    bound = config.controller.barrier.bound

    def show(record: Record, rows: int) -> None:
        n = record.joints
        errors = abs(record.samples[:rows, 2 * n : 3 * n]) / bound
        estimate = record.sample(rows - 1).estimate[:3]
        progress.show(record.stamps[rows - 1] * 1e-9, errors.max(), estimate)

    record = simulate(config.controller, config.plant, show)
    progress.close()
    write_bag(bag, record, config.controller, config.recorder.compression)


def run_over_ros(config: LoopConfig, out: Path, domain: int) -> bool:
    """Run the three nodes until the plant has ended; False if the user ended it before.

    Raises:
        NoRosError: rclpy is not installed.
        NodeFailedError: a node ended with an error.
    """
    require_ros()
    logs = out / 'logs'
    logs.mkdir()
    environment = {
        'ROS_DOMAIN_ID': str(domain),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_LOG_DIR': str(logs / 'ros'),
    }
    os.environ.update(environment)
    nodes = [
        NodeProcess(name, module, out / 'config.yaml', logs / f'{name}.log', environment)
        for name, module in _MODULES.items()
    ]
    recorder, controller, plant = nodes
    from blf_dsc_controller.tools.watch import Watch

    completed = True
    try:
        with Watch(config.plant) as watch:
            while plant.is_running:
                for node in nodes:
                    node.check()
                watch.wait(0.1)
        plant.check()
    except KeyboardInterrupt:
        completed = False
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    finally:
        # The recorder last: it is to have what the others say until their end.
        for node in (plant, controller, recorder):
            node.stop()
    recorder.check()
    return completed


def report(out: Path) -> None:
    """Draw and summarise the bag of a run."""
    run = read_run(out / 'bag')
    summary = summarize(run)
    write_summary(summary, out / 'summary.json')
    draw(run, out)
    print(format_table(summary))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        config = configure(options)
        if options.out.exists():
            raise OutputExistsError(options.out)
        options.out.mkdir(parents=True)
        dump(options.out / 'config.yaml', config.by_node)
        completed = True
        if options.offline:
            run_offline(config, options.out / 'bag')
        else:
            domain = os.getpid() % _DOMAINS + 1 if options.domain is None else options.domain
            completed = run_over_ros(config, options.out, domain)
        report(options.out)
    except BlfDscError as error:
        print(f'closed_loop: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return _INTERRUPTED
    return 0 if completed else _INTERRUPTED


if __name__ == '__main__':
    sys.exit(main())
