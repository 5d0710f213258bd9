# SPDX-License-Identifier: Apache-2.0
"""Sub-commands of `blf_dsc`, and their options."""

from __future__ import annotations

import argparse
import difflib
import math
import os
import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from blf_dsc_controller import __version__

_BAG = 'folder of the bag, or its .mcap, .db3 or .bag file'
_CONFIG = 'parameter file, or a preset (recommended)'
_OF_URDF = 'parameter file of an arm from a URDF, or a preset, such as ur5e'
_WIDTH = 88
_MOVED = {'paper': 'paper', 'tool': 'tool-bound', 'contacts': 'contacts'}
"""Commands of earlier versions, by their tables of `benchmark`."""
_OTHERS = {'view': 'blf_dsc run --view shows a run, arm_view a running loop'}
"""What is meant by words that are no command."""
_Command: TypeAlias = Callable[..., Callable[..., Any]]


class _Parser(argparse.ArgumentParser):
    """Parser whose errors are one line, with an example of what to type."""

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        help_line = f'{self.prog} --help'
        examples = (self.epilog or '').partition('Example:')[2].split('\n')[1:]
        if examples:
            help_line = f'for example: {examples[0].strip()} ({help_line})'
        else:
            help_line = f'see {help_line}'
        self.exit(2, f'{self.prog}: {message}; {help_line}\n')

    def takes(self, word: str) -> bool:
        """Whether a word is an option of this command, other than that for help."""
        return word in {*self._option_string_actions} - {'-h', '--help'}

    def refuse(self, unknown: str) -> NoReturn:
        """Exit with code 2 because of a word that this command does not take."""
        options = self._option_string_actions
        name = unknown.partition('=')[0]
        if name.startswith('-'):
            close = difflib.get_close_matches(name, options, n=1)
            guess = f', did you mean {close[0]}?' if close else ''
            self.error(f'no option {name}{guess}')
        if '--config' in options:
            self.error(f'no argument {unknown}: a file or preset is --config {unknown}')
        self.error(f'no argument {unknown}')


def parse(
    parser: argparse.ArgumentParser, words: Sequence[str], given: argparse.Namespace
) -> argparse.Namespace:
    """Add the options of a command line to those given, or exit with what is wrong."""
    options, unknown = parser.parse_known_args(words, given)
    if unknown:
        of_command = parser.get_default('commands').get(options.command, parser)
        of_command.refuse(unknown[0])
    return options


def make_parser() -> argparse.ArgumentParser:
    """Return the parser.

    The option `handler` is the (module, function) of a sub-command.
    """
    parser = _Parser(
        prog='blf_dsc',
        description='Track a trajectory within a bound, with a robot arm whose masses are '
        'unknown: run the controller, examine bags, identify arms, study laws.',
        epilog='blf_dsc COMMAND --help lists the options of a command, with an example.',
    )
    parser.add_argument(
        '--version', action='version', version=f'blf_dsc_controller {__version__}'
    )
    commands = parser.add_subparsers(
        title='commands', dest='command', metavar='COMMAND'
    )

    def command(
        module: str,
        name: str,
        about: str,
        example: str,
        *shared: _Parser,
    ) -> Callable[..., Any]:
        """Add a command with these shared options, and return what adds its own."""
        made = commands.add_parser(
            name,
            help=about.partition('. ')[0].rstrip('.'),
            description=textwrap.fill(about, _WIDTH),
            epilog=f'Example:\n  blf_dsc {name} {example}',
            formatter_class=argparse.RawDescriptionHelpFormatter,
            parents=shared,
        )
        made.set_defaults(handler=(module, name.replace('-', '_')))
        return made.add_argument

    names, force = (_Parser(add_help=False) for _ in range(2))
    theirs = (
        'what a topic or a joint is called in the bag, such as joint1=shoulder; or which '
        'columns of a table are the time=, q= and tau=, and theta= of motors; can be repeated'
    )
    names.add_argument(
        '--map', action='append', default=[], metavar='OURS=THEIRS', help=theirs
    )
    names.add_argument(
        '--namespace', default='', help='robot to use, if a bag holds several'
    )
    force.add_argument('--force', action='store_true', help='overwrite existing files')
    _add_run(partial(command, 'run'))
    _add_drive(partial(command, 'drive'))
    _add_bags(partial(command, 'bags'), names, force)
    _add_commissioning(partial(command, 'commission'), force)
    _add_identification(partial(command, 'identify'), names, force)
    _add_studies(partial(command, 'studies'))
    _add_doctor(partial(command, 'doctor'))
    parser.set_defaults(commands=commands.choices)
    return parser


