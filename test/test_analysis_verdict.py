# SPDX-License-Identifier: Apache-2.0
"""What a report says first: whether the bound was kept, and the figures that matter."""

from __future__ import annotations

from dataclasses import replace
from math import nan

import pytest
import recorded_run
from recorded_run import Synthetic

from blf_dsc_controller.analysis.metrics import ParameterError, measure
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.analysis.verdict import figures_of, verdict_of
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.messages.topics import LOAD


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


def load(mass, interval):
    """Return a load as weighed; its centre is not known."""
    return dict.fromkeys(LOAD, nan) | {LOAD[0]: mass, LOAD[4]: interval, 'until': 9.0}


@pytest.mark.parametrize(
    ('given', 'title', 'expected'),
    [
        ({}, 'of the bound', ('40 %', 'largest error, any joint')),
        (
            LEFT | {'max_error_ratio': 0.97},
            'of the bound',
            ('97 %', 'largest error, any joint, before the stop'),
        ),
        (
            LEFT | {'max_error_ratio': 1.2},
            'of the bound',
            ('120 %', 'largest error, any joint'),
        ),
        ({'max_error_ratio': nan}, 'of the bound', ('-', 'not recorded')),
        ({}, 'largest error', ('0.8 mrad', 'shoulder')),
        ({'sliding': ('shoulder',)}, 'largest error', ('0.8 mm', 'shoulder')),
        ({'max_error': (nan, nan)}, 'largest error', ('-', 'not recorded')),
        ({'loads': []}, 'load', ('none', 'was weighed')),
        (
            {'loads': [load(nan, nan), load(0.01, 0.02)]},
            'load',
            ('none', 'was weighed'),
        ),
        (
            {'loads': [load(0.5, 0.1), load(2.0, 0.05), load(nan, nan)]},
            'heaviest load',
            ('2.000 kg', '± 0.05 kg'),
        ),
        (
            {'parameter_error': ParameterError(of_torques=True, end=0.012)},
            'model error',
            ('1.2 %', 'of the torque, at the end'),
        ),
        (
            {'parameter_error': ParameterError(), 'learns': False},
            'model',
            ('given', 'this law learns none'),
        ),
        (
            {'parameter_error': ParameterError(), 'learns': True, 'latch_time': nan},
            'model',
            ('as given', 'learning never began'),
        ),
        (
            {'parameter_error': ParameterError(), 'learns': True, 'latch_time': 1.5},
            'model',
            ('learned', 'from 1.5 s on'),
        ),
        ({}, 'stops', ('0', '')),
        ({'stops': [STOP, STOP]}, 'stops', ('2', 'first at 3.250 s')),
    ],
)
def test_figures_say_what_belongs_to_them(metrics, given, title, expected):
    figures = {each.title: each[1:] for each in figures_of(replace(metrics, **given))}
    assert len(figures) == 5
    assert figures[title] == expected


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
