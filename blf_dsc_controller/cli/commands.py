# SPDX-License-Identifier: Apache-2.0
"""The sub-commands of `blf_dsc`: what each does, an example, and its options."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple


class Option(NamedTuple):
    """An option or argument of a command."""

    name: str
    settings: dict[str, Any]  # of `argparse.ArgumentParser.add_argument`


class Command(NamedTuple):
    """A sub-command."""

    name: str
    module: str  # of `blf_dsc_controller.cli`, with the function of that name
    about: str  # its first sentence stands in the list of commands
    example: str  # what to type behind the name
    options: tuple[Option, ...]


def option(name: str, about: str, **settings: Any) -> Option:
    """Return an option with its help."""
    return Option(name, {'help': about, **settings})


def _positive(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f'got {text}: give a whole number above 0')
    return value


def _number(fits: Callable[[float], bool], wanted: str) -> Callable[[str], float]:
    """Return the type of an option that is a number which fits."""

    def parsed(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not fits(value):
            raise argparse.ArgumentTypeError(f'got {text}: give {wanted}')
        return value

    return parsed


_finite = _number(math.isfinite, 'a number')
_share = _number(lambda x: 0.0 < x < 1.0, 'a number above 0 and below 1')
_magnitude = _number(lambda x: 0.0 <= x < math.inf, 'a number of at least 0')
_size = _number(lambda x: 0.0 < x < math.inf, 'a number above 0')
_travel = _number(
    lambda x: 0.0 < x <= 0.5, 'm above 0, and 0.5 at most: 10 mm are 0.01'
)


def _path(text: str) -> Path:
    """Return a path; shells leave the ~ of --out=~/run and of quoted words."""
    return Path(os.path.expanduser(text))  # noqa: PTH111 - Path's fails without a home


def _parameter_file(text: str) -> Path:
    path = _path(text)
    if path.suffix not in ('.yaml', '.yml'):
        raise argparse.ArgumentTypeError(
            f'got {text}, but it will be a parameter file: give a name in .yaml'
        )
    return path


_BAG = 'folder of the bag, or its .mcap, .db3 or .bag file'
_CONFIG = 'parameter file, or a preset (recommended)'
_OF_URDF = 'parameter file of an arm from a URDF, or a preset, such as ur5e'
_NAMES = (
    option(
        '--map',
        'what a topic or a joint is called in the bag, such as joint1=shoulder; or which columns '
        'of a table are the time=, q= and tau=, and theta= of motors; can be repeated',
        action='append',
        default=[],
        metavar='OURS=THEIRS',
    ),
    option('--namespace', 'robot to use, if a bag holds several', default=''),
)
_FORCE = option('--force', 'overwrite existing files', action='store_true')

_RUN = Command(
    name='run',
    module='run',
    about='Run the controller on the simulated arm and plot the results. Arm, controller and '
    'recorder run over ROS 2; a bag, pictures and summary.json are written into a new folder. '
    'Exit code: 0 done, 5 the controller stopped before the end, 130 interrupted, 1 an error.',
    example='--config noisy --duration 30 --mode realtime --out first',
    options=(
        option('--config', _CONFIG, default='recommended'),
        option(
            '--duration',
            'simulated time [s]; 0: until Ctrl-C (as configured, or else 60)',
            type=float,
        ),
        option(
            '--mode',
            'steps by the wall clock, or one for each torque (as configured)',
            choices=('realtime', 'lockstep'),
        ),
        option('--seed', 'seed of the sensor noise (as configured)', type=int),
        option(
            '--physics',
            'mechanics of the simulated arm: our own equations, or MuJoCo (as configured)',
            choices=('own', 'mujoco'),
        ),
        option(
            '--offline',
            'run without ROS, in this process; nothing is published',
            action='store_true',
        ),
        option(
            '--out', 'new folder (closed_loop)', type=_path, default=Path('closed_loop')
        ),
        option('--view', 'show the run on a page in the browser', action='store_true'),
    ),
)
_DRIVE = Command(
    name='drive',
    module='drive',
    about='Control an arm over its own interface: a Franka Research 3, motors by Damiao on CAN, or '
    'a robot behind ROS. The law runs in the loop that reads states and writes torques; --ros '
    'adds the topics where there are none. Ctrl-C or SIGTERM brings the arm to rest and ends; a '
    'second one ends at once. Exit code: 0 the duration is over, 5 the controller or the robot '
    'stopped before, 130 interrupted, 1 an error.',
    example='--robot 172.16.0.2 --config fr3_direct.yaml --duration 60 --out first',
    options=(
        option(
            '--robot',
            'address of the robot; simulated: the simulated arm of the file; ros: the robot '
            'behind topics',
            required=True,
        ),
        option(
            '--config', 'parameter file, or a preset (fr3_direct)', default='fr3_direct'
        ),
        option('--duration', 'time [s]; 0: until Ctrl-C (0)', type=float, default=0.0),
        option(
            '--out', 'new folder for a bag (without it nothing is recorded)', type=_path
        ),
        option(
            '--ros',
            'publish the topics of the controller, and accept motions on its topics',
            action='store_true',
        ),
        option('--namespace', 'namespace of these topics (none)', default=''),
    ),
)
_REPLAY = Command(
    name='replay',
    module='bags',
    about='Run a bag through the controller again and compare every output bit for bit. The '
    'controller has the recorded configuration and gets the recorded joint states. '
    'Exit code: 0 all outputs are bit-equal, 3 some differ, 4 some '
    'could not be compared and the others are bit-equal, 1 an error.',
    example='run1/bag',
    options=(
        *_NAMES,
        option('bag', _BAG, type=_path),
        option(
            '--law',
            'law to run if the recorded one is a Python file, which no bag can choose: its path, '
            'and the SHA-256 of its content',
            default='',
            metavar='FILE@SHA256',
        ),
    ),
)
_REPORT = Command(
    name='report',
    module='bags',
    about='Show one or several bags on one HTML page. It has zoomable plots, events and the '
    'configuration, and needs no network. With --png, draw pictures of one bag instead.',
    example='run1/bag run2/bag --out comparison.html\n'
    '  blf_dsc report run1/bag --png pictures',
    options=(
        *_NAMES,
        _FORCE,
        option('bags', _BAG, type=_path, nargs='+', metavar='BAG'),
        option('--out', 'file (report.html)', type=_path, default=Path('report.html')),
        option(
            '--png',
            'write no page, but the pictures (tracking.png, ...) and summary.json of a bag into '
            'this folder, and print the summary',
            type=_path,
            metavar='FOLDER',
        ),
    ),
)
_RECOVER = Command(
    name='recover',
    module='bags',
    about='Write a clean bag from one that was cut off or damaged, and list what was lost. The '
    'damaged bag is not changed. Exit code: 1 if nothing could be recovered.',
    example='run1/bag --out rescued',
    options=(
        option('bag', 'folder of the bag, or its .mcap file', type=_path),
        option('--out', 'new folder (BAG_recovered)', type=_path),
    ),
)
_EXPORT = Command(
    name='export',
    module='bags',
    about='Write a bag as a table, in CSV or Parquet. It has a row for each joint state.',
    example='run1/bag --out run1.csv',
    options=(
        *_NAMES,
        _FORCE,
        option('bag', _BAG, type=_path),
        option('--out', 'FILE.csv or FILE.parquet', type=_path, required=True),
    ),
)
_EXPORT_C = Command(
    name='export-c',
    module='export_c',
    about='Write the law of a configuration as a library in C, without Python. A new folder has '
    'its object, header, settings and an example. The safe stop and the envelope are not in it: '
    'the caller limits and stops the arm.',
    example='--config my.yaml --out law',
    options=(
        option('--config', _CONFIG, default='recommended'),
        option('--out', 'new folder', type=_path, required=True),
    ),
)
_COMMISSION = Command(
    name='commission',
    module='commission',
    about='Measure an arm from a URDF, and choose its gains by what was measured. A reference '
    'excites all joints a little, in a few postures; from torques and positions follow the '
    'responses of the joints, and the stiffest gains with a modulus margin. With --robot, the '
    'driver of `blf_dsc drive` moves the robot to each posture and measures it; --ros is '
    '--robot ros. With --write, write the motions for a loop of your own; then give '
    'their bags. With none of these the arm is simulated. Exit code: 0 done, 3 no gains have the '
    'margin, 5 the controller or the robot stopped before, 130 interrupted, 1 an error.',
    example='--config ur5e --out commissioned.yaml\n'
    '  blf_dsc commission --config my.yaml --robot 172.16.0.2 --out commissioned.yaml\n'
    '  blf_dsc commission --config my.yaml --ros --commands effort_controller/commands\n'
    '  blf_dsc commission --config my.yaml --write motion.yaml\n'
    '  blf_dsc commission run1/bag run2/bag run3/bag --config my.yaml --out commissioned.yaml',
    options=(
        _FORCE,
        option('bags', 'runs of the motions', type=_path, nargs='*', metavar='BAG'),
        option('--config', _OF_URDF, required=True),
        option(
            '--out',
            'parameter file to write, and a picture beside it (commissioned.yaml)',
            type=_parameter_file,
            default=Path('commissioned.yaml'),
        ),
        option(
            '--robot',
            'measure this robot; with BAGs, these count, too',
            metavar='ADDRESS',
        ),
        option(
            '--ros',
            'measure the robot behind topics, as with --robot ros',
            action='store_true',
        ),
        option(
            '--prove',
            'measure nothing, but raise the gains of a commissioned file in three steps along '
            'its reference, on the robot, and compare its errors with those expected',
            action='store_true',
        ),
        option(
            '--states', 'joint states of its driver (joint_states)', metavar='TOPIC'
        ),
        option(
            '--commands',
            'torques that its driver takes (blf_dsc_controller/commands)',
            metavar='TOPIC',
        ),
        option('--namespace', 'namespace of these topics (none)', default=''),
        option('--yes', 'start the robot without a question', action='store_true'),
        option(
            '--record',
            'new folder for the bags of the robot (commissioned_bags)',
            type=_path,
            metavar='FOLDER',
        ),
        option(
            '--write',
            'measure nothing, but write MOTION_1.yaml and so on, one for each posture',
            type=_parameter_file,
            metavar='MOTION.yaml',
        ),
        option(
            '--posture',
            'positions of all joints [rad, m]; can be repeated (three along the reference)',
            type=float,
            nargs='+',
            action='append',
            metavar='ANGLE',
        ),
        option(
            '--torque',
            'rms torque of the motion, as a share of the rated one (0.03)',
            type=_share,
            default=0.03,
        ),
        option(
            '--travel',
            'farthest that the tool travels from its middle [m] (0.01)',
            type=_travel,
            default=0.01,
        ),
        option(
            '--margin', 'modulus margin of the gains (0.5)', type=_share, default=0.5
        ),
    ),
)
_EXCITE = Command(
    name='excite',
    module='identify',
    about='Find the motion from which most is learned about an arm from a URDF. It is a sum of '
    'sinusoids with the period of the learning window. It keeps the joint and torque limits, and '
    'the links clear of each other and of the floor; nothing else around the arm is known. It is '
    'written as a parameter file.',
    example='exciting.yaml --config my.yaml',
    options=(
        _FORCE,
        option('out', 'parameter file to write', type=_parameter_file),
        option('--config', _OF_URDF, required=True),
        option(
            '--harmonics',
            'number of harmonics of the window (3)',
            type=_positive,
            default=3,
        ),
        option(
            '--starts',
            'number of searches; the best result is kept (4)',
            type=_positive,
            default=4,
        ),
        option(
            '--radius',
            'radius of the links, for their clearance [m] (0.07)',
            type=_size,
            default=0.07,
        ),
        option(
            '--floor',
            'height of the floor in the base frame [m] (0)',
            type=_finite,
            default=0.0,
        ),
    ),
)
_IDENTIFY = Command(
    name='identify',
    module='identify',
    about='Correct the inertias and friction of a URDF from recordings with positions and '
    'efforts. The new URDF has physical inertias that reproduce the torques. The changes are '
    'printed, with 95 % intervals, and the torque error on the last fifth of the motion, which '
    'is held back for this test. With --payload, weigh what the arm holds. Exit code: 0 done, 3 '
    'do not use the result (it is written with --force only), 1 an error.',
    example='run1/bag --urdf robot.urdf --out corrected.urdf --report page.html\n'
    '  blf_dsc identify run.csv --urdf robot.urdf --map time=t --map tau=tau_* --out new.urdf\n'
    '  blf_dsc identify empty/bag --urdf robot.urdf --payload loaded/bag',
    options=(
        *_NAMES,
        _FORCE,
        option(
            'bags',
            f'{_BAG}, or a table (.csv, .txt, .npz, .mat, .parquet)',
            type=_path,
            nargs='+',
            metavar='RECORDING',
        ),
        option(
            '--urdf',
            'URDF: a file, package://name/path, or a file in config/',
            required=True,
        ),
        option(
            '--out',
            'file to write: .urdf, .yaml (our parameters); can be repeated',
            type=_path,
            action='append',
            default=[],
            metavar='FILE',
        ),
        option(
            '--report',
            'page with measured and predicted torques and the tables',
            type=_path,
        ),
        option(
            '--payload',
            'weigh the load that the arm carries in this bag and not in the first; without BAG, '
            'the load that it picks up in the first',
            type=_path,
            nargs='?',
            const=True,
            metavar='BAG',
        ),
        option(
            '--effort',
            'what the efforts contain: the whole torque, or all but gravity; or use the commands '
            'instead (torque)',
            choices=('torque', 'without-gravity', 'command'),
            default='torque',
        ),
        option(
            '--gains',
            'if efforts are currents: torque per current, of each joint [N m/A]',
            type=float,
            nargs='+',
            default=(),
        ),
        option('--base', 'fixed link (the root)', default=''),
        option('--tip', 'last link (that of the last joint in the bag)', default=''),
        option(
            '--gravity',
            'gravity in the base frame [m/s^2] (0 0 -9.81)',
            type=_finite,
            nargs=3,
            default=(0.0, 0.0, -9.81),
            metavar=tuple('XYZ'),
        ),
        option(
            '--rated-payload',
            'largest mass on the last link that is not in the URDF [kg] (3)',
            type=_magnitude,
            default=3.0,
        ),
    ),
)
_ARMS = Command(
    name='arms',
    module='studies',
    about='Compare laws on arms whose URDF is wrong. Each law is tuned on one simulated arm and '
    'run on others; the errors are printed as a table. Runs without ROS, on all cores, for some '
    'minutes.',
    example='--config panda_rigid --out arms',
    options=(
        option(
            '--config',
            'presets or files (panda_rigid ur5e_rigid)',
            nargs='+',
            default=['panda_rigid', 'ur5e_rigid'],
        ),
        option(
            '--laws',
            'laws of the study by name, or Python files with more laws (all of the study)',
            nargs='+',
            default=[],
            metavar='LAW',
        ),
        option('--out', 'new folder for the figures', type=_path, default=Path('arms')),
    ),
)
_MONTE_CARLO = Command(
    name='monte-carlo',
    module='studies',
    about='Run a study of many random arms. Thousands of closed loops run in parallel, and the '
    'report says how many kept the bound. To resume an interrupted study, start the same command '
    'again.',
    example='--config my_study.yaml --out study\n'
    '  blf_dsc monte-carlo --reproduce study 365',
    options=(
        option(
            '--config', 'study file, or a preset (monte_carlo)', default='monte_carlo'
        ),
        option('--runs', 'number of runs (as configured)', type=_positive),
        option(
            '--workers',
            'number of processes (one per core of this computer)',
            type=_positive,
        ),
        option(
            '--dask',
            'compute the runs on the dask cluster of this scheduler instead',
            metavar='ADDRESS',
        ),
        option(
            '--report',
            'compare the studies of pairs in these folders, into --out (changes)',
            type=_path,
            nargs='+',
            metavar='DIR',
        ),
        option(
            '--reproduce',
            'repeat one run of a study, with a bag, into --out',
            nargs=2,
            metavar=('DIR', 'RUN'),
        ),
        option('--out', 'folder of the study (monte_carlo)', type=_path),
    ),
)
_DOCTOR = Command(
    name='doctor',
    module='doctor',
    about='Say what is installed, what this computer is like for a control loop, and what to '
    'correct. It takes some seconds and changes nothing. Paste what it prints into a report of a '
    'bug. With --compile, compile the kernels of a configuration instead, so that controller and '
    'simulated arm start within seconds. Exit code: 0 no problem, 1 a problem.',
    example='--config my.yaml --robot 172.16.0.2\n'
    '  blf_dsc doctor --compile --config my.yaml',
    options=(
        option(
            '--config', 'parameter file or preset, to hear what is said at its start'
        ),
        option(
            '--robot',
            'IP address or name of a robot, to ask how fast it answers (ping)',
        ),
        option(
            '--compile',
            'only compile the kernels of --config (recommended), into the cache of the user '
            '(NUMBA_CACHE_DIR, or ~/.cache/blf_dsc_controller); package: also into the package, '
            'for wheels, workspaces and images made from it',
            nargs='?',
            const='user',
            choices=('user', 'package'),
        ),
    ),
)

COMMANDS = (
    _RUN,
    _DRIVE,
    _REPLAY,
    _REPORT,
    _RECOVER,
    _EXPORT,
    _EXPORT_C,
    _COMMISSION,
    _EXCITE,
    _IDENTIFY,
    _ARMS,
    _MONTE_CARLO,
    _DOCTOR,
)
"""All, as `blf_dsc --help` lists them."""
