# SPDX-License-Identifier: Apache-2.0
"""The monitor topic: distance to the bound, (29) term by term; its bound (32)."""

from __future__ import annotations

import numpy as np
import pytest
from paper_case import EXACT, configured, instead

import blf_dsc_controller as blf
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.control.rejected_columns import rejected_columns
from blf_dsc_controller.factory.estimate import estimate_names
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law.lyapunov import (
    decay_rate,
    exponential_bound,
    largest_inertia,
)
from blf_dsc_controller.simulation.loop import write_bag

LARGEST = np.linalg.eigvalsh([[2.12, 0.72], [0.72, 0.32]])[-1]  # kg m^2, of M stretched
# (32) is for this form
PAPER = instead(compensation='state', bumpless=False)
LEAKY = EXACT | PAPER | {'two_link.leakage': 0.02, 'disturbance.gain': [50.0, 80.0]}


def settings(law):
    return settings_of_config(configured('recommended', 1.0, law).controller)


def test_largest_inertia_is_that_of_the_stretched_arm():
    assert largest_inertia(settings(EXACT)) == pytest.approx(LARGEST)


@pytest.mark.parametrize(
    ('law', 'rate'),
    [
        ({'two_link.leakage': 0.0}, 0.0),
        ({'disturbance.gain': [0.0, 1.0]}, 0.0),
        ({'two_link.learning_weight': 0.0}, 0.0),
        ({'law': 'backstepping'}, 0.0),
        ({'truth.parameters': []}, 0.0),
        ({'gains.compensation': 'reference'}, 0.0),
        ({'gains.bumpless': True}, 0.0),
        ({}, 0.02 * 50.0),
        ({'two_link.surface_gain': [0.3, 9.0]}, 0.3),
        ({'two_link.learning_weight': 0.1}, 2.0 * 0.1 * 0.5 * 0.003 / (0.003 + 1e-5)),
        (
            {'gains.update': 'gradient', 'two_link.learning_weight': 9.0},
            2.0 * 9.0 * 0.5 * 0.003,
        ),
        ({'two_link.feedback_gain': [9.0, 0.4]}, 2.0 * 0.4 / LARGEST),
    ],
)
def test_decay_rate_is_the_smallest_of_the_four_in_equation_32(law, rate):
    leaky = {
        name: value
        for name, value in LEAKY.items()
        if 'law' not in law or not name.startswith('gains.')
    }
    assert decay_rate(settings(leaky | law)) == pytest.approx(rate)


def test_bound_starts_at_the_latch_and_decays_to_theta_over_kappa_e():
    """Theta = eta |d3|^2 / 2, where |d3| is at most 0.1 + 0.1 N m on each joint."""
    law = settings(LEAKY)
    rate = decay_rate(law)
    floor = 0.5 * 0.02 * 2.0 * 0.2**2 / rate
    t = np.array([1.0, 2.0, 3.5, 1e3, 1001.0, 1002.0])
    V = np.array([3.0, 0.7, 0.1, 0.0, 9.0, 0.5])
    holds = np.array([0, 1, 1, 1, 0, 1]) > 0  # and begins anew
    expected = [
        np.nan,
        0.7,
        floor + (0.7 - floor) * np.exp(-rate * 1.5),
        floor,
        np.nan,
        0.5,
    ]
    assert exponential_bound(law, t, V, holds) == pytest.approx(expected, nan_ok=True)
    assert np.isnan(exponential_bound(settings({}), t, V, holds)).all()


def test_rejected_columns_are_in_the_summary_and_the_lyapunov_function_is_a_panel(
    tmp_path,
):
    """Run of 8 s from a bag, truth known, with a cosine column that the reference cannot excite."""
    learning = {'two_link.frequencies': [1.0], 'two_link.bias': False}
    config = configured('recommended', 8.0, LEAKY | learning)
    names = estimate_names(config.controller)
    for fresh in (config.controller, configured('model_based', 1.0).controller):
        assert rejected_columns(blf.controller_of(fresh), estimate_names(fresh)) == {}
    record = blf.simulate(config.controller, config.plant)
    write_bag(tmp_path / 'bag', record)
    run = blf.read_run(tmp_path / 'bag')
    metrics = blf.measure(run)
    (column,) = metrics.rejected_columns
    assert column.startswith('cos 1 rad/s ')
    (name,) = rejected_columns(record.controller, names)
    assert name == column.partition(':')[0]
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
