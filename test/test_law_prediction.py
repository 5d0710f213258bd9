# SPDX-License-Identifier: Apache-2.0
"""Rows of the prediction error, and what each kind of row learns in a closed loop."""

from __future__ import annotations

import numpy as np
import pytest
from arbitrary_case import arbitrary
from closed_loop_case import P, R, closed_loop, controller, plant, quick, recommended
from paper_case import NO_DISTURBANCE, configured, run
from plain_law import dynamics
from scipy.signal import cont2discrete

from blf_dsc_controller.law import prediction
from blf_dsc_controller.law.factory import controller_of
from blf_dsc_controller.law.settings import EFFORT, LAMBDA, PREDICTIONS
from sim_plant.plant import plant_of

BIAS = (0.3, -0.2)


def filtered_rows(sample_time, duration=2.0):
    """Rows [X | u] of the arm swinging about its lowest point under held, varying torques."""
    law = controller(recommended(torque_source=EFFORT))
    arm = plant(sample_time=sample_time, start=(-1.2, 0.4), constant=BIAS, amplitude=(0.0, 0.0))
    rows = []
    for k in range(round(duration / sample_time)):
        t = k * sample_time
        law.update(t, sample_time, arm.measure())  # its torque is not used
        arm.step(np.array([2.0 * np.sin(3.0 * t), 1.5 * np.cos(5.0 * t)]))
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


def identity_error(torque_source):
    """Largest error of X theta = u while the actuator is three samples late."""
    law = controller(quick(torque_source=torque_source))
    arm = plant(delay=3, constant=BIAS, amplitude=(0.0, 0.0))
    theta = np.concatenate([P, BIAS])
    worst = 0.0
    for _ in closed_loop(law, arm, 1.0):
        worst = max(worst, np.abs(law.signals.row @ [*theta, -1.0]).max())
    return worst


def test_learning_uses_the_applied_torque():
    """With 'effort' the identity holds despite an actuator delay, with 'command' it does not."""
    of_command = identity_error(0)
    of_effort = identity_error(EFFORT)
    assert of_effort < 0.01
    assert of_command > 10.0 * of_effort


@pytest.mark.parametrize(
    'limit', [{'torque_limit': np.array([8.5, 20.0])}, {'rate_limit': np.array([400.0, 150.0])}]
)
def test_learning_from_the_command_uses_the_saturated_torque(limit):
    """The controller knows its own limits: the identity holds while the torque is cut."""
    law = controller(quick(**limit))
    arm = plant(constant=BIAS, amplitude=(0.0, 0.0))
    theta = np.concatenate([P, BIAS])
    worst, cut = 0.0, 0
    for _ in closed_loop(law, arm, 1.0):
        cut += law.signals.torque[0] != law.signals.demand[0]
        worst = max(worst, np.abs(law.signals.row @ [*theta, -1.0]).max())
    assert cut > 10
    assert worst < 0.01


ACCELERATION = PREDICTIONS.index('acceleration')


@pytest.mark.parametrize('omega', [1.0, 30.0, 1000.0])
@pytest.mark.parametrize('dt', [1e-3, 7e-3])
def test_differentiating_filter_matches_the_exact_discretisation_of_scipy(omega, dt):
    """(8) without its hat and with damping 1, for an input held over each sample."""
    settings, state, signals = arbitrary(4, omega=omega)
    system = (np.array([[0.0, 1.0], [-(omega**2), -2.0 * omega]]), np.array([[0.0], [omega**2]]))
    A, B, *_ = cont2discrete((*system, np.eye(2), np.zeros((2, 1))), dt)
    random = np.random.default_rng(0)
    state.samples[0] = 0.0
    expected = None
    for _ in range(100):
        signals.xi2[:] = random.normal(size=3)
        signals.dalpha2[:] = random.normal(size=3)
        prediction.differentiate(settings, state, signals, dt)
        if expected is None:
            expected = np.array([signals.xi2, np.zeros(3)])
        else:
            expected = A @ expected + B * signals.xi2
        state.samples[0] += 1.0
        np.testing.assert_allclose(state.observed, expected[0], atol=1e-12)
        np.testing.assert_allclose(state.observed_rate, expected[1], rtol=1e-9, atol=1e-9 * omega)
        np.testing.assert_allclose(
            signals.acceleration, signals.dalpha2 + expected[1], rtol=1e-9, atol=1e-9 * omega
        )


