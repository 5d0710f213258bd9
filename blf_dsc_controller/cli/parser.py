# SPDX-License-Identifier: Apache-2.0
"""The sub-commands of `blf_dsc`: what each does, and its options."""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path

_BAG = 'folder of the bag, or its .mcap, .db3 or .bag file'
_WIDTH = 88


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
        name: str, module: str, summary: str, about: str, example: str
    ) -> argparse.ArgumentParser:
        parser_of = commands.add_parser(
            name,
            help=summary,
            description=textwrap.fill(about, _WIDTH),
            epilog=f'Example:\n  blf_dsc {name} {example}',
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        parser_of.set_defaults(handler=(module, name.replace('-', '_')))
        return parser_of

    _run_options(
        command(
            'run',
            'run',
            'run the closed loop and plot the results',
            'Run the simulated arm, the controller and the recorder over ROS 2, and leave a '
            'bag, pictures and summary.json in a new folder. '
            'Exit code: 0 done, 5 the controller stopped before the end, 130 interrupted, '
            '1 an error.',
            '--config noisy --duration 30 --mode realtime --out first',
        )
    )
    precompile = command(
        'precompile',
        'run',
        'compile the kernels of a configuration before its first start',
        'Compile the kernels of the controller and the simulated arm of a configuration into the '
        "user's cache (NUMBA_CACHE_DIR, or ~/.cache/blf_dsc_controller), so that their nodes start "
        'within seconds: after an installation, or when a container is built.',
        '--config my.yaml',
    )
    precompile.add_argument(
        '--config', default='recommended', help='parameter file, or a preset (recommended)'
    )
    _replay_options(
        command(
            'replay',
            'bags',
            'run a bag through the controller again and compare bit for bit',
            'Feed the joint states of a bag through the controller with the recorded '
            'configuration, and compare every output bit for bit. '
            'Exit code: 0 all outputs are bit-equal, 3 some differ, 4 some could not be compared '
            'and the others are bit-equal, 1 an error.',
            'run1/bag --config my.yaml',
        )
    )
    report = command(
        'report',
        'bags',
        'show one or several bags on one HTML page',
        'Write one HTML page that shows a bag, or several overlaid: zoomable plots, '
        'events, configuration and the moving arm. It needs no network.',
        'run1/bag run2/bag --out comparison.html',
    )
    report.add_argument('bags', type=Path, nargs='+', metavar='BAG', help=_BAG)
    report.add_argument('--out', type=Path, default=Path('report.html'), help='file (report.html)')
    view = command(
        'view',
        'bags',
        'show a running system, or a bag, on a page in the browser',
        'Serve a page with the arm in 3D, its errors inside their bounds, torques and estimates: '
        'of the system running in this ROS domain, with buttons and sliders, or of a bag, with '
        'play and pause. It needs no network, and by default only this computer can open it.',
        'run1/bag',
    )
    view.add_argument('bag', type=Path, nargs='?', help=f'{_BAG}; without it: the running system')
    view.add_argument('--host', default='127.0.0.1', help='address to serve at (127.0.0.1)')
    view.add_argument('--port', type=int, default=8080, help='port, or the next free one (8080)')
    recover = command(
        'recover',
        'bags',
        'make a clean bag from a damaged one',
        'Make a clean bag from one that was cut off or damaged, and list what was lost. '
        'The damaged bag is not touched. Exit code: 1 if nothing could be recovered.',
        'run1/bag --out rescued',
    )
    recover.add_argument('bag', type=Path, help='folder of the bag, or its .mcap file')
    recover.add_argument('--out', type=Path, help='new folder (BAG_recovered)')
    export = command(
        'export',
        'bags',
        'write a bag as a table, in CSV or Parquet',
        'Write the series of a bag as one table with a row for each joint state.',
        'run1/bag --out run1.csv',
    )
    export.add_argument('bag', type=Path, help=_BAG)
    export.add_argument('--out', type=Path, required=True, help='FILE.csv or FILE.parquet')
    plot = command(
        'plot',
        'bags',
        'plot and summarise a bag',
        'Draw the pictures of a bag (tracking.png, ...) and write summary.json.',
        'run1/bag --out pictures',
    )
    plot.add_argument('bag', type=Path, help=_BAG)
    plot.add_argument('--out', type=Path, default=Path(), help='folder to write into (.)')
    for command_parser in (report, view, export, plot):
        _map(command_parser)
        _namespace(command_parser)
    for command_parser in (report, export, plot):
        _force(command_parser)
    _excite_options(
        command(
            'excite',
            'identify',
            'find a reference that excites the learning',
            'Find the sum of sinusoids with the period of the learning window that excites the '
            'learning most within the joint and torque limits, and write it as a preset. The links '
            'of a URDF arm also keep their distance from each other and from the floor, and the '
            'parameters that the motion does not show are listed.',
            'exciting.yaml --config my.yaml',
        )
    )
    _identify_options(
        command(
            'identify',
            'identify',
            'correct the inertias and friction of a URDF from a bag',
            'Identify an arm from the positions and efforts of any bag: write its URDF with '
            'physical inertias that reproduce the torques and are closest to the original ones, '
            'and print what changed, with 95 % intervals, and the torque error on the last fifth '
            'of the motion, which was held back. With --payload, weigh what the arm holds.',
            'run1/bag --urdf robot.urdf --out corrected.urdf --report page.html\n'
            '  blf_dsc identify empty/bag --urdf robot.urdf --payload loaded/bag',
        )
    )
    paper = command(
        'paper',
        'studies',
        "compare all laws in the paper's simulation",
        "Run the paper's simulation with every law, check its claims, and find where each law "
        'breaks; offline, on all cores.',
        '--out paper_study',
    )
    paper.add_argument(
        '--out', type=Path, default=Path('paper_study'), help='new folder for the report'
    )
    arms = command(
        'arms',
        'studies',
        'compare laws on arms whose URDF is wrong',
        'Tune each law on one arm with wrong masses, run it on others, and write a page of the '
        'errors; offline, on all cores, about ten minutes on two.',
        '--config panda --out arms',
    )
    option = arms.add_argument
    option('--config', nargs='+', default=['panda', 'ur5e'], help='presets or files (panda ur5e)')
    option(
        '--laws',
        nargs='+',
        default=[],
        metavar='LAW',
        help='laws of the study by name, or Python files that add some (all of the study)',
    )
    option('--truths', type=int, default=5, help='runs of each law after tuning (5)')
    option('--generations', type=int, default=7, help='generations of tuning after the first (7)')
    option('--out', type=Path, default=Path('arms'), help='new folder for the page')
    _monte_carlo_options(
        command(
            'monte-carlo',
            'studies',
            'run a study of many random plants',
            'Run thousands of closed loops with random plants, in parallel, and report how many '
            'kept the bound. Interrupted studies resume: start the same command again.',
            '--config my_study.yaml --out study\n  blf_dsc monte-carlo --reproduce study 365',
        )
    )
    return parser


def _namespace(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--namespace', default='', help='robot to use, if a bag holds several')


def _force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--force', action='store_true', help='overwrite existing files')


def _map(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--map',
        action='append',
        default=[],
        metavar='OURS=THEIRS',
        help='name of a topic or a joint in the bag, such as commands=/arm/torque or '
        'joint1=shoulder',
    )


def _run_options(parser: argparse.ArgumentParser) -> None:
    option = parser.add_argument
    option('--config', default='recommended', help='parameter file, or a preset (recommended)')
    option('--duration', type=float, help='simulated time [s] (as configured, or else 60)')
    option('--mode', choices=('realtime', 'lockstep'), help='mode of the plant (as configured)')
    option('--seed', type=int, help='seed of the sensor noise (as configured)')
    option('--offline', action='store_true', help='without ROS: no processes, no topics')
    option('--domain', type=int, help='ROS domain (a free one)')
    option('--out', type=Path, help='new folder (closed_loop, closed_loop-2, ...)')
    option('--view', action='store_true', help='show the run on a page in the browser')
    option('--view-host', default='127.0.0.1', help='address of that page (127.0.0.1)')


def _replay_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bag', type=Path, help=_BAG)
    parser.add_argument(
        '--config', help='parameter file or preset: show what it would have commanded (open loop)'
    )
    _map(parser)
    _namespace(parser)
    option = parser.add_argument_group('playing over ROS').add_argument
    option('--play', action='store_true', help='publish the recorded topics')
    option('--rate', type=float, default=1.0, help='speed; 0: as fast as possible (1)')
    option('--topics', nargs='+', default=[], metavar='TOPIC', help='topics to play (all)')
    option('--clock', action='store_true', help="publish the bag's time on /clock")


def _excite_options(parser: argparse.ArgumentParser) -> None:
    option = parser.add_argument
    option('out', type=Path, help='parameter file to write')
    _force(parser)
    option('--config', default='recommended', help='parameter file, or a preset (recommended)')
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


PICK_UP = Path()
"""Value of `identify --payload` without a bag."""


def _identify_options(parser: argparse.ArgumentParser) -> None:
    option = parser.add_argument
    option('bag', type=Path, help=_BAG)
    option('--urdf', required=True, help='URDF: a file, package://name/path, or a file in config/')
    option('--out', type=Path, help='URDF to write')
    option('--report', type=Path, help='page with pictures and tables to write')
    _force(parser)
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
    option(
        '--gains',
        type=float,
        nargs='+',
        default=(),
        help='torque per effort of each joint, for currents [N m/A]',
    )
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
    option(
        '--rated-payload',
        type=float,
        default=3.0,
        help='largest mass on the last link that is not in the URDF [kg] (3)',
    )
    _map(parser)
    _namespace(parser)


def _monte_carlo_options(parser: argparse.ArgumentParser) -> None:
    option = parser.add_argument
    option('--config', default='monte_carlo', help='study file, or a preset (monte_carlo)')
    option('--runs', type=int, help='number of runs (as configured)')
    option('--seed', type=int, help='seed of the study (as configured)')
    option(
        '--engine',
        choices=('processes', 'dask'),
        default='processes',
        help='engine that computes the runs (processes)',
    )
    option('--workers', type=_positive, help='number of workers (one per core)')
    option('--address', default='', help='scheduler of a dask cluster (a local one)')
    option('--chunk', type=_positive, help='runs handed to a worker at a time')
    option('--report', type=Path, metavar='DIR', help='only report the study in this folder')
    option(
        '--reproduce',
        nargs=2,
        metavar=('DIR', 'RUN'),
        help='compute one run of a study again, with a bag and pictures, into --out',
    )
    option('--out', type=Path, help='folder of the study (monte_carlo)')


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{text} is not above 0')
    return value
