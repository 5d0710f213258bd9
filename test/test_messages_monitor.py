# SPDX-License-Identifier: Apache-2.0
"""The monitor topic: distance to the bound, (29) term by term; its bound (32)."""

from __future__ import annotations

import numpy as np
import pytest
from paper_case import configured

import blf_dsc_controller as blf
from benchmark.decay import decay_rate, exponential_bound
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.simulation.loop import write_bag

LARGEST = np.linalg.eigvalsh([[2.12, 0.72], [0.72, 0.32]])[-1]  # kg m^2, of M stretched
P = (1.0, 0.32, 0.4)
LEAKY = {'two_link.leakage': 0.02, 'disturbance.gain': [50.0, 80.0]}


@pytest.mark.parametrize(
    ('law', 'rate'),
    [
        ({'two_link.leakage': 0.0}, 0.0),
        ({'two_link.learning_weight': 0.0}, 0.0),
        ({}, 2.0 * 2.0 * 1.0 * 0.05),
        ({'two_link.learning_weight': 90.0}, 0.02 * 50.0),
        ({'two_link.surface_gain': [0.1, 9.0]}, 0.1),
        ({'two_link.feedback_gain': [9.0, 0.1]}, 2.0 * 0.1 / LARGEST),
    ],
)
def test_decay_rate_is_the_smallest_of_the_four_in_equation_32(law, rate):
    config = configured('paper', 1.0, LEAKY | law).controller
    assert decay_rate(config, P) == pytest.approx(rate)


def test_bound_starts_at_the_latch_and_decays_to_theta_over_kappa_e():
    """Theta = eta |d3|^2 / 2, where |d3| is at most 0.1 + 0.1 N m on each joint."""
    config = configured('paper', 1.0, LEAKY).controller
    rate = decay_rate(config, P)
    floor = 0.5 * 0.02 * 2.0 * 0.2**2 / rate
    t = np.array([0.0, 1.5, 1e3])
    V = np.array([0.7, 0.1, 0.0])
    expected = [0.7, floor + (0.7 - floor) * np.exp(-rate * 1.5), floor]
    assert exponential_bound(config, rate, 0.2, t, V) == pytest.approx(expected)
    assert np.isnan(exponential_bound(config, 0.0, 0.2, t, V)).all()


def test_rejected_columns_are_in_the_summary_and_the_lyapunov_function_is_a_panel(
    tmp_path,
):
    """Run of 8 s from a bag, with a cosine column that the reference cannot excite."""
    learning = {'two_link.frequencies': [1.0], 'two_link.bias': False}
    config = configured('recommended', 8.0, learning)
    record = blf.simulate(config.controller, config.plant)
    write_bag(tmp_path / 'bag', record)
    run = blf.read_run(tmp_path / 'bag')
    metrics = blf.measure(run)
    (column,) = metrics.rejected_columns
    assert column.startswith('cos 1 rad/s ')
    assert f'rejected    {column}: ' in format_table(metrics)
    assert metrics.parameter_error.end < 0.5
    (panel,) = (panel for panel in panels([run]) if panel.group == 'Monitors')
    *terms, V = panel.lines
    assert [line.name for line in terms] == [
        'barrier',
        'velocity',
        'parameters',
        'disturbance',
    ]
    assert V.values[0] == pytest.approx(sum(line.values[0] for line in terms))
