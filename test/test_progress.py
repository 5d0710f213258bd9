# SPDX-License-Identifier: Apache-2.0
"""What takes more than some seconds says so before it begins, also where there is no terminal."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from test_cli_endings import write_arm

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.compiled.announcement import COMPILING


@pytest.fixture
def piped(tmp_path, monkeypatch):
    """Return the lines of a command whose output and errors are one pipe, as in `2>&1 | cat`."""
    write_arm(tmp_path)
    monkeypatch.chdir(tmp_path)

    def run(words):
        said = io.StringIO()
        with redirect_stdout(said), redirect_stderr(said):
            main(words.split())
        assert '\r' not in said.getvalue()  # of a bar
        return [line for line in said.getvalue().splitlines() if COMPILING not in line]

    return run


def in_order(lines, *beginnings):
    """Assert that lines begin so, one after the other."""
    at = -1
    for beginning in beginnings:
        later = [
            k for k, line in enumerate(lines) if k > at and line.startswith(beginning)
        ]
        assert later, (beginning, lines)
        at = later[0]


def test_identify_says_each_stage_before_its_results_in_a_pipe(piped):
    lines = piped('identify run.csv --urdf pendulum.urdf --report page.html')
    assert lines[0].startswith(
        'identifying from run.csv: some ten seconds for a minute'
    )
    result = 'pendulum.urdf identified from run.csv'
    stages = ('stage 1 of ', 'stage 2 of ', 'stage 3 of ')
    in_order(lines, *stages, result, 'drawing page.html: ', 'wrote page.html')


def test_error_in_a_recording_comes_alone_before_anything_else_is_said(piped):
    Path('run.csv').write_text('time,q1\n')
    (line,) = piped('identify run.csv --urdf pendulum.urdf --report page.html')
    assert line.startswith('blf_dsc identify: run.csv')


def test_commission_says_each_run_and_what_follows_in_a_pipe(piped):
    lines = piped('commission --config arm.yaml --posture 0.2')
    in_order(
        lines,
        'posture 1: ',
        'simulating 2 runs of 10.5 s, at some ten times real time',
        'run 1 of 2',
        'run 2 of 2',
        'choosing the gains by what was measured: some ten seconds',
        'hinge',
        'hinge',
        'wrote commissioned.yaml',
        'simulating the arm with these gains',
        'with these gains the simulated arm follows',
    )


def test_offline_run_and_search_say_how_long_they_take_in_a_pipe(piped):
    lines = piped('run --offline --config arm.yaml --out out')
    in_order(
        lines,
        'simulating 0.1 s, at some ten times real time',
        'reading the bag',
        'run ',
    )
    words = 'excite motion.yaml --config arm.yaml --starts 2 --harmonics 1'
    lines = piped(words)
    assert lines[:3] == [
        'searching from 2 starts: up to a minute or two for each',
        'start 1 of 2',
        'start 2 of 2',
    ]
