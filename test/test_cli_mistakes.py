# SPDX-License-Identifier: Apache-2.0
"""Any mistake on the command line gives one line on stderr."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import synthetic_bag
from command import finished
from synthetic_bag import Synthetic

from blf_dsc_controller.cli.main import main

INTERRUPTED_WHILE_COMPILING = """
import os, signal, sys
from numba.core.compiler_lock import global_compiler_lock
import blf_dsc_controller.cli.bags
from blf_dsc_controller.cli.main import main

class Finalizer:
    def __del__(self):  # as LLVM's callbacks, it swallows what is raised in it
        os.kill(os.getpid(), signal.SIGTERM)
        sum(range(1000))

def plot(options):
    with global_compiler_lock:
        Finalizer()
        print('compiled on')

blf_dsc_controller.cli.bags.plot = plot
sys.exit(main(['plot', 'bag']))
"""


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return synthetic_bag.write(tmp_path_factory.mktemp('made') / 'bag', Synthetic(100).messages())


@pytest.mark.parametrize('place', ['file/below', '/proc/none', '/dev/full'])
@pytest.mark.parametrize(
    'command',
    [
        'run --offline',
        'report',
        'plot',
        'recover',
        'export',
        'excite',
        'paper',
        'arms',
        'monte-carlo',
    ],
)
def test_unwritable_output_path_is_reported(bag, tmp_path, monkeypatch, capfd, command, place):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'file').touch()
    (tmp_path / 'full.csv').symlink_to('/dev/full')
    if command == 'export':
        place = {'/dev/full': 'full.csv'}.get(place, f'{place}.csv')
    words = [str(bag)] if command in ('report', 'plot', 'recover', 'export') else []
    options = [place, '--starts', '1'] if command == 'excite' else ['--out', place]
    assert main([*command.split(), *words, *options]) == 1
    _, errors = capfd.readouterr()
    assert errors.startswith(f'blf_dsc {command.split()[0]}: ')
    assert errors.count('\n') == 1
    assert 'cannot be written (' in errors or 'exists already' in errors
    assert 'choose another' in errors


def test_infinities_and_characters_missing_from_the_font_raise_no_warning(
    tmp_path, monkeypatch, capfd
):
    monkeypatch.setattr(synthetic_bag, 'JOINTS', ('关节', 'elbow'))
    made = Synthetic(4000)
    made.error[100:110, 0] = np.inf
    made.torque[200, 1], made.torque[201, 0] = -np.inf, 1e200
    made.reference[300:302, 0] = 1e308, -1e308
    made.estimate[500] = np.inf
    path = synthetic_bag.write(tmp_path / 'bag', made.messages())
    for words in (['plot', '--out', tmp_path], ['export', '--out', tmp_path / 'table.csv']):
        assert main([words[0], str(path), *map(str, words[1:])]) == 0
    out, errors = capfd.readouterr()
    assert 'VIOLATED, first by 关节 at 0.100 s' in out
    assert errors == ''


def test_interrupt_during_kernel_compilation_ends_the_command():
    run = finished(sys.executable, '-c', INTERRUPTED_WHILE_COMPILING)
    assert (run.returncode, run.stdout) == (130, '')
    assert run.stderr == 'blf_dsc plot: interrupted\n'