def _add_run(command: _Command) -> None:
    option = command(
        'run',
        'Run the controller on the simulated arm and plot the results. Arm, controller and '
        'recorder run over ROS 2; a bag, pictures and summary.json are written into a new '
        'folder. Exit code: 0 done, 5 the controller stopped before the end, 130 interrupted, '
        '1 an error.',
        '--config noisy --duration 30 --mode realtime --out first',
    )
    option('--config', default='recommended', help=_CONFIG)
    option(
        '--duration',
        type=float,
        help='simulated time [s]; 0: until Ctrl-C (as configured, or else 60)',
    )
    option(
        '--mode',
        choices=('realtime', 'lockstep'),
        help='steps by the wall clock, or one for each torque (as configured)',
    )
    option('--seed', type=int, help='seed of the sensor noise (as configured)')
    physics = (
        'mechanics of the simulated arm: our own equations, or MuJoCo (as configured)'
    )
    option('--physics', choices=('own', 'mujoco'), help=physics)
    offline = 'run without ROS, in this process; nothing is published'
    option('--offline', action='store_true', help=offline)
    option(
        '--out', type=Path, default=Path('closed_loop'), help='new folder (closed_loop)'
    )
    option('--view', action='store_true', help='show the run on a page in the browser')
    option = command(
        'precompile',
        'Compile the kernels of a configuration before its first start. Controller and simulated '
        'arm then start within seconds. Use it after an installation, or when you build an image. '
        'The kernels go into the cache of the user (NUMBA_CACHE_DIR, or '
        '~/.cache/blf_dsc_controller).',
        '--config my.yaml',
    )
    option('--config', default='recommended', help=_CONFIG)
    package = 'also copy them into the package, for wheels, workspaces and images made from it'
    option('--package', action='store_true', help=package)


def _add_drive(command: _Command) -> None:
    option = command(
        'drive',
        'Control an arm over its own interface, without ROS: a Franka Research 3, or motors by '
        'Damiao on CAN. The law runs in the '
        'loop that reads states and writes torques; --ros adds the topics. Ctrl-C or SIGTERM '
        'brings the arm to rest and ends; a second one ends at once. Exit code: 0 the duration is '
        'over, 5 the controller or the robot stopped before, 130 interrupted, 1 an error.',
        '--robot 172.16.0.2 --config fr3_direct.yaml --duration 60 --out first',
    )
    address = 'address of the robot; simulated: the simulated arm of the file'
    option('--robot', required=True, help=address)
    preset = 'parameter file, or a preset (fr3_direct)'
    option('--config', default='fr3_direct', help=preset)
    option('--duration', type=float, default=0.0, help='time [s]; 0: until Ctrl-C (0)')
    option(
        '--out', type=Path, help='new folder for a bag (without it nothing is recorded)'
    )
    beside = 'publish the topics of the controller, and accept motions on its topics'
    option('--ros', action='store_true', help=beside)
    option('--namespace', default='', help='namespace of these topics (none)')


