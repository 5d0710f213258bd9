# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc doctor`: what is installed, what this computer is like, and what to correct."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import shutil
import subprocess
import textwrap
from argparse import Namespace
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from blf_dsc_controller import __version__
from blf_dsc_controller.cli import computer
from blf_dsc_controller.cli.domains import check_network, shell_domain, strangers
from blf_dsc_controller.cli.finding import Finding, Level, note, ok, problem
from blf_dsc_controller.cli.gains_of_joints import gains_of_joints
from blf_dsc_controller.compiled.kernel_cache import SHIPPED, is_quick, place
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    DRIVE,
    ignored_in,
    load,
    locate,
)
from blf_dsc_controller.drive.drivers import is_in_network
from blf_dsc_controller.drive.motor_feedback import robot_warnings
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import install_command
from blf_dsc_controller.nodes.ros_check import require_ros

_NEEDED = ('numpy', 'scipy', 'numba', 'mcap', 'rosbags', 'matplotlib')
_EXTRAS = {
    'ruckig': ('streams', 'streams of positions'),
    'pylibfranka': ('franka', 'blf_dsc drive with an FR3'),
    'python-can': ('damiao', 'blf_dsc drive with Damiao motors'),
    'pin-pink': ('pose', 'poses of the tip as targets'),
    'mujoco': ('mujoco', 'MJCF and physics: mujoco'),
    'viser': ('view', 'the live view'),
    'plotly': ('report', 'blf_dsc report'),
    'pyarrow': ('parquet', 'Parquet files'),
}
"""Packages by what they are for, and the extra that installs them."""

_WIDTH = 100
_INDENT = 20
_PINGS = 200
_SLOW = 0.3  # ms: more leaves too little of a sample of 1 ms to the law and the robot


def doctor(options: Namespace) -> int:
    """Print what was found; return 1 if there is a problem."""
    if options.compile:
        from blf_dsc_controller.cli.compilation import compile_ahead  # slow

        into_package = options.compile == 'package'
        compile_ahead(options.config or 'recommended', into_package=into_package)
        return 0
    found: list[Finding] = []
    every = chain(_software(), _ros(), computer.examine())
    if options.config:
        every = chain(every, _configuration(options.config))
    if options.robot:
        every = chain(every, _network(options.robot))
    for finding in every:
        print(_line(finding), flush=True)
        found.append(finding)
    counts = [sum(each.level is level for each in found) for level in Level]
    _, notes, problems = counts
    print(
        f'\n{problems or "no"} problem{"s" * (problems != 1)}, '
        f'{notes or "no"} note{"s" * (notes != 1)}. If you report a bug, paste all of this.'
    )
    return int(problems > 0)


def _line(finding: Finding) -> str:
    text = f'{finding.text}\n{finding.remedy}' if finding.remedy else finding.text
    head = f'{finding.level:8}{finding.subject:{_INDENT - 8}}'
    lines = [
        line
        for part in text.splitlines()
        for line in textwrap.wrap(part, _WIDTH - _INDENT, break_on_hyphens=False)
    ]
    return head + f'\n{" " * _INDENT}'.join(lines)


def _software() -> Iterator[Finding]:
    yield ok('package', f'blf_dsc_controller {__version__}, {computer.python()}')
    versions = {name: importlib.metadata.version(name) for name in _NEEDED}
    yield ok('needs', ', '.join(f'{name} {each}' for name, each in versions.items()))
    there = {name: _version(name) for name in _EXTRAS}
    yield ok(
        'extras', ', '.join(f'{name} {each}' for name, each in there.items() if each)
    )
    for name, (extra, purpose) in _EXTRAS.items():
        if not there[name]:
            yield ok('extras', f'no {name}, for {purpose}: {install_command(extra)}')
    yield _kernels()


def _kernels() -> Finding:
    shipped = ', some come with the package' if SHIPPED.is_dir() else ''
    where = str(place()).replace(str(Path.home()), '~', 1)
    if is_quick():
        return ok(
            'kernels', f'compiled once for each kind of arm, into {where}{shipped}'
        )
    version = importlib.metadata.version('numba')
    return note(
        'kernels',
        f'numba {version} compiles them in more than twice the time, and each update takes a '
        'little longer',
        "pip install 'numba<0.69'",
    )


