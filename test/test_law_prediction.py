# SPDX-License-Identifier: Apache-2.0
"""Rows of the prediction error, and what each kind of row learns in a closed loop."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import arbitrary, closed_loop, controller, plant, quick, recommended
from paper_case import NO_DISTURBANCE, P, configured, run
from plain_law import R, regressor
from plants import QUIET
from scipy.signal import cont2discrete

from blf_dsc_controller.law import prediction
from blf_dsc_controller.law.state import CHOICES

BIAS = (0.3, -0.2)


def filtered_rows(sample_time, duration=2.0):
    """Rows [X | u] of the arm swinging about its lowest point under held, varying torques."""
    law = controller(recommended())
    arm = plant(sample_time=sample_time, start=(-1.2, 0.4), constant=BIAS, amplitude=QUIET)
    rows = []
    for t in np.arange(round(duration / sample_time)) * sample_time:
        law.update(t, sample_time, arm.measure())
        law.state.torque[:] = 2.0 * np.sin(3.0 * t), 1.5 * np.cos(5.0 * t)  # instead of its own
        arm.step(law.state.torque)
        rows.append(law.signals.row.copy())
    return np.array(rows[1:])


def test_filtered_identity_holds_up_to_the_square_of_the_sample_time():
    theta = np.concatenate([P, BIAS])
    error = []
    for sample_time in (4e-3, 2e-3, 1e-3):
        rows = filtered_rows(sample_time)
        error.append(np.abs(rows[:, :, :-1] @ theta - rows[:, :, -1]).max())

    order = np.log2(np.divide(error[:-1], error[1:]))
    np.testing.assert_allclose(order, 2.0, atol=0.1)
    # The trapezoid's T^2 / 12 times (Yr P)'', up to some 400 N m/s^2 in this swing.
    assert error[-1] < 1e-6 / 12.0 * 500.0


@pytest.mark.parametrize(
    ('limit', 'values'), [('torque_limit', [8.5, 20.0]), ('rate_limit', [400.0, 150.0])]
)
def test_learning_uses_the_limited_torque(limit, values):
    """The controller knows its own limits: X theta = u holds while the torque is cut."""
    law, theta = controller(quick(**{limit: np.array(values)})), np.concatenate([P, BIAS, [-1.0]])
    worst, cut = 0.0, 0
    for _ in closed_loop(law, plant(constant=BIAS, amplitude=QUIET), 1.0):
        worst = max(worst, np.abs(law.signals.row @ theta).max())
        cut += law.signals.torque[0] != law.signals.demand[0]
    assert cut > 10
    assert worst < 0.01


LAMBDA = CHOICES['prediction'].index('lambda')


@pytest.mark.parametrize('omega', [1.0, 30.0, 1000.0])
@pytest.mark.parametrize('dt', [1e-3, 7e-3])
def test_differentiating_filter_matches_the_exact_discretisation_of_scipy(omega, dt):
    """(8) without its hat and with damping 1, for an input held over each sample."""
    settings, state, signals = arbitrary(4, omega=omega)
    system = (np.array([[0.0, 1.0], [-(omega**2), -2.0 * omega]]), np.array([[0.0], [omega**2]]))
    A, B, *_ = cont2discrete((*system, np.eye(2), np.zeros((2, 1))), dt)
    state.samples[0], rounding = 0.0, {'rtol': 1e-9, 'atol': 1e-9 * omega}
    for xi2, dalpha2 in np.random.default_rng(0).normal(size=(100, 2, 2)):
        signals.xi2[:], signals.dalpha2[:] = xi2, dalpha2
        prediction.differentiate(settings, state, signals, dt)
        if state.samples[0] == 0.0:
            expected = np.array([signals.xi2, np.zeros(2)])
        else:
            expected = A @ expected + B * signals.xi2
        state.samples[0] += 1.0
        np.testing.assert_allclose(state.observed, expected[0], atol=1e-12)
        np.testing.assert_allclose(state.observed_rate, expected[1], **rounding)
        np.testing.assert_allclose(signals.acceleration, signals.dalpha2 + expected[1], **rounding)


def test_row_of_lambda_follows_equation_24_in_a_closed_loop():
    law = controller(recommended(prediction=LAMBDA, omega=60.0))
    for sample in closed_loop(law, plant(), 0.5):
        q, dq, applied = sample.measurement.reshape(3, 2)
        dalpha2, alpha2 = law.signals.dalpha2, dq - law.signals.xi2
        x = np.array([*(dalpha2 + law.state.observed_rate), *dq, 1.0])
        y = np.array([*dalpha2, *alpha2, 1.0])
        rest = x @ y / (x @ x) * np.column_stack([np.eye(2), applied])
        expected = np.column_stack([regressor(R, q, dq, alpha2, dalpha2), rest])
        np.testing.assert_allclose(law.signals.row, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('kind', ['lambda', 'filtered'])
@pytest.mark.parametrize(('update', 'weight'), [('gradient', 4.0), ('newton', 100.0)])
def test_every_prediction_learns_the_parameters_without_disturbance(kind, update, weight):
    """`filtered` is exact; Lambda is so up to the lag of (8), once the errors have decayed."""
    law = {'prediction': kind, 'update': update, 'weight': weight, 'bias': False}
    law |= {'excitation_threshold': 0.05}
    law = {f'learning.{name}': value for name, value in law.items()}
    loop = run(configured('recommended', 25.0, law, NO_DISTURBANCE))
    assert loop.parameter_error[-1] < (1e-4 if kind == 'filtered' else 1e-3)


def error_with_filter(omega):
    """Largest error of ddq^ [rad/s^2] from 0.5 s on, where the reference has 0.3."""
    law = controller(recommended(prediction=LAMBDA, omega=omega))
    found = [
        (sample.measurement[2:4].copy(), law.signals.acceleration.copy())
        for sample in closed_loop(law, plant(), 2.0)
    ]
    velocity, ours = np.array(found).transpose(1, 0, 2)
    return np.abs(ours[1:] - np.diff(velocity, axis=0) / 1e-3)[500:].max()


def test_erratum_9_frequency_of_the_filter_must_be_large():
    """The paper prints "omega sufficiently small"; the slower (8), the worse its derivative."""
    errors = [error_with_filter(omega) for omega in (5.0, 20.0, 100.0)]
    assert np.all(np.diff(errors) < 0.0)
    assert errors[-1] < 0.03 * errors[0]


def test_erratum_21_filter_starts_at_its_input_with_zero_slope():
    """From elsewhere (8) reports a false slope of up to omega z / e, which lasts for 10 / omega.

    The paper prints hatted initial values, which are unknown before the first sample.
    """
    omega, dt, z = 100.0, 1e-3, 0.3
    settings, state, signals = arbitrary(4, omega=omega)
    signals.xi2[:] = z
    slopes = []
    for k in range(151):
        state.samples[0] = k
        if k == 2:
            state.observed[:] = 0.0  # as if z^(0) had been taken for zero
        prediction.differentiate(settings, state, signals, dt)
        slopes.append(abs(state.observed_rate).max())
    assert slopes[:2] == [0.0, 0.0]
    assert max(slopes) == max(slopes[:32])
    np.testing.assert_allclose(max(slopes), omega * z / np.e, rtol=0.01)
    assert slopes[int(10.0 / omega / dt) + 2] < 2e-3 * max(slopes)
