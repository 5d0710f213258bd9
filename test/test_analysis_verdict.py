# SPDX-License-Identifier: Apache-2.0
"""What a report says first: whether the bound was kept, and the figures that matter."""

from __future__ import annotations

from dataclasses import replace

import pytest
import recorded_run
from recorded_run import Synthetic

from blf_dsc_controller import measure, read_run
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.analysis.verdict import verdict_of


@pytest.fixture(scope='module')
def metrics(tmp_path_factory):
    bag = tmp_path_factory.mktemp('made') / 'bag'
    return measure(read_run(recorded_run.write_made(bag, Synthetic(2000).messages())))


STOP = {'time': 3.25, 'reason': 'state timeout', 'text': 'no state for 0.05 s'}
LEFT = {'first_violation': 1.5, 'violating_joint': 'elbow', 'held': False}


@pytest.mark.parametrize(
    ('given', 'tone', 'text'),
    [
        ({}, 'good', 'Every joint stayed inside its bound.'),
        (LEFT, 'bad', 'elbow left its bound at 1.500 s.'),
        ({'stops': [STOP]}, 'bad', 'Stopped at 3.250 s: state timeout.'),
        (LEFT | {'stops': [STOP]}, 'bad', 'elbow left its bound at 1.500 s.'),
        ({'held': None}, 'unknown', 'The bag has no bounds, or no errors, to compare.'),
    ],
)
def test_verdict_names_what_went_wrong_first(metrics, given, tone, text):
    assert verdict_of(replace(metrics, **given)) == (tone, text)


def test_table_for_the_terminal_aligns_titles_and_sentences(metrics):
    lines = format_table(metrics).partition('\n\n')[2].splitlines()
    assert lines[0] == 'run         1.999 s, 2000 samples'
    assert lines[1] == 'bound       held by every joint'


@pytest.mark.parametrize(
    ('ratio', 'ending'),
    [
        (0.97, ', by the error of the stop; the table ends with the sample before'),
        (1.2, ''),
    ],
)
def test_bound_that_is_left_inside_the_table_is_explained(metrics, ratio, ending):
    """No message has the sample that causes a stop."""
    left = replace(metrics, **LEFT, max_error_ratio=ratio)
    line = format_table(left).partition('\n\n')[2].splitlines()[1]
    assert line == f'bound       VIOLATED, first by elbow at 1.500 s{ending}'
