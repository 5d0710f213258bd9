# SPDX-License-Identifier: Apache-2.0
"""The sub-commands of `blf_dsc`: what each does, and its options."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

PICK_UP = Path()
"""Value of `identify --payload` without a bag."""

_BAG = 'folder of the bag, or its .mcap, .db3 or .bag file'
_CONFIG = 'parameter file, or a preset (recommended)'
_WIDTH = 88
_Command: TypeAlias = Callable[..., Callable[..., Any]]


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; the option `handler` is the (module, function) of a sub-command."""
    parser = argparse.ArgumentParser(
        prog='blf_dsc',
        description='Output-constrained tracking control of robot arms: run it, look at its bags, '
        'study it.',
        epilog='blf_dsc COMMAND --help lists the options of a command, with an example.',
    )
    commands = parser.add_subparsers(title='commands', dest='command', metavar='COMMAND')

    def command(
        module: str,
        name: str,
        summary: str,
        about: str,
        example: str,
        *shared: argparse.ArgumentParser,
    ) -> Callable[..., Any]:
        """Add a command with these shared options, and return what adds its own."""
        made = commands.add_parser(
            name,
            help=summary,
            description=textwrap.fill(about, _WIDTH),
            epilog=f'Example:\n  blf_dsc {name} {example}',
            formatter_class=argparse.RawDescriptionHelpFormatter,
            parents=shared,
        )
        made.set_defaults(handler=(module, name.replace('-', '_')))
        return made.add_argument

    _add_run(partial(command, 'run'))
    _add_bags(partial(command, 'bags'))
    _add_identification(partial(command, 'identify'))
    _add_studies(partial(command, 'studies'))
    return parser


def _shared(*names: str, **options: Any) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument(*names, **options)
    return parser


_NAMES = _shared(
    '--map',
    action='append',
    default=[],
    metavar='OURS=THEIRS',
    help='name of a topic or a joint in the bag, such as commands=/arm/torque or joint1=shoulder',
)
_NAMES.add_argument('--namespace', default='', help='robot to use, if a bag holds several')
_FORCE = _shared('--force', action='store_true', help='overwrite existing files')


def _add_run(command: _Command) -> None:
    option = command(
        'run',
        'run the closed loop and plot the results',
        'Run the simulated arm, the controller and the recorder over ROS 2, and leave a bag, '
        'pictures and summary.json in a new folder. Exit code: 0 done, 5 the controller stopped '
        'before the end, 130 interrupted, 1 an error.',
        '--config noisy --duration 30 --mode realtime --out first',
    )
    option('--config', default='recommended', help=_CONFIG)
    option('--duration', type=float, help='simulated time [s] (as configured, or else 60)')
    option('--mode', choices=('realtime', 'lockstep'), help='mode of the plant (as configured)')
    option('--seed', type=int, help='seed of the sensor noise (as configured)')
    option('--offline', action='store_true', help='without ROS: no processes, no topics')
    option('--domain', type=int, help='ROS domain (a free one)')
    option('--out', type=Path, help='new folder (closed_loop, closed_loop-2, ...)')
    option('--view', action='store_true', help='show the run on a page in the browser')
    option('--view-host', default='127.0.0.1', help='address of that page (127.0.0.1)')
    option = command(
        'precompile',
        'compile the kernels of a configuration before its first start',
        'Compile the kernels of the controller and the simulated arm of a configuration into the '
        "user's cache (NUMBA_CACHE_DIR, or ~/.cache/blf_dsc_controller), so that their nodes start "
        'within seconds: after an installation, or when a container is built.',
        '--config my.yaml',
    )
    option('--config', default='recommended', help=_CONFIG)