def _add_bags(
    command: _Command, names: argparse.ArgumentParser, force: argparse.ArgumentParser
) -> None:
    option = command(
        'replay',
        'Run a bag through the controller again and compare every output bit for bit. The '
        'controller has the recorded configuration and gets the recorded joint states. With '
        '--play, publish the bag instead. Exit code: 0 all outputs are bit-equal, 3 some differ, '
        '4 some could not be compared and the others are bit-equal, 1 an error.',
        'run1/bag',
        names,
    )
    option('bag', type=Path, help=_BAG)
    option('--play', action='store_true', help='publish the recorded topics over ROS')
    law = (
        'law to run if the recorded one is a Python file, which no bag can choose: its path, '
        'and the SHA-256 of its content'
    )
    option('--law', default='', metavar='FILE@SHA256', help=law)
    option = command(
        'report',
        'Show one or several bags on one HTML page. It has zoomable plots, events and the '
        'configuration, and needs no network.',
        'run1/bag run2/bag --out comparison.html',
        names,
        force,
    )
    option('bags', type=Path, nargs='+', metavar='BAG', help=_BAG)
    option('--out', type=Path, default=Path('report.html'), help='file (report.html)')
    option = command(
        'recover',
        'Write a clean bag from one that was cut off or damaged, and list what was lost. The '
        'damaged bag is not changed. Exit code: 1 if nothing could be recovered.',
        'run1/bag --out rescued',
    )
    option('bag', type=Path, help='folder of the bag, or its .mcap file')
    option('--out', type=Path, help='new folder (BAG_recovered)')
    about = (
        'Write a bag as a table, in CSV or Parquet. It has a row for each joint state.'
    )
    option = command('export', about, 'run1/bag --out run1.csv', names, force)
    option('bag', type=Path, help=_BAG)
    option('--out', type=Path, required=True, help='FILE.csv or FILE.parquet')
    about = 'Draw the pictures of a bag (tracking.png, ...) and write summary.json.'
    option = command('plot', about, 'run1/bag --out pictures', names, force)
    option('bag', type=Path, help=_BAG)
    option('--out', type=Path, default=Path(), help='folder to write into (.)')


def _add_commissioning(command: _Command, force: argparse.ArgumentParser) -> None:
    option = command(
        'commission',
        'Measure an arm from a URDF, and choose its gains by what was measured. A reference '
        'shakes all joints a little, in a few postures; from torques and positions follow the '
        'responses of the joints, and the stiffest gains with a modulus margin. With --robot, the '
        'driver of `blf_dsc drive` moves the robot to each posture and measures it; with --ros, '
        "the controller's node does. With --write, write the motions for a loop of your own; "
        'then give their bags. With none of these the arm is simulated. Exit code: 0 done, 3 no '
        'gains have the margin, 5 the controller or the robot stopped before, 130 interrupted, 1 '
        'an error.',
        '--config ur5e --out commissioned.yaml\n'
        '  blf_dsc commission --config my.yaml --robot 172.16.0.2 --out commissioned.yaml\n'
        '  blf_dsc commission --config my.yaml --ros --commands effort_controller/commands\n'
        '  blf_dsc commission --config my.yaml --write motion.yaml\n'
        '  blf_dsc commission run1/bag run2/bag run3/bag --config my.yaml --out commissioned.yaml',
        force,
    )
    option('bags', type=Path, nargs='*', metavar='BAG', help='runs of the motions')
    option('--config', required=True, help=_OF_URDF)
    option(
        '--out',
        type=_parameter_file,
        default=Path('commissioned.yaml'),
        help='parameter file to write, and a picture beside it (commissioned.yaml)',
    )
    option(
        '--robot',
        metavar='ADDRESS',
        help='measure this robot; with BAGs, these count, too',
    )
    option(
        '--ros',
        action='store_true',
        help='measure the robot behind topics; with BAGs, these count, too',
    )
    option(
        '--prove',
        action='store_true',
        help='measure nothing, but raise the gains of a commissioned file in three steps along '
        'its reference, on the robot, and compare its errors with those expected',
    )
    option(
        '--states', metavar='TOPIC', help='joint states of its driver (joint_states)'
    )
    option(
        '--commands',
        metavar='TOPIC',
        help='torques that its driver takes (blf_dsc_controller/commands)',
    )
    option('--namespace', default='', help='namespace of these topics (none)')
    option('--yes', action='store_true', help='start the robot without a question')
    option(
        '--record',
        type=Path,
        metavar='FOLDER',
        help='new folder for the bags of the robot (commissioned_bags)',
    )
    option(
        '--write',
        type=_parameter_file,
        metavar='MOTION.yaml',
        help='measure nothing, but write MOTION_1.yaml and so on, one for each posture',
    )
    option(
        '--posture',
        type=float,
        nargs='+',
        action='append',
        metavar='ANGLE',
        help='angles of all joints [rad]; can be repeated (three along the reference)',
    )
    torque = 'rms torque of the motion, as a share of the rated one (0.03)'
    option('--torque', type=_share, default=0.03, help=torque)
    travel = 'farthest that the tool travels from its middle [m] (0.01)'
    option('--travel', type=float, default=0.01, help=travel)
    margin = 'modulus margin of the gains (0.5)'
    option('--margin', type=_share, default=0.5, help=margin)


