# SPDX-License-Identifier: Apache-2.0
"""The summary of a synthetic run has the numbers it was generated from."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import recorded_run
import synthetic_bag
from synthetic_bag import BOUND_RAD, JOINTS, LATCH_S, LIMIT_NM, PARAMETERS, TRUE, Synthetic

from blf_dsc_controller.analysis.metrics import measure
from blf_dsc_controller.analysis.summary import format_table, summarize, write_summary
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.messages.topics import BOUND, JOINT_STATES, LATE_STEPS, TRUTH
from blf_dsc_controller.run import Series
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate

SAMPLES = 10_000


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    messages = Synthetic(SAMPLES).messages(with_timing=True)
    return read_run(synthetic_bag.write(tmp_path_factory.mktemp('made') / 'bag', messages))


def test_tracking(run):
    summary = summarize(run)
    assert summary['duration_s'] == pytest.approx(9.999)
    assert summary['samples'] == SAMPLES
    counts = [summary['messages'][topic.resolved] for topic in (JOINT_STATES, TRUTH, BOUND)]
    assert counts == [SAMPLES, SAMPLES / 10, 1]
    assert summary['tracking']['held'] is True
    assert summary['tracking']['first_violation'] is None
    shoulder, elbow = (summary['tracking']['joints'][joint] for joint in JOINTS)
    # Whole periods of sinusoids: the rms is the amplitude over sqrt(2).
    assert shoulder['max_abs_error_rad'] == pytest.approx(0.0008)
    assert shoulder['rms_error_rad'] == pytest.approx(0.0008 / np.sqrt(2))
    assert elbow['max_abs_error_rad'] == pytest.approx(0.0005)
    assert elbow['peak_torque_nm'] == pytest.approx(3.0)
    assert elbow['rms_torque_nm'] == pytest.approx(3.0 / np.sqrt(2))
    assert shoulder['bound_rad'] == BOUND_RAD
    assert shoulder['torque_limit_nm'] == LIMIT_NM
    metrics = measure(run)
    assert metrics.max_error_ratio == pytest.approx(0.4)
    rate = 2 * np.pi / np.sqrt(2)  # 1/s, of a sinusoid of 1 Hz
    assert metrics.torque_rate == pytest.approx((8.0 * rate, 3.0 * rate), rel=1e-4)


def test_first_violation_is_the_earliest_of_all_joints(run):
    error = run.error.copy()
    error[4000, 0] = 0.0021
    error[3000, 1] = -BOUND_RAD  # on the bound counts as outside: the barrier is infinite there
    tracking = summarize(dataclasses.replace(run, error=error))['tracking']
    assert tracking['held'] is False
    assert tracking['first_violation'] == {'time_s': pytest.approx(3.0), 'joint': 'elbow'}


def test_learning(run):
    learning = summarize(run)['learning']
    assert learning['latch_time_s'] == pytest.approx(LATCH_S)
    errors = learning['relative_error_at_s']
    # The run ends one sample before 10 s, which counts as 10 s.
    assert list(errors) == ['5', '10']
    assert errors['5'] == pytest.approx(0.5 * np.exp(-3.5))
    assert errors['10'] == learning['final_relative_error']
    assert learning['final_relative_error'] == pytest.approx(0.5 * np.exp(-8.499))
    # 0.5 exp(-t) = 0.01 at t = ln 50 after the latch, seen at the next sample.
    assert learning['time_to_1_percent_s'] == pytest.approx(LATCH_S + np.log(50), abs=1e-3)
    assert learning['true'] == dict(zip(PARAMETERS, TRUE, strict=True))
    assert list(learning['final_estimate']) == list(PARAMETERS)
    values = run.monitor.values.copy()
    values[-1, 0] = 0.0  # it has to stay below
    left = dataclasses.replace(run, monitor=dataclasses.replace(run.monitor, values=values))
    assert summarize(left)['learning']['time_to_1_percent_s'] is None


def test_timing(run):
    timing = summarize(run)['timing']
    assert timing['rate_hz'] == pytest.approx(1000.0)
    # Latencies of 0, 1, 2 ... 9999 us.
    expected = {'p50': 4999.5, 'p99': 9899.01, 'p99.9': 9989.001, 'max': 9999.0}
    assert timing['latency_us'] == pytest.approx(expected)
    assert timing['late_steps'] == 99
    assert summarize(run)['compute_time_us']['p50'] == pytest.approx(4.9995)
    slow = dataclasses.replace(run, received=run.received * 2)  # the rate is by the wall clock
    assert summarize(slow)['timing']['rate_hz'] == pytest.approx(500.0)
    values = run.monitor.values.copy()
    values[:, run.monitor.names.index('compute_time')] = np.nan
    unmeasured = dataclasses.replace(run.monitor, values=values)
    assert summarize(dataclasses.replace(run, monitor=unmeasured))['compute_time_us'] is None


def test_unknown_values_are_null_and_never_nan(run, tmp_path):
    optional = ('reference', 'error', 'bound', 'torque_limit', 'monitor', 'truth', 'timing')
    unknown = dict.fromkeys(optional) | {'torque': np.full_like(run.torque, np.nan)}
    summary = summarize(dataclasses.replace(run, **unknown))
    write_summary(summary, tmp_path / 'summary.json')
    assert json.loads((tmp_path / 'summary.json').read_text()) == summary
    assert summary['learning'] is None
    assert summary['tracking']['held'] is None
    assert summary['compute_time_us'] is None
    assert set(summary['tracking']['joints']['elbow'].values()) == {None}
    learning = summarize(dataclasses.replace(run, truth=None))['learning']
    assert (learning['final_relative_error'], learning['true']) == (None, None)
    assert list(learning['final_estimate']) == list(PARAMETERS)


def test_table_shows_what_is_unusual(run):
    """A wide bound, late steps, a violation, an unknown bound."""
    bound, late = run.bound.copy(), run.timing.values.copy()
    bound[:100, 1] = 0.0123
    late[-1, run.timing.names.index(LATE_STEPS)] = 0.02 * SAMPLES
    timing = dataclasses.replace(run.timing, values=late)
    unknown = {'error': None, 'monitor': None, 'timing': None}
    early = run.monitor.stamp < run.monitor.stamp[0] + 1e9 * LATCH_S  # not yet
    learning = run.monitor
    waiting = Series(learning.names, learning.stamp[early], learning.values[early])
    usual = format_table(summarize(run))
    for changes, line in (
        ({'bound': bound}, '\nat widest   elbow 12.3 mrad\n'),
        ({'timing': timing}, '200 late steps: the computer was too busy for real time'),
        ({'error': run.error + 1.0}, 'VIOLATED, first by shoulder at 0.000 s'),
        (unknown, 'bound       unknown'),
        ({'monitor': waiting}, 'learning    never began'),
    ):
        assert line in format_table(summarize(dataclasses.replace(run, **changes)))
        assert line not in usual


def test_table_shows_the_summary(run):
    table = format_table(summarize(run))
    for text in (
        'shoulder  0.800 mrad  0.566 mrad  2.000 mrad     8.00 N m    5.66 N m  20.00 N m',
        'held by every joint',
        'began at 1.500 s',
        '5 s 1.51 %',
        'below 1 % from 5.413 s on',
        '1000.00 Hz',
        '99 late steps',
    ):
        assert text in table
    assert max(map(len, table.splitlines())) <= 120


@pytest.mark.parametrize(
    ('changes', 'line'),
    [
        ({}, 'began at 0.6'),
        ({'learning.weight': 0.0}, 'not used by this law'),
        ({'law': 'slotine_li'}, 'not used by this law'),
    ],
)
def test_learning_begins_only_in_a_law_that_learns_in_simulation_and_its_bag(
    changes, line, tmp_path
):
    config = recorded_run.loop_config(**changes)
    record = simulate(config.controller, config.plant)
    write_bag(tmp_path / 'bag', record, config.controller, 'none')
    simulated, recorded = summarize(record.run()), summarize(read_run(tmp_path / 'bag'))
    for part in ('duration_s', 'samples', 'tracking', 'learning'):
        assert simulated[part] == recorded[part]
    assert record.run().monitor.column('latched')[-1] == 1.0
    assert f'learning    {line}' in format_table(recorded)
    assert (recorded['learning']['latch_time_s'] is None) == bool(changes)