def transcribed_row(kind, law, q, dq, tau):
    """[X | u] as written in the module's docstring, from M, C, G of unit parameters."""
    ddq = law.signals.dalpha2 + law.state.observed_rate
    alpha2, dalpha2 = dq - law.signals.xi2, law.signals.dalpha2
    parts = [dynamics(e, R, q, dq) for e in np.eye(3)]
    if kind == ACCELERATION:
        return np.column_stack([*(M @ ddq + C @ dq + G for M, C, G in parts), *np.eye(2), tau])
    H = np.column_stack([M @ dalpha2 + C @ alpha2 + G for M, C, G in parts])
    x, y = np.array([*ddq, *dq, 1.0]), np.array([*dalpha2, *alpha2, 1.0])
    return np.column_stack([H, *(x @ y / (x @ x) * np.column_stack([np.eye(2), tau])).T])


@pytest.mark.parametrize('kind', [ACCELERATION, LAMBDA], ids=['acceleration', 'lambda'])
def test_row_follows_its_equation_in_a_closed_loop(kind):
    law = controller(recommended(prediction=kind, torque_source=EFFORT, omega=60.0))
    for sample in closed_loop(law, plant(delay=1), 0.5):
        q, dq, applied = sample.measurement.reshape(3, 2)
        expected = transcribed_row(kind, law, q, dq, applied)
        np.testing.assert_allclose(law.signals.row, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('kind', ['acceleration', 'lambda', 'filtered'])
@pytest.mark.parametrize('update', ['gradient', 'newton'])
def test_every_prediction_learns_the_parameters_without_disturbance(kind, update):
    """`filtered` is exact; the others are so up to the lag of (8), once the errors have decayed."""
    gains = {'newton': 100.0, 'gradient': 4.0}
    law = {
        'learning.prediction': kind,
        'learning.update': update,
        'learning.weight': gains[update],
        'learning.excitation_threshold': 0.05,
        'learning.bias': False,
    }
    loop = run(configured('recommended', 25.0, law, NO_DISTURBANCE))
    assert loop.parameter_error[-1] < (1e-4 if kind == 'filtered' else 1e-3)


def error_with_filter(omega):
    """Relative error of Phi_e^-1 b_e for the first window after T_a = 0.5 s, no disturbance."""
    law = {
        'learning.prediction': 'acceleration',
        'learning.derivative_filter': omega,
        'learning.weight': 0.0,
        'learning.bias': False,
    }
    config = configured('recommended', 8.0, law, NO_DISTURBANCE)
    controller, arm = controller_of(config.controller), plant_of(config.plant)
    for k in range(6800):
        controller.update(k * 1e-3, 1e-3, arm.measure())
        arm.step(controller.sample.torque)
    found = np.linalg.solve(controller.state.Phi, controller.state.b)
    return np.linalg.norm(found - P) / np.linalg.norm(P)


def test_erratum_9_frequency_of_the_filter_must_be_large():
    """The paper prints "omega sufficiently small"; the slower (8), the worse its derivative."""
    errors = [error_with_filter(omega) for omega in (1.0, 5.0, 20.0, 100.0)]
    assert np.all(np.diff(errors) < 0.0)
    assert errors[0] > 5e-3  # with 1 / omega = 1 s the start of the run is still in the window
    assert errors[-1] < 5e-4


def test_erratum_21_filter_starts_at_its_input_with_zero_slope():
    """From elsewhere (8) reports a false slope of up to omega z / e, which lasts for 10 / omega.

    The paper prints hatted initial values, which are unknown before the first sample.
    """
    omega, dt, z = 100.0, 1e-3, 0.3
    settings, state, signals = arbitrary(4, omega=omega)
    signals.xi2[:] = z
    state.samples[0] = 0.0
    slopes = []
    for k in range(150):
        prediction.differentiate(settings, state, signals, dt)
        state.samples[0] += 1.0
        slopes.append(abs(state.observed_rate).max())
        if k == 0:
            initial = slopes.pop()
            assert initial == 0.0
            prediction.differentiate(settings, state, signals, dt)
            assert abs(state.observed_rate).max() == 0.0
            state.observed[:] = 0.0  # as if z^(0) had been taken for zero
    assert max(slopes) == max(slopes[:30])
    np.testing.assert_allclose(max(slopes), omega * z / np.e, rtol=0.01)
    assert slopes[int(10.0 / omega / dt)] < 2e-3 * max(slopes)