def _add_identification(
    command: _Command, names: argparse.ArgumentParser, force: argparse.ArgumentParser
) -> None:
    option = command(
        'excite',
        'Find the motion from which most is learned about an arm from a URDF. It is a sum of '
        'sinusoids with the period of the learning window. It keeps the joint and torque limits, '
        'and the links clear of each other and of the floor; nothing else around the arm is known. '
        'It is written as a parameter file.',
        'exciting.yaml --config my.yaml',
        force,
    )
    option('out', type=_parameter_file, help='parameter file to write')
    option('--config', required=True, help=_OF_URDF)
    option(
        '--harmonics',
        type=_positive,
        default=3,
        help='number of harmonics of the window (3)',
    )
    option(
        '--starts',
        type=_positive,
        default=4,
        help='number of searches; the best result is kept (4)',
    )
    radius = 'radius of the links, for their clearance [m] (0.07)'
    option('--radius', type=float, default=0.07, help=radius)
    option(
        '--floor',
        type=float,
        default=0.0,
        help='height of the floor in the base frame [m] (0)',
    )
    option = command(
        'identify',
        'Correct the inertias and friction of a URDF from recordings with positions and efforts. '
        'The new URDF has physical inertias that reproduce the torques. The changes are printed, '
        'with 95 % intervals, and the torque error on the last fifth of the motion, which is held '
        'back for this test. With --payload, weigh what the arm holds. Exit code: 0 done, 3 do '
        'not use the result (it is written with --force only), 1 an error.',
        'run1/bag --urdf robot.urdf --out corrected.urdf --report page.html\n'
        '  blf_dsc identify run.csv --urdf robot.urdf --map time=t --map tau=tau_* --out new.xml\n'
        '  blf_dsc identify empty/bag --urdf robot.urdf --payload loaded/bag',
        names,
        force,
    )
    option(
        'bags',
        type=Path,
        nargs='+',
        metavar='RECORDING',
        help=f'{_BAG}, or a table (.csv, .txt, .npz, .mat)',
    )
    option(
        '--urdf',
        required=True,
        help='URDF: a file, package://name/path, or a file in config/',
    )
    results = (
        'file to write: .urdf, .xml (MJCF), .yaml (our parameters); can be repeated'
    )
    option(
        '--out', type=Path, action='append', default=[], metavar='FILE', help=results
    )
    option(
        '--report',
        type=Path,
        help='page with measured and predicted torques and the tables',
    )
    load = (
        'weigh the load that the arm carries in this bag and not in the first; without BAG, '
        'the load that it picks up in the first'
    )
    option('--payload', type=Path, nargs='?', const=True, metavar='BAG', help=load)
    before = (
        'fit nothing, but say what can be identified from the recording, or from the table of '
        'a planned motion without torques'
    )
    option('--foresee', action='store_true', help=before)
    efforts = ('torque', 'without-gravity', 'command')
    what = (
        'what the efforts contain: the whole torque, or all but gravity; or use the commands '
        'instead (torque)'
    )
    option('--effort', choices=efforts, default='torque', help=what)
    per_effort = 'if efforts are currents: torque per current, of each joint [N m/A]'
    option('--gains', type=float, nargs='+', default=(), help=per_effort)
    option('--base', default='', help='fixed link (the root)')
    option('--tip', default='', help='last link (that of the last joint in the bag)')
    upright = (0.0, 0.0, -9.81)
    given = 'gravity in the base frame [m/s^2] (0 0 -9.81)'
    option(
        '--gravity',
        type=float,
        nargs=3,
        default=upright,
        metavar=tuple('XYZ'),
        help=given,
    )
    largest = 'largest mass on the last link that is not in the URDF [kg] (3)'
    option('--rated-payload', type=float, default=3.0, help=largest)


