# SPDX-License-Identifier: Apache-2.0
"""Mistakes at the command line and in files: one line that says what to do, and nothing lost."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import pytest
import recorded_run
from command import finished
from recorded_run import Synthetic, limited_files

from blf_dsc_controller.cli import main as cli_main
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.compiled.announcement import COMPILING

INTERRUPTED_WHILE_COMPILING = """
import os, signal, sys
from numba.core.compiler_lock import global_compiler_lock
import blf_dsc_controller.cli.bags
from blf_dsc_controller.cli.main import main

class Finalizer:
    def __del__(self):  # as LLVM's callbacks, it swallows what is raised in it
        os.kill(os.getpid(), signal.SIGTERM)
        sum(range(1000))

def report(options):
    with global_compiler_lock:
        Finalizer()
        print('compiled on')

blf_dsc_controller.cli.bags.report = report
sys.exit(main(['report', 'bag']))
"""


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp('made') / 'bag'
    return recorded_run.write_made(path, Synthetic(100).messages())


NODES = [
    'sim_plant',
    'blf_dsc_controller',
    'bag_recorder',
    'torque_watchdog',
    'arm_view',
]
COMMANDS = 'run --offline, report, recover, export, excite, arms, monte-carlo'


@pytest.mark.parametrize('place', ['file/below', '/proc/none', '/dev/full'])
@pytest.mark.parametrize('command', COMMANDS.split(', '))
def test_unwritable_output_path_is_reported(
    bag, tmp_path, monkeypatch, capfd, command, place
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'file').touch()
    suffix = {'export': '.csv', 'excite': '.yaml'}.get(command)
    if suffix:
        (tmp_path / f'full{suffix}').symlink_to('/dev/full')
        place = {'/dev/full': f'full{suffix}'}.get(place, f'{place}{suffix}')
    words = [str(bag)] if command in ('report', 'recover', 'export') else []
    options = [place, '--config', 'panda'] if command == 'excite' else ['--out', place]
    assert main([*command.split(), *words, *options]) == 1
    lines = capfd.readouterr().err.splitlines()
    (error,) = (line for line in lines if COMPILING not in line)
    assert error.startswith(f'blf_dsc {command.split()[0]}: ')
    assert 'choose another' in error or 'is needed' in error
    assert '[Errno ' not in error


LONG = {  # commands, and what takes minutes, or moves a robot
    'commission --config ur5e --out no/x.yaml': 'commission._simulated',
    'commission --config fr3_direct --robot 172.16.0.2 --yes --out no/x.yaml': (
        'commission.robot'
    ),
    'identify BAG --urdf panda.urdf --out no/x.urdf': 'identify._identified',
    'identify BAG --urdf panda.urdf --report no/x.html': 'identify._identified',
    'commission --config ur5e --write no/x.yaml --posture 0 -1.5 1.5 -1.5 -15e-1 0': '',
}


@pytest.mark.parametrize('words', LONG)
def test_place_that_cannot_be_written_is_refused_before_minutes_of_work(
    bag, tmp_path, monkeypatch, capfd, words
):
    def begin(*_):
        pytest.fail('it has begun')

    monkeypatch.chdir(tmp_path)
    if LONG[words]:
        monkeypatch.setattr(f'blf_dsc_controller.cli.{LONG[words]}', begin)
    assert main([str(bag) if each == 'BAG' else each for each in words.split()]) == 1
    assert 'there is no folder no: make it, or choose' in capfd.readouterr().err
    assert not [*tmp_path.iterdir()]


def test_interrupt_during_kernel_compilation_ends_the_command():
    run = finished(sys.executable, '-c', INTERRUPTED_WHILE_COMPILING)
    assert (run.returncode, run.stdout) == (130, '')
    assert run.stderr == 'blf_dsc report: interrupted\n'


pytestmark = pytest.mark.usefixtures('blank_pictures')
WITHOUT_ROS = """
import sys
from importlib.machinery import PathFinder