def _add_bags(command: _Command) -> None:
    option = command(
        'replay',
        'run a bag through the controller again and compare bit for bit',
        'Feed the joint states of a bag through the controller with the recorded configuration, '
        'and compare every output bit for bit; or with --play, publish it. Exit code: 0 all '
        'outputs are bit-equal, 3 some differ, 4 some could not be compared and the others are '
        'bit-equal, 1 an error.',
        'run1/bag',
        _NAMES,
    )
    option('bag', type=Path, help=_BAG)
    option('--play', action='store_true', help='publish the recorded topics over ROS')
    option('--rate', type=float, default=1.0, help='speed of it; 0: as fast as possible (1)')
    option('--topics', nargs='+', default=[], metavar='TOPIC', help='topics to play (all)')
    option('--clock', action='store_true', help='publish the time of the bag on /clock')
    option = command(
        'report',
        'show one or several bags on one HTML page',
        'Write one HTML page that shows a bag, or several overlaid: zoomable plots, events, '
        'configuration and the moving arm. It needs no network.',
        'run1/bag run2/bag --out comparison.html',
        _NAMES,
        _FORCE,
    )
    option('bags', type=Path, nargs='+', metavar='BAG', help=_BAG)
    option('--out', type=Path, default=Path('report.html'), help='file (report.html)')
    option = command(
        'view',
        'show a running system, or a bag, on a page in the browser',
        'Serve a page with the arm in 3D, its errors inside their bounds, torques and estimates: '
        'of the system running in this ROS domain, with buttons and sliders, or of a bag, with '
        'play and pause. It needs no network, and by default only this computer can open it.',
        'run1/bag',
        _NAMES,
    )
    option('bag', type=Path, nargs='?', help=f'{_BAG}; without it: the running system')
    option('--host', default='127.0.0.1', help='address to serve at (127.0.0.1)')
    option('--port', type=int, default=8080, help='port, or the next free one (8080)')
    option = command(
        'recover',
        'make a clean bag from a damaged one',
        'Make a clean bag from one that was cut off or damaged, and list what was lost. The '
        'damaged bag is not touched. Exit code: 1 if nothing could be recovered.',
        'run1/bag --out rescued',
    )
    option('bag', type=Path, help='folder of the bag, or its .mcap file')
    option('--out', type=Path, help='new folder (BAG_recovered)')
    option = command(
        'export',
        'write a bag as a table, in CSV or Parquet',
        'Write the series of a bag as one table with a row for each joint state.',
        'run1/bag --out run1.csv',
        _NAMES,
        _FORCE,
    )
    option('bag', type=Path, help=_BAG)
    option('--out', type=Path, required=True, help='FILE.csv or FILE.parquet')
    option = command(
        'plot',
        'plot and summarise a bag',
        'Draw the pictures of a bag (tracking.png, ...) and write summary.json.',
        'run1/bag --out pictures',
        _NAMES,
        _FORCE,
    )
    option('bag', type=Path, help=_BAG)
    option('--out', type=Path, default=Path(), help='folder to write into (.)')


