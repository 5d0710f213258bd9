# SPDX-License-Identifier: Apache-2.0
"""How every command ends at Ctrl-C and on a full disk: one line, and no file that is not whole."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import traceback
import warnings
from functools import cache
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest
from command import children_of, finished, wait_for
from recorded_run import limited_files

from blf_dsc_controller.cli.parser import make_parser
from blf_dsc_controller.cli.start import main
from blf_dsc_controller.compiled.announcement import COMPILING
from blf_dsc_controller.writing import PART

PENDULUM = """<robot name="pendulum">
  <link name="base"/>
  <link name="rod"><inertial>
    <origin xyz="0 0 -0.4"/><mass value="2.0"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/>
  </inertial></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="30" velocity="3"/></joint>
</robot>
"""
FILE = """/**:
  ros__parameters:
    robot: {urdf: pendulum.urdf}
/**/sim_plant:
  ros__parameters: {duration: 0.1, initial: {position: [0.2], velocity: [0.4]}}
/**/blf_dsc_controller:
  ros__parameters:
    reference: {type: sinusoids, frequency: [2.0], offset: [0.2], amplitude: [0.2], phase: [0.0]}
"""
COMMANDS = {
    'run': 'run --offline --config arm.yaml --out out',
    'replay': 'replay bag',
    'report': 'report bag --out page.html',
    'recover': 'recover bag --out clean',
    'export': 'export bag --out table.csv',
    'export to parquet': 'export bag --out table.parquet',
    'report as pictures': 'report bag --png pictures',
    'export-c': 'export-c --config arm.yaml --out law',
    'commission': 'commission --config arm.yaml --write motions.yaml',
    'excite': 'excite motion.yaml --config arm.yaml --starts 1 --harmonics 1',
    'identify': 'identify run.csv --urdf pendulum.urdf --out new.urdf --report i.html',
    'doctor': 'doctor --config arm.yaml',
}
"""One of each, where ROS and a robot are not needed; those have their own tests."""

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_ESCAPED = 99  # exit code after an exception that the command has let through
STUDY = """monte_carlo:
  ros__parameters: {base: arm.yaml, runs: 2}