def _add_studies(command: _Command) -> None:
    option = command(
        'arms',
        'Compare laws on arms whose URDF is wrong. Each law is tuned on one simulated arm and run '
        'on others; the errors are printed as a table. Runs without ROS, on all cores, for some '
        'minutes.',
        '--config panda_rigid --out arms',
    )
    option(
        '--config',
        nargs='+',
        default=['panda_rigid', 'ur5e_rigid'],
        help='presets or files (panda_rigid ur5e_rigid)',
    )
    laws = (
        'laws of the study by name, or Python files with more laws (all of the study)'
    )
    option('--laws', nargs='+', default=[], metavar='LAW', help=laws)
    option('--out', type=Path, default=Path('arms'), help='new folder for the figures')
    option = command(
        'monte-carlo',
        'Run a study of many random arms. Thousands of closed loops run in parallel, and the '
        'report says how many kept the bound. To resume an interrupted study, start the same '
        'command again.',
        '--config my_study.yaml --out study\n  blf_dsc monte-carlo --reproduce study 365',
    )
    option(
        '--config', default='monte_carlo', help='study file, or a preset (monte_carlo)'
    )
    option('--runs', type=_positive, help='number of runs (as configured)')
    option(
        '--workers',
        type=_positive,
        help='number of processes (one per core of this computer)',
    )
    scheduler = 'compute the runs on the dask cluster of this scheduler instead'
    option('--dask', metavar='ADDRESS', help=scheduler)
    reported = 'compare the studies of pairs in these folders, into --out (changes)'
    option('--report', type=Path, nargs='+', metavar='DIR', help=reported)
    again = 'repeat one run of a study, with a bag, into --out'
    option('--reproduce', nargs=2, metavar=('DIR', 'RUN'), help=again)
    option('--out', type=Path, help='folder of the study (monte_carlo)')


def _add_doctor(command: _Command) -> None:
    option = command(
        'doctor',
        'Say what is installed, what this computer is like for a control loop, and what to mend. '
        'It takes some seconds and changes nothing. Paste what it prints into a report of a bug. '
        'Exit code: 0 no problem, 1 a problem.',
        '--config my.yaml --robot 172.16.0.2',
    )
    option(
        '--config', help='parameter file or preset, to hear what is said at its start'
    )
    option(
        '--robot',
        help='IP address or name of a robot, to ask how fast it answers (ping)',
    )


def _positive(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f'got {text}: give a whole number above 0')
    return value


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(
            f'got {text}: give a number above 0 and below 1'
        )
    return value


def _parameter_file(text: str) -> Path:
    path = Path(text)
    if path.suffix not in ('.yaml', '.yml'):
        raise argparse.ArgumentTypeError(
            f'got {text}, but it will be a parameter file: give a name in .yaml'
        )
    return path


def check_command(parser: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """End with a suggestion if the first word is meant for a command, but is none."""
    known = parser.get_default('commands')
    if words and words[0] in _MOVED:
        parser.error(
            f'{words[0]} makes a table of the project: in a checkout, call '
            f'python -m benchmark {_MOVED[words[0]]}'
        )
    if words and words[0] in _OTHERS:
        parser.error(f'no command {words[0]}: {_OTHERS[words[0]]}')
    if words and not words[0].startswith('-') and words[0] not in known:
        close = difflib.get_close_matches(words[0], known, n=1)
        guess = f', did you mean {close[0]}?' if close else ''
        parser.error(f'no command {words[0]}{guess}; there are {", ".join(known)}')
    behind = next((word for word in words if word in known), None)
    if behind is not None and known[behind].takes(words[0]):
        parser.error(
            f'{words[0]} belongs behind the command: blf_dsc {behind} {words[0]} ...'
        )


def check_text(parser: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """End with a message if a word is no text: pages and files could not name it."""
    for word in words:
        try:
            os.fsencode(word).decode()
        except UnicodeDecodeError:
            parser.error(f'{word!a} is no text in UTF-8: rename the file')