def _add_identification(command: _Command) -> None:
    option = command(
        'excite',
        'find a reference that excites the learning',
        'Find the sum of sinusoids with the period of the learning window that excites the '
        'learning most within the joint and torque limits, and write it as a preset. The links of '
        'a URDF arm also keep their distance from each other and from the floor, and the '
        'parameters that the motion does not show are listed.',
        'exciting.yaml --config my.yaml',
        _FORCE,
    )
    option('out', type=Path, help='parameter file to write')
    option('--config', default='recommended', help=_CONFIG)
    option(
        '--guess',
        type=float,
        nargs='+',
        help='parameters P for computing the torque (learning.initial_estimate; for a URDF, with '
        'and without its payload)',
    )
    option('--harmonics', type=int, default=3, help='number of harmonics of the window (3)')
    option('--starts', type=int, default=4, help='number of searches; the best result is kept (4)')
    option('--radius', type=float, default=0.07, help='radius of the links of a URDF [m] (0.07)')
    option('--floor', type=float, default=0.0, help='height of the floor in the base frame [m] (0)')
    option = command(
        'identify',
        'correct the inertias and friction of a URDF from a bag',
        'Identify an arm from the positions and efforts of any bag: write its URDF with physical '
        'inertias that reproduce the torques and are closest to the original ones, and print what '
        'changed, with 95 % intervals, and the torque error on the last fifth of the motion, which '
        'was held back. With --payload, weigh what the arm holds.',
        'run1/bag --urdf robot.urdf --out corrected.urdf --report page.html\n'
        '  blf_dsc identify empty/bag --urdf robot.urdf --payload loaded/bag',
        _NAMES,
        _FORCE,
    )
    option('bag', type=Path, help=_BAG)
    option('--urdf', required=True, help='URDF: a file, package://name/path, or a file in config/')
    option('--out', type=Path, help='URDF to write')
    option('--report', type=Path, help='page with pictures and tables to write')
    option(
        '--payload',
        type=Path,
        nargs='?',
        const=PICK_UP,
        metavar='BAG',
        help='identify a load: carried in this other bag, or without one, picked up in the first',
    )
    option(
        '--effort',
        choices=('torque', 'without-gravity', 'command'),
        default='torque',
        help='what efforts are: whole torque, or without that of gravity; or use commands (torque)',
    )
    per_effort = 'torque per effort of each joint, for currents [N m/A]'
    option('--gains', type=float, nargs='+', default=(), help=per_effort)
    option('--base', default='', help='fixed link (the root)')
    option('--tip', default='', help='last link (that of the last joint in the bag)')
    option(
        '--gravity',
        type=float,
        nargs=3,
        default=(0.0, 0.0, -9.81),
        metavar=('X', 'Y', 'Z'),
        help='gravity in the base frame [m/s^2] (0 0 -9.81)',
    )
    largest = 'largest mass on the last link that is not in the URDF [kg] (3)'
    option('--rated-payload', type=float, default=3.0, help=largest)


def _add_studies(command: _Command) -> None:
    option = command(
        'paper',
        "compare all laws in the paper's simulation",
        "Run the paper's simulation with every law, check its claims, and find where each law "
        'breaks; offline, on all cores.',
        '--out paper_study',
    )
    option('--out', type=Path, default=Path('paper_study'), help='new folder for the report')
    option = command(
        'arms',
        'compare laws on arms whose URDF is wrong',
        'Tune each law on one arm with wrong masses, run it on others, and write a page of the '
        'errors; offline, on all cores, about ten minutes on two.',
        '--config panda --out arms',
    )
    option('--config', nargs='+', default=['panda', 'ur5e'], help='presets or files (panda ur5e)')
    laws = 'laws of the study by name, or Python files that add some (all of the study)'
    option('--laws', nargs='+', default=[], metavar='LAW', help=laws)
    option('--truths', type=int, default=5, help='runs of each law after tuning (5)')
    option('--generations', type=int, default=7, help='generations of tuning after the first (7)')
    option('--out', type=Path, default=Path('arms'), help='new folder for the page')
    option = command(
        'monte-carlo',
        'run a study of many random plants',
        'Run thousands of closed loops with random plants, in parallel, and report how many kept '
        'the bound. Interrupted studies resume: start the same command again.',
        '--config my_study.yaml --out study\n  blf_dsc monte-carlo --reproduce study 365',
    )
    option('--config', default='monte_carlo', help='study file, or a preset (monte_carlo)')
    option('--runs', type=int, help='number of runs (as configured)')
    option('--seed', type=int, help='seed of the study (as configured)')
    engines, computing = ('processes', 'dask'), 'engine that computes the runs (processes)'
    option('--engine', choices=engines, default='processes', help=computing)
    option('--workers', type=_positive, help='number of workers (one per core of this computer)')
    option('--address', default='', help='scheduler of a dask cluster (a local one)')
    option('--chunk', type=_positive, help='runs handed to a worker at a time')
    option('--report', type=Path, metavar='DIR', help='only report the study in this folder')
    again = 'compute one run of a study again, with a bag and pictures, into --out'
    option('--reproduce', nargs=2, metavar=('DIR', 'RUN'), help=again)
    option('--out', type=Path, help='folder of the study (monte_carlo)')


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{text} is not above 0')
    return value