class Hidden:
    @staticmethod
    def find_spec(name, path=None, target=None):
        return None if name.split('.')[0] == 'rclpy' else PathFinder.find_spec(name, path, target)

sys.meta_path[:] = [Hidden if finder is PathFinder else finder for finder in sys.meta_path]
from blf_dsc_controller.cli import main
command = sys.argv.pop(1)
sys.exit(getattr(main, command)())
"""
PLANT_NODE = (sys.executable, '-m', 'blf_dsc_controller.nodes.plant_node')


def here(capsys, *arguments):
    """Run `blf_dsc run` in this process."""
    code = main(['run', *map(str, arguments)])
    return subprocess.CompletedProcess(arguments, code, *capsys.readouterr())


def write_params(folder, plant='', controller=''):
    """Write a parameter file with these lines for the nodes."""
    path = folder / 'given.yaml'
    path.write_text(
        f'sim_plant:\n  ros__parameters: {{seed: 0, {plant}}}\n'
        f'blf_dsc_controller:\n  ros__parameters: {{law: blf_dsc, {controller}}}\n'
    )
    return path


def test_report_that_the_disk_does_not_hold_leaves_what_was_there(
    bag, tmp_path, capsys
):
    """Nor does it leave a stump of its own."""
    page = tmp_path / 'disk' / 'page.html'
    words = 'report', str(bag), '--out', str(page)
    with limited_files(tmp_path / 'disk', 20_000):
        page.write_text('old')
        assert main([*words, '--force']) == 1
        assert 'page.html cannot be written: File too large' in capsys.readouterr().err
        assert [each.read_text() for each in page.parent.iterdir()] == ['old']
    assert main([*words, '--force']) == 0
    assert [*page.parent.iterdir()] == [page]
    assert '</html>' in page.read_text()


@pytest.mark.parametrize(
    'command',
    [('main', 'run'), ('sim_plant',), ('blf_dsc_controller',), ('bag_recorder',)],
)
def test_without_ros_the_error_tells_how_to_source_it(tmp_path, command):
    out = tmp_path / 'out'
    run = finished(sys.executable, '-c', WITHOUT_ROS, *command, '--out', out)
    assert run.returncode == 1, run.stderr
    assert 'ROS 2 cannot be imported' in run.stderr
    assert 'source /opt/ros/jazzy/setup.bash' in run.stderr
    assert 'Traceback' not in run.stderr
    assert not out.exists()


def test_offline_run_needs_no_ros(tmp_path):
    offline = ('main', 'run', '--offline', '--duration', 0.1)
    run = finished(sys.executable, '-c', WITHOUT_ROS, *offline, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert 'wrote       closed_loop:' in run.stdout
    assert (tmp_path / 'closed_loop/bag/metadata.yaml').is_file()


def test_home_is_found_behind_an_equals_sign_too(tmp_path, monkeypatch):
    """Shells leave the ~ of --out=~/run as it is."""
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'my.yaml').write_text('/**: {ros__parameters: {sample_time: 0.002}}\n')
    words = ['--offline', '--duration=0.1', '--config=~/my.yaml', '--out=~/run']
    assert main(['run', *words]) == 0
    assert {each.name for each in tmp_path.iterdir()} == {'my.yaml', 'run'}


@pytest.mark.parametrize('name', NODES)
def test_node_tells_how_it_is_started(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, 'argv', [f'/opt/{name}', '--help'])
    assert getattr(cli_main, name)() == 0
    assert f'ros2 run blf_dsc_controller {name} --ros-args' in capsys.readouterr().out


def test_exit_code_shows_that_the_controller_stopped(tmp_path, capsys):
    path = write_params(tmp_path, controller='safety.velocity_limit: [0.0001, 0.0001]')
    out = tmp_path / 'out'
    run = here(capsys, '--config', path, '--offline', '--duration', 0.1, '--out', out)
    assert run.returncode == 5, run.stderr
    (stop,) = json.loads((out / 'summary.json').read_text())['stops']
    assert stop['reason'] == 'velocity not plausible'


def test_node_reports_what_is_wrong_with_its_arguments(tmp_path):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    broken = tmp_path / 'broken.yaml'
    misspelt = tmp_path / 'misspelt.yaml'
    broken.write_text('sim_plant:\n  ros__parameters:\n    seed: [1,\n')
    misspelt.write_text('sim_plant:\n  ros__parameters:\n    sede: 1\n')
    for words, expected in (
        (['--ros-args', '--params-file', broken], 'params'),
        (['--ros-args', '--params-file', misspelt], 'sede: unknown parameter'),
        (['--ros-args', '--param', 'seed:=1', '--sede'], '--sede'),
        (['--params-file', misspelt], 'ROS reads only those after --ros-args'),
    ):
        run = finished(*PLANT_NODE, *words)
        assert run.returncode == 1
        assert expected in run.stderr
        assert 'Traceback' not in run.stderr


@pytest.mark.parametrize(
    ('output', 'code', 'said'),
    [
        (
            '/dev/full',
            1,
            'blf_dsc export: what it says cannot be written: No space left',
        ),
        ('pipe', 0, ''),
    ],
)
def test_output_that_nobody_takes_ends_in_a_sentence_or_silently(
    bag, tmp_path, output, code, said
):
    reader, writer = os.pipe()
    os.close(reader)
    target = writer if output == 'pipe' else os.open(output, os.O_WRONLY)
    words = [sys.executable, '-m', 'blf_dsc_controller', 'export', str(bag), '--out']
    run = subprocess.run(
        [*words, str(tmp_path / 'a.csv')],
        stdout=target,
        stderr=subprocess.PIPE,
        env={**os.environ, 'PYTHONUNBUFFERED': ''},
        text=True,
        check=False,
    )
    assert run.returncode == code, run.stderr
    assert run.stderr.startswith(said)
    assert len(run.stderr.splitlines()) == bool(said)
    assert (tmp_path / 'a.csv').stat().st_size > 1000


@pytest.mark.parametrize(
    'command',
    [
        ['doctor', '--config', 'FILE'],
        ['drive', '--robot', 'simulated', '--duration', '0.01', '--config', 'FILE'],
        ['commission', '--config', 'FILE', '--out', 'FILE'],
    ],
)
def test_command_names_the_sections_that_no_node_reads(command, tmp_path, capsys):
    """Bounds and gains of a node of another name would be lost without a word."""
    path = tmp_path / 'given.yaml'
    path.write_text(
        '/**/blf_dsc_controller:\n  ros__parameters: {sample_time: 0.001}\n'
        '/**/controller:\n  ros__parameters: {barrier: {bound: [0.1, 0.1]}}\n'
    )
    main([str(path) if each == 'FILE' else each for each in command])
    said = ' '.join(''.join(capsys.readouterr()).split())
    assert 'reads the sections /**/controller (line ' in said


TOO_OLD = """
import sys, types
import rclpy
sys.modules['rclpy.experimental'] = types.ModuleType('rclpy.experimental')
from blf_dsc_controller.cli import main
command = sys.argv.pop(1)
sys.exit(getattr(main, command)())
"""


@pytest.mark.parametrize('command', [('bag_recorder',), ('main', 'run')])
@pytest.mark.parametrize(
    ('program', 'middleware', 'answer'),
    [
        (TOO_OLD, '', r'rclpy [\d.]+ has no EventsExecutor.* 7\.1\.4 or newer'),
        (
            WITHOUT_ROS.replace("'rclpy'", "'hides nothing'"),
            'rmw_absent_cpp',
            r'RMW_IMPLEMENTATION=rmw_absent_cpp: .*apt install ros-jazzy-rmw-absent-cpp',
        ),
    ],
)
def test_old_ros_and_missing_middleware_are_answered_in_one_line(
    command, program, middleware, answer
):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    environment = {**os.environ, 'RMW_IMPLEMENTATION': middleware}
    run = finished(sys.executable, '-c', program, *command, env=environment)
    assert run.returncode == 1
    (line,) = run.stderr.splitlines()
    assert re.search(answer, line)
