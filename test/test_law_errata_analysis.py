# SPDX-License-Identifier: Apache-2.0
"""The paper's printed analysis against the corrected one: each erratum by its number."""

from __future__ import annotations

import numpy as np
import plants
import pytest
from arbitrary_case import arbitrary
from closed_loop_case import QUIET, closed_loop, controller, plant, recommended
from paper_case import EXACT, configured, run
from plain_law import dynamics

from blf_dsc_controller.law import prediction
from blf_dsc_controller.law.settings import EFFORT, FILTERED, LAMBDA, PREDICTIONS
from blf_dsc_controller.law.state import sample_of
from blf_dsc_controller.simulation.loop import simulate

P = np.array([1.0, 0.32, 0.4])
R = 9.8  # 1/s^2
ACCELERATION = PREDICTIONS.index('acceleration')


def rows_of_a_loop(prediction, duration=1.0):
    """Yield X P - u of each sample without disturbances, with the controller that formed it.

    The filter (8) and those of the regressor settle within the first fifth of a second.
    """
    law = controller(recommended(bias=False, prediction=prediction, torque_source=EFFORT))
    arm = plant(constant=QUIET, amplitude=QUIET)
    for sample in closed_loop(law, arm, duration):
        if sample.t > 0.2:
            row = law.signals.row
            yield row[:, :3] @ P - row[:, 3], law, sample


def test_erratum_6_known_part_of_the_dynamics_is_subtracted():
    """(23): M xi2' + C xi2 is the torque LESS M alpha2' + C alpha2 + G; printed is a plus."""
    alpha2, corrected, printed = None, 0.0, np.inf
    for residual, law, sample in rows_of_a_loop(ACCELERATION):
        if alpha2 is not None:
            q, dq = sample.measurement[:2], sample.measurement[2:4]
            M, C, G = dynamics(P, R, q, dq)
            known = M @ law.signals.dalpha2 + C @ alpha2 + G
            corrected = max(corrected, np.linalg.norm(residual))
            printed = min(printed, np.linalg.norm(residual - 2.0 * known))
        alpha2 = law.state.alpha2.copy()
    assert corrected < 0.05  # N m, the lag of (8)
    assert printed > 5.0


def test_erratum_7_lambda_changes_with_the_unit_of_the_angles():
    """(24): x holds rad/s^2, rad/s and a plain 1, and Lambda adds their squares."""
    settings, state, signals = arbitrary(1, 2, 3)
    xi2, rate = np.array([0.0, 0.0]), np.array([0.1, 0.0])
    factors = []
    for unit in (1.0, 180.0 / np.pi):
        for error in (1.0, 0.0):
            state.alpha2[:], signals.dalpha2[:] = unit * np.array([[0.2, 0.1], [0.3, -0.3]])
            signals.acceleration[:] = signals.dalpha2 + unit * error * rate
            dq = state.alpha2 + unit * error * xi2
            factors.append(prediction.heuristic_factor(settings, state, signals, dq))
    assert factors[1] == factors[3] == pytest.approx(1.0)  # the same only without an error
    assert abs(factors[2] - factors[0]) > 0.05


def test_erratum_7_only_filtered_rows_are_exact_with_an_error():
    """Lambda of (24) is a heuristic: its error is of first order in xi2 and xi2'."""
    largest = {
        kind: max(np.abs(residual).max() for residual, _, _ in rows_of_a_loop(kind))
        for kind in (FILTERED, LAMBDA)
    }
    assert recommended().prediction == FILTERED
    assert largest[FILTERED] < 1e-4  # N m, of second order in the sample time
    assert largest[LAMBDA] > 100.0 * largest[FILTERED]