def _ros() -> Iterator[Finding]:
    if importlib.util.find_spec('rclpy') is None:
        remedy = f'source /opt/ros/jazzy/setup.bash, or {install_command("ros")}'
        yield note('ROS 2', 'not here; drive, ArmController and bags need none', remedy)
        return
    try:
        require_ros()
    except BlfDscError as error:
        yield problem('ROS 2', str(error))
        return
    distribution = os.environ.get('ROS_DISTRO')
    kind = f'{distribution}, sourced' if distribution else 'Jazzy, as wheels'
    middleware = os.environ.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp'
    yield ok('ROS 2', f'{kind}, rclpy {_version("rclpy")}, {middleware}')
    yield from _domain()
    if importlib.util.find_spec('control_msgs') is None:
        text = 'control_msgs is not installed: no action for MoveIt'
        remedy = 'send trajectories to ~/joint_trajectory; wheels have no control_msgs'
        if distribution:
            remedy = 'sudo apt install ros-jazzy-control-msgs'
        yield note('ROS 2', text, remedy)


def _domain() -> Iterator[Finding]:
    try:
        check_network()
    except BlfDscError as error:
        yield problem('network', str(error))
        return
    domain = shell_domain()
    reach = os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE') or 'SUBNET'
    peers = os.environ.get('ROS_STATIC_PEERS')
    text = f'{domain}, discovery {reach}' + (f', peers {peers}' if peers else '')
    others = strangers(domain)
    text += f', {len(others)} UDP ports of others here' if others else ', nobody here'
    yield ok('ROS domain', text)


def _configuration(path: str) -> Iterator[Finding]:
    """Yield what the controller would say at its start."""
    try:
        file = locate(path)
        config = load(file, CONTROLLER, ControllerConfig)
        in_motors = load(file, DRIVE, DriveConfig).feedback == 'motor'
        warnings = robot_warnings(config, in_motors=in_motors)
        if ignored := ignored_in(file, (CONTROLLER, DRIVE)):
            warnings.append(ignored)
    except BlfDscError as error:
        yield problem('config', str(error))
        return
    rate = 1.0 / config.sample_time
    yield ok('config', f'{len(config.joints)} joints at {rate:g} Hz, law {config.law}')
    if config.model == 'urdf':
        for line in gains_of_joints(config):
            yield ok('gains', line)
    for warning in warnings:
        yield note('config', warning, '')


def _network(address: str) -> Iterator[Finding]:
    """Yield how long a robot's computer takes to answer, if there is one."""
    if not is_in_network(address):
        yield ok('robot', f'{address} is not in the network: `blf_dsc drive` asks it')
        return
    ping = shutil.which('ping')
    if ping is None:
        yield note(
            'robot',
            'there is no ping on this computer',
            'sudo apt install iputils-ping',
        )
        return
    command = [ping, '-n', '-q', '-c', str(_PINGS), '-i', '0.01', '-w', '10', address]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = run.stdout.splitlines()
    lost = next((line for line in lines if 'packet loss' in line), '')
    times = next((line for line in lines if 'min/avg/max' in line), '')
    if run.returncode or not times:
        reason = lost or (run.stderr.strip().splitlines() or ['no answer'])[-1]
        text = f'{address} does not answer: {reason.strip()}'
        yield problem(
            'robot', text, 'check the cable, the address, and that it is switched on'
        )
        return
    _, mean, largest = (float(each) for each in times.split('=')[1].split('/')[:3])
    text = f'answers within {mean:.2f} ms, at worst {largest:.2f} ms of {_PINGS}; {lost.strip()}'
    if mean > _SLOW:
        yield note(
            'robot', text, 'connect the robot by a cable of its own, without a switch'
        )
    else:
        yield ok('robot', text)


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return 'as installed' if importlib.util.find_spec(name) else ''
