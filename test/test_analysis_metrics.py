# SPDX-License-Identifier: Apache-2.0
"""Metrics of synthetic runs, whose numbers are known, and estimates against the truth."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
import recorded_run
from recorded_run import BOUND_RAD, LATCH_S, LIMIT_NM, PARAMETERS, TRUE, Synthetic

from blf_dsc_controller import measure, read_run, simulate
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.simulation.loop import write_bag

SAMPLES = 10_000


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    messages = Synthetic(SAMPLES).messages(with_timing=True)
    return read_run(
        recorded_run.write_made(tmp_path_factory.mktemp('made') / 'bag', messages)
    )


def test_tracking(run):
    metrics = measure(run)
    assert metrics.duration == pytest.approx(9.999)
    assert metrics.samples == SAMPLES
    assert metrics.held is True
    assert np.isnan(metrics.first_violation)
    # Whole periods of sinusoids: the rms is the amplitude over sqrt(2).
    assert metrics.max_error == pytest.approx((0.0008, 0.0005))
    assert metrics.rms_error == pytest.approx(np.array((0.0008, 0.0005)) / np.sqrt(2))
    assert metrics.peak_torque == pytest.approx((8.0, 3.0))
    assert metrics.rms_torque == pytest.approx(np.array((8.0, 3.0)) / np.sqrt(2))
    assert metrics.bound == (BOUND_RAD, BOUND_RAD)
    assert metrics.torque_limit == (LIMIT_NM, LIMIT_NM)
    assert metrics.max_error_ratio == pytest.approx(0.4)
    rate = 2 * np.pi / np.sqrt(2)  # 1/s, of a sinusoid of 1 Hz
    assert metrics.torque_rate == pytest.approx((8.0 * rate, 3.0 * rate), rel=1e-4)


def test_learning(run):
    metrics = measure(run)
    assert metrics.latch_time == pytest.approx(LATCH_S)
    errors = {
        t: error
        for t, error in metrics.parameter_error.at.items()
        if not np.isnan(error)
    }
    # The run ends one sample before 10 s, which counts as 10 s.
    assert errors == {
        5: pytest.approx(0.5 * np.exp(-3.5)),
        10: metrics.parameter_error.end,
    }
    assert metrics.parameter_error.end == pytest.approx(0.5 * np.exp(-8.499))
    # 0.5 exp(-t) = 0.01 at t = ln 50 after the latch, seen at the next sample.
    assert metrics.parameter_error.time_to_1_percent == pytest.approx(
        LATCH_S + np.log(50), abs=1e-3
    )
    assert metrics.true == dict(zip(PARAMETERS, TRUE, strict=True))
    assert list(metrics.estimate) == list(PARAMETERS)
    values = run.monitor.values.copy()
    values[-1, 0] = 0.0  # it has to stay below
    left = replace(run, monitor=replace(run.monitor, values=values))
    assert np.isnan(measure(left).parameter_error.time_to_1_percent)


def test_timing(run):
    timing = measure(run).timing
    assert timing['rate'] == pytest.approx(1000.0)
    # Latencies of 0, 1, 2 ... 9999 us.
    expected = {
        'p50': 4999.5e-6,
        'p99': 9899.01e-6,
        'p99.9': 9989.001e-6,
        'max': 9999e-6,
    }
    assert timing['latency'] == pytest.approx(expected)
    assert timing['late_steps'] == 99
    slow = replace(run, received=run.received * 2)  # the rate is by the wall clock
    assert measure(slow).timing['rate'] == pytest.approx(500.0)


def test_table_shows_the_metrics_and_what_is_unusual(run):
    bound = run.bound.copy()
    late = run.timing.values.copy()
    bound[:100, 1] = 0.0123
    late[-1, run.timing.names.index('late_steps')] = 0.02 * SAMPLES
    timing = replace(run.timing, values=late)
    unknown = {'error': None, 'monitor': None, 'timing': None}
    early = run.monitor.stamp < run.monitor.stamp[0] + 1e9 * LATCH_S  # not yet
    learning = run.monitor
    waiting = replace(
        learning, stamp=learning.stamp[early], values=learning.values[early]
    )
    usual = format_table(measure(run))
    for text in (
        'shoulder  0.800 mrad  0.566 mrad  2.000 mrad     8.00 N m    5.66 N m  20.00 N m',
        'held by every joint',
        'began at 1.500 s',
        '5 s 1.51 %',
        'below 1 % from 5.413 s on',
        '1000.00 Hz',
        '99 late steps',
    ):
        assert text in usual
    assert max(map(len, usual.splitlines())) <= 120
    changed = format_table(replace(measure(run), model_changes=(3.0,)))
    assert 'arm         changed at 3.000 s: learning restarted' in changed
    assert 'changed at' not in usual
    for changes, line in (
        ({'bound': bound}, '\nat widest   elbow 12.3 mrad\n'),
        ({'timing': timing}, '200 late steps: the computer was too busy for real time'),
        ({'error': run.error + 1.0}, 'VIOLATED, first by shoulder at 0.000 s'),
        (unknown, 'bound       unknown'),
        ({'monitor': waiting}, 'learning    never began'),
    ):
        assert line in format_table(measure(replace(run, **changes)))
        assert line not in usual


@pytest.mark.parametrize(
    ('changes', 'line'),
    [
        ({}, 'began at 0.8'),  # s: the filters settle for 0.5, a window is 0.3 long
        ({'learning.enabled': False}, 'not used by this law'),
        ({'law': 'slotine_li'}, 'not used by this law'),
    ],
)
def test_learning_begins_only_in_a_law_that_learns_in_simulation_and_its_bag(
    changes, line, tmp_path
):
    config = recorded_run.loop_config(**changes)
    record = simulate(config.controller, config.plant)
    write_bag(tmp_path / 'bag', record)
    simulated = measure(record.run())
    recorded = measure(read_run(tmp_path / 'bag'))
    tail = simulated.parameter_error.tail  # of every sample
    found = replace(recorded.parameter_error, tail=tail)
    found = replace(recorded, parameter_error=found)
    np.testing.assert_equal(asdict(found), asdict(simulated))
    is_latched = record.run().monitor.column('latched')[-1] == 1.0
    assert is_latched == ('law' not in changes)
    assert f'learning    {line}' in format_table(recorded)
    assert np.isnan(recorded.latch_time) == bool(changes)