"""
BEFORE_THEIR_LOOP = {
    'drive': 'drive --robot simulated --config arm.yaml --duration 0.1 --out moved',
    'monte-carlo': 'monte-carlo --config study.yaml --out study',
    'run over ROS': 'run --config arm.yaml --mode lockstep --duration 0.1 --out out',
}
"""Commands that need processes or real time: they end here before these begin."""
ELSEWHERE = {'arms'}  # which has processes of its own


def write_arm(folder):
    """Write an arm, its parameter file, and a recording of it into a folder."""
    (folder / 'pendulum.urdf').write_text(PENDULUM)
    (folder / 'arm.yaml').write_text(FILE)
    time = np.arange(0.0, 8.0, 0.01)
    q = 0.8 * np.sin(2.0 * time) + 0.4 * np.sin(5.0 * time)
    ddq = -3.2 * np.sin(2.0 * time) - 10.0 * np.sin(5.0 * time)
    torque = 0.5 * ddq + 9.0 * np.sin(q)
    rows = np.column_stack([time, q, torque])
    np.savetxt(
        folder / 'run.csv', rows, delimiter=',', header='time,q1,tau1', comments=''
    )


@pytest.fixture(scope='module')
def given(tmp_path_factory):
    """A folder with all that the commands read."""
    folder = tmp_path_factory.mktemp('given')
    write_arm(folder)
    (folder / 'study.yaml').write_text(STUDY)
    done = Ended(COMMANDS['run'].split(), folder)
    assert done.code == 0, done.lines
    (folder / 'out' / 'bag').rename(folder / 'bag')
    shutil.rmtree(folder / 'out')
    return folder


class Ended:
    """A command that has ended in a process of its own, forked in a folder.

    That gets SIGINT once it has opened, moved or made the file or folder number `at`, or
    once it has called so many functions.

    Attributes:
        writes: how many files and folders it has opened, moved or made.
        calls: how many functions it has called, if these are counted.
        lines: what it says to stderr, but for notices of compilation.
    """

    def __init__(self, words, folder, *, at=None, call=None):
        self.folder = folder
        (reader, writer), (heard, said) = os.pipe(), os.pipe()
        with warnings.catch_warnings():
            # threads of other tests
            warnings.simplefilter('ignore', DeprecationWarning)
            pid = os.fork()
        if pid == 0:
            _Child(words, folder, at, call).run(writer, said)
        os.close(writer)
        os.close(said)
        with os.fdopen(reader) as counted, os.fdopen(heard) as text:
            lines = text.read().splitlines()
            self.writes, self.calls = map(int, counted.read().split() or (0, 0))
        self.code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        self.lines = [line for line in lines if COMPILING not in line]

    @property
    def files(self):
        """Sizes of all files by their paths."""
        paths = (path for path in self.folder.rglob('*') if path.is_file())
        return {
            str(each.relative_to(self.folder)): each.stat().st_size for each in paths
        }


class _Child:
    """The forked process."""

    def __init__(self, words, folder, at, call):
        self.words, self.folder, self.at, self.call = words, folder, at, call
        self.writes = self.calls = 0

    def run(self, counted, said):
        """Run the command, and exit with its code whatever happens."""
        code = _ESCAPED
        os.chdir(self.folder)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(said, 2)
        os.close(said)
        sys.stdout, sys.stderr = open(1, 'w'), open(2, 'w')  # noqa: SIM115 - until the end
        sys.addaudithook(self.note)
        if self.call is not None:
            sys.setprofile(self.count)
        sys.argv = ['blf_dsc', *self.words]
        if self.words[0] == 'run':
            run_path(str(Path(__file__).parent / 'no_pictures' / 'sitecustomize.py'))
        try:
            code = main()
        except BaseException:  # noqa: BLE001 - it must not go on in this copy of pytest
            traceback.print_exc()
        finally:
            sys.setprofile(None)
            os.write(counted, f'{self.writes} {self.calls}'.encode())
            sys.stderr.flush()
            os._exit(code)

    def note(self, event, details):
        """Note a file or folder that is about to be opened, moved or made."""
        is_written = (
            event == 'open' and isinstance(details[2], int) and details[2] & _WRITING
        )
        if (
            not (is_written or event in ('os.mkdir', 'os.rename'))
            or details[0] == os.devnull
        ):
            return
        self.writes += 1
        if self.writes == self.at:
            sys.setprofile(self.interrupt)

    def interrupt(self, *_):
        """Interrupt the process, with the first return or call from now on."""
        sys.setprofile(None)
        os.kill(os.getpid(), signal.SIGINT)

    def count(self, _frame, event, _details):
        """Count a call."""
        self.calls += event == 'call'
        if self.calls == self.call:
            self.interrupt()


@pytest.fixture(scope='module')
def whole(given, tmp_path_factory):
    """Return how a command ends that is left alone."""

    @cache
    def end(name):
        # The first may write compiled kernels, too; the next ones only what they are for.
        for _ in range(2):
            folder = shutil.copytree(given, tmp_path_factory.mktemp('whole') / 'here')
            ended = Ended(COMMANDS[name].split(), folder)
        return ended

    return end


def test_each_command_is_tried_here_or_elsewhere():
    (commands,) = (each for each in make_parser()._actions if each.dest == 'command')
    tried = {words.split()[0] for words in (COMMANDS | BEFORE_THEIR_LOOP).values()}
    assert tried | ELSEWHERE == set(commands.choices)


@pytest.mark.parametrize('when', ['first', 'last'])
@pytest.mark.parametrize('name', COMMANDS)
def test_ctrl_c_while_files_are_written_is_one_line_and_leaves_none_in_part(
    given, whole, tmp_path, name, when
):
    """While the first is opened, and when the last has its name: also those of temporary data."""
    writes = whole(name).writes
    moment = {'at': 1 if when == 'first' else writes} if writes else {'call': 1000}
    ended = Ended(
        COMMANDS[name].split(), shutil.copytree(given, tmp_path / 'here'), **moment
    )
    is_interrupted(ended, name)
    assert ended.files.items() <= whole(name).files.items()


@pytest.mark.parametrize('at', [1, 2])
@pytest.mark.parametrize('name', BEFORE_THEIR_LOOP)
def test_ctrl_c_before_a_loop_begins_is_one_line_and_leaves_nothing(
    given, tmp_path, name, at
):
    folder = shutil.copytree(given, tmp_path / 'here')
    before = {*folder.rglob('*')}
    ended = Ended(BEFORE_THEIR_LOOP[name].split(), folder, at=at)
    is_interrupted(ended, name)
    assert {*folder.rglob('*')} == before


def is_interrupted(ended, name):
    assert ended.code == 130, ended.lines
    # before its options have been read, without the name
    assert ended.lines[-1] in (
        f'blf_dsc {name.split()[0]}: interrupted',
        'blf_dsc: interrupted',
    )
    assert not any('Traceback' in line for line in ended.lines)
    assert not any(file.endswith(PART) for file in ended.files)


def test_ctrl_c_ends_the_processes_that_compile_ahead_in_one_line(tmp_path):
    """A terminal sends it to all of them. What they have left in the cache is whole."""
    place = {'NUMBA_CACHE_DIR': str(tmp_path / 'cache')}
    words = ['-m', 'blf_dsc_controller', 'doctor', '--compile']
    started = subprocess.Popen(
        [sys.executable, *words],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | place,
        start_new_session=True,
    )
    wait_for(lambda: len(children_of(started.pid)) == 3)  # one is multiprocessing's own
    children = children_of(started.pid)
    os.killpg(started.pid, signal.SIGINT)
    lines = started.communicate()[1].splitlines()
    assert started.returncode == 130, lines
    said = [line for line in lines if COMPILING not in line]
    assert said == ['blf_dsc doctor: interrupted']
    wait_for(lambda: not any(Path(f'/proc/{each}').exists() for each in children))
    assert not [*tmp_path.rglob('*.tmp.*')]


@pytest.mark.parametrize('name', ['monte-carlo', 'run over ROS'])
def test_full_disk_before_a_loop_begins_is_one_line_and_leaves_no_file(
    given, tmp_path, name
):
    folder = shutil.copytree(given, tmp_path / 'here')
    is_full(BEFORE_THEIR_LOOP[name], folder, tmp_path)


@pytest.mark.parametrize('name', sorted(COMMANDS.keys() - {'doctor'}))
def test_full_disk_is_one_line_and_leaves_no_file(given, tmp_path, name):
    folder = shutil.copytree(given, tmp_path / 'here')
    is_full(COMMANDS[name], folder, tmp_path)


def is_full(words, folder, tmp_path):
    before = set(folder.rglob('*'))
    with limited_files(tmp_path / 'disk', 100):  # bytes
        ended = Ended(words.split(), folder)
    assert ended.code == 1
    assert ended.lines[-1].startswith(f'blf_dsc {words.split()[0]}: ')
    assert 'File too large' in ended.lines[-1]
    assert not any('Traceback' in line or 'Errno' in line for line in ended.lines)
    assert not any(path.is_file() for path in set(folder.rglob('*')) - before)


AT_IMPORTS = """
import os, signal, sys

class Interrupting:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name == 'argparse':
            os.kill(os.getpid(), signal.{})

sys.meta_path.insert(0, Interrupting)
from blf_dsc_controller.cli.start import {}
sys.exit({}())
"""


@pytest.mark.parametrize('number', ['SIGINT', 'SIGTERM'])
@pytest.mark.parametrize(
    ('executable', 'answer'),
    [('main', (130, 'blf_dsc: interrupted\n')), ('sim_plant', (0, ''))],
)
def test_signal_while_a_command_is_imported_gives_no_traceback(
    executable, answer, number
):
    code = AT_IMPORTS.format(number, executable, executable)
    run = finished(sys.executable, '-c', code)
    assert (run.returncode, run.stderr) == answer
