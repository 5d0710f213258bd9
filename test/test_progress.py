# SPDX-License-Identifier: Apache-2.0
"""What takes more than some seconds says so before it begins, also where there is no terminal."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from test_cli_endings import FILE, PENDULUM

from blf_dsc_controller.compiled.announcement import COMPILING
from blf_dsc_controller.identification.identify import STAGES

COMMAND = (sys.executable, '-m', 'blf_dsc_controller')


@pytest.fixture
def given(tmp_path):
    """A folder with an arm, its parameter file, and a recording of it."""
    (tmp_path / 'pendulum.urdf').write_text(PENDULUM)
    (tmp_path / 'arm.yaml').write_text(FILE)
    time = np.arange(0.0, 8.0, 0.01)
    q = 0.8 * np.sin(2.0 * time) + 0.4 * np.sin(5.0 * time)
    ddq = -3.2 * np.sin(2.0 * time) - 10.0 * np.sin(5.0 * time)
    rows = np.column_stack([time, q, 0.5 * ddq + 9.0 * np.sin(q)])
    path = tmp_path / 'run.csv'
    np.savetxt(path, rows, delimiter=',', header='time,q1,tau1', comments='')
    return tmp_path


def piped(folder, words):
    """Return the lines of a command whose output and errors are one pipe, as in `2>&1 | cat`."""
    run = subprocess.run(
        [*COMMAND, *words.split()],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'},
        cwd=folder,
        text=True,
        check=False,
    )
    assert '\r' not in run.stdout  # of a bar
    return [line for line in run.stdout.splitlines() if COMPILING not in line]


def in_order(lines, *beginnings):
    """Assert that lines begin so, one after the other."""
    at = -1
    for beginning in beginnings:
        later = [
            k for k, line in enumerate(lines) if k > at and line.startswith(beginning)
        ]
        assert later, (beginning, lines)
        at = later[0]


def test_identify_says_each_stage_before_its_results_in_a_pipe(given):
    lines = piped(given, 'identify run.csv --urdf pendulum.urdf --report page.html')
    assert lines[0].startswith(
        'identifying from run.csv: some ten seconds for a minute'
    )
    _, *names = STAGES  # reading is silent, unless files are large
    stages = [f'stage {k} of {len(names)}: {name}' for k, name in enumerate(names, 1)]
    assert lines[1 : len(names) + 1] == stages
    result = 'pendulum.urdf identified from run.csv'
    in_order(lines, stages[-1], result, 'drawing page.html: ', 'wrote page.html')


def test_error_in_a_recording_comes_alone_before_anything_else_is_said(given):
    (given / 'run.csv').write_text('time,q1\n')
    (line,) = piped(given, 'identify run.csv --urdf pendulum.urdf --report page.html')
    assert line.startswith('blf_dsc identify: run.csv')


def test_commission_says_each_run_and_what_follows_in_a_pipe(given):
    lines = piped(given, 'commission --config arm.yaml')
    in_order(
        lines,
        'posture 1: ',
        'simulating 4 runs of 10.5 s, at some ten times real time',
        'run 1 of 4',
        'run 4 of 4',
        'choosing the gains by what was measured: some ten seconds',
        'hinge',
        'hinge',
        'wrote commissioned.yaml',
        'simulating the arm with these gains',
        'with these gains the simulated arm follows',
    )


def test_offline_run_and_search_say_how_long_they_take_in_a_pipe(given):
    lines = piped(given, 'run --offline --config arm.yaml --out out')
    in_order(
        lines,
        'simulating 0.1 s, at some ten times real time',
        'reading the bag',
        'run ',
    )
    words = 'excite motion.yaml --config arm.yaml --starts 2 --harmonics 1'
    lines = piped(given, words)
    assert lines[:3] == [
        'searching from 2 starts: up to a minute or two for each',
        'start 1 of 2',
        'start 2 of 2',
    ]