def test_erratum_11_filter_gap_enters_the_error_rate_with_a_minus():
    """(12): xi1' = xi2 + beta2 - (beta2 - alpha2) - alpha1'; printed is a plus."""
    law = controller(recommended())
    largest, alpha2 = 0.0, None
    for sample in closed_loop(law, plant(), 0.05):
        signals = law.signals
        if alpha2 is not None:  # the filter's state before this sample
            gap, rate = signals.beta2 - alpha2, sample.measurement[2:4] - signals.dqr
            corrected = signals.xi2 + signals.beta2 - gap - signals.dqr
            np.testing.assert_allclose(corrected, rate, atol=1e-9)
            printed = signals.xi2 + signals.beta2 + gap - signals.dqr
            largest = max(largest, np.abs(printed - rate).max())
        alpha2 = law.state.alpha2.copy()
    assert largest > 1e-2  # rad/s


def test_erratum_24_varying_disturbance_can_increase_the_lyapunov_function():
    """(31) treats tau_dist as constant; its rate adds d3~ tau_dist' / gamma, and V can increase.

    With P^ = P and a constant disturbance V always decreases; with a sinusoid it does not.
    """
    frozen = {
        'learning.initial_estimate': list(P),
        'learning.adaptation_gain': [0.0, 0.0, 0.0],
        'disturbance.gain': [5.0, 5.0],
    }
    rises = []
    for amplitude in (0.0, 0.1):
        both = [amplitude, amplitude]
        law = EXACT | frozen | {'truth.amplitude': both}
        loop = run(configured('recommended', 8.0, law, {'disturbance.amplitude': both}))
        V = loop.lyapunov.sum(axis=1)[1000:]
        rises.append(np.diff(V).max() / V[0])
    assert rises[0] < 1e-6
    assert rises[1] > 1e-4


def test_erratum_24_term_completes_the_rate_of_the_disturbance_part_of_v():
    """From d3^' = -gamma xi2: (V_d)' = d3~ (xi2 + tau_dist' / gamma), exact for the means."""
    gain, T = 5.0, 1e-3
    config = configured('recommended', 4.0, EXACT | {'disturbance.gain': [gain, gain]})
    record = simulate(config.controller, config.plant)
    columns = sample_of(np.arange(record.samples.shape[1]), record.controller.settings)
    V = record.samples[:, columns.lyapunov[3]]
    xi2 = record.samples[:, columns.xi2]
    t = record.stamps[:, np.newaxis] * 1e-9
    tau_dist = 0.1 + 0.1 * np.sin(t)
    error = tau_dist - record.samples[:, columns.disturbance]
    mean = 0.5 * (error[1:] + error[:-1])
    printed = np.sum(mean * xi2[1:], axis=1) * T
    term = np.sum(mean * np.diff(tau_dist, axis=0), axis=1) / gain
    np.testing.assert_allclose(np.diff(V), printed + term, rtol=1e-6, atol=1e-12)
    assert np.abs(term).sum() > 0.1 * np.abs(np.diff(V)).sum()


def test_erratum_16_disturbance_reduces_the_effective_velocity_feedback():
    """(31): with tau_dist = -d1 xi2, as (5) allows, V' contains K_p - d1 I and not K_p.

    The arm starts on its reference with a velocity error xi2; the published energy
    xi2^T M xi2 / 2 is differenced over a hundredth of a millisecond.
    """
    T, d1, xi2 = 1e-5, 15.0, np.array([0.02, -0.05])
    settings = recommended(
        bias=False, initial_estimate=P, truth_known=1, true_parameters=P, gamma=np.zeros(2)
    )
    law = controller(settings)
    start = law.reference_at(0.0)[0]  # at rest there, so that alpha2 = 0 and xi2 = q'
    arm = plants.plant(period_ns=10_000, start=start, velocity=xi2)
    energy = []
    for k in range(2):
        law.update(k * T, T, arm.measure())
        energy.append(law.sample.lyapunov[1])
        arm.step(law.signals.torque + d1 * xi2)
    power = np.diff(energy)[0] / T
    assert power == pytest.approx(-xi2 @ ((settings.Kp - d1) * xi2), rel=0.01)
    assert power > -0.5 * xi2 @ (settings.Kp * xi2)  # the printed rate is twice as fast
