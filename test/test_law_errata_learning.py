# SPDX-License-Identifier: Apache-2.0
"""The paper's printed learning against the corrected one: each erratum by its number.

Each test shows the printed form failing and the corrected form, as the package has it, holding.
"""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import (
    MODEL,
    P,
    closed_loop,
    controller,
    plant,
    recommended,
    record,
)

from blf_dsc_controller.law import adaptation, cholesky, projection
from blf_dsc_controller.law.settings import EFFORT

NO_SINE = (0.0, 0.0)


def test_erratum_1_prediction_error_enters_with_a_minus():
    """(20) prints -Gamma (H^T xi2 + kappa eps): learning then drives P^ to the projection ball."""
    settings = recommended()
    corrected = record(controller(settings), plant(), 8.0)
    printed = record(controller(settings._replace(kappa=-settings.kappa)), plant(), 8.0)

    before = corrected.t < settings.learning_start
    np.testing.assert_array_equal(printed.torque[before], corrected.torque[before])
    assert np.linalg.norm(printed.estimate[-1, :3]) == pytest.approx(settings.radius)
    assert printed.parameter_error[-1] > 1.0
    assert corrected.parameter_error[-1] < 0.01


def test_erratum_2_both_integrals_carry_the_same_factor():
    """(21) lacks the 1/tau_d of (22) and (24): the update then settles at P / tau_d."""
    settings = recommended()
    law = controller(settings)
    record(law, plant(constant=(0.3, -0.2), amplitude=NO_SINE), 8.0)
    theta = np.array([*P, 0.3, -0.2])
    tau_d = settings.window * 1e-3

    def rest_point(Phi):
        law.state.Phi[:] = Phi
        law.state.factor[:] = law.state.Phi + settings.rho * np.eye(settings.m)
        cholesky.factor(law.state.factor)
        law.signals.xi2[:] = 0.0
        for _ in range(2000):
            adaptation.adapt(settings, law.state, law.signals, 1e-3, False)  # noqa: FBT003
        return law.state.estimate.copy()

    np.testing.assert_allclose(rest_point(law.state.Phi.copy()), theta, atol=1e-4)
    np.testing.assert_allclose(rest_point(law.state.Phi * tau_d), theta / tau_d, atol=1e-4)


def test_erratum_3_integrand_belongs_to_the_integration_variable():
    """(21) prints H_a(t)^T H_a(t), a window of one sample: it has rank n and is never excited."""
    gains = {'bias': False, 'sigma': 1e-6}
    printed, corrected = (
        controller(recommended(**gains | changes)) for changes in ({'window': 1}, {})
    )
    ranks = set()
    for sample in closed_loop(printed, plant(), 8.0):
        if sample.k > 0 and sample.k % 10 == 0:
            ranks.add(np.linalg.matrix_rank(printed.signals.Phi))
            assert abs(printed.state.lambda_min[0]) < 1e-9
    record(corrected, plant(), 8.0)

    assert max(ranks) == 2
    assert printed.state.latched[0] == 0.0
    assert corrected.state.latched[0] == 1.0
    assert corrected.state.lambda_min[0] > 0.1  # over a period of the reference


def run_loop(law, arm, duration, *, subtract):
    """Run a loop that learns from the applied torque, less d^3 if `subtract` (the paper's (24))."""
    d3 = np.zeros(2)
    for k in range(round(duration / 1e-3)):
        measurement = arm.measure().copy()
        measurement[4:] -= d3 * subtract
        d3 = law.state.disturbance.copy()  # contained in the next torque
        law.update(k * 1e-3, 1e-3, measurement)
        arm.step(law.signals.torque)


@pytest.mark.parametrize('guess', [P / 2.0, 1.5 * P, np.array([0.5, 0.6, 0.1])])
def test_erratum_8_subtracting_the_disturbance_estimate_hides_any_parameter_error(guess):
    """By (28) tau - d^3 = H P^ up to the errors of tracking, so eps of (24) vanishes for every P^.

    What remains is K_p xi2 and the barrier's torque, which a fast d^3 keeps near a hundredth once
    the first two seconds, in which it takes up the error, have left the window.
    """
    settings = recommended(
        bias=False, torque_source=EFFORT, kappa=0.0, Gamma=np.zeros(3), initial_estimate=guess
    )
    visible = {}
    for subtract in (True, False):
        law = controller(settings)
        run_loop(law, plant(), 9.0, subtract=subtract)
        eps = law.state.b - law.state.Phi @ guess
        visible[subtract] = np.linalg.norm(eps) / np.linalg.norm(law.state.Phi @ (P - guess))

    assert visible[True] < 0.03
    assert visible[False] == pytest.approx(1.0, abs=0.05)  # tau_dist of 0.2 N m remains in it


def test_erratum_8_estimates_drift_if_the_disturbance_estimate_is_subtracted():
    """The disturbance is estimated as columns instead."""
    printed = controller(recommended(bias=False, torque_source=EFFORT))
    corrected = controller(recommended(torque_source=EFFORT))
    run_loop(printed, plant(), 20.0, subtract=True)
    run_loop(corrected, plant(), 20.0, subtract=False)

    errors = [
        np.linalg.norm(law.state.estimate[:3] - P) / np.linalg.norm(P)
        for law in (printed, corrected)
    ]
    assert errors[0] > 0.3
    assert errors[1] < 0.01


def printed_projection(estimate, rate, radius):
    """(4) as printed, with its condition for an unchanged `rate`."""
    norm = np.linalg.norm(estimate)
    if norm < radius or (norm == radius and estimate @ rate <= 0.0):
        return rate
    return rate - estimate * (estimate @ rate) / norm**2


def test_erratum_19_printed_projection_lets_the_estimate_leave_for_good():
    """Ten outward steps cross the sphere; the printed form then blocks ten thousand inward ones.

    Outside, 'otherwise' removes the radial part of any direction, inward ones included.
    """
    radius, dt = 1.0, 0.1
    printed, corrected = np.array([[0.85, 0.1], [0.85, 0.1]])
    outward = np.array([1.0, 0.3])
    gain = np.ones(2)
    for k in range(10_010):
        rate = outward if k < 10 else -printed
        printed = printed + dt * printed_projection(printed, rate, radius)
        rate = outward.copy() if k < 10 else -corrected
        projection.project(corrected, rate, gain, radius)
        corrected += dt * rate
        projection.retract(corrected, gain, radius)
        assert np.linalg.norm(corrected) <= radius * (1.0 + 1e-15)
    assert np.linalg.norm(printed) > 1.01 * radius
    assert np.linalg.norm(corrected) < 1e-6


def test_erratum_19_projection_is_taken_in_the_metric_of_gamma():
    """With an uneven Gamma the printed direction makes (29) grow, for a true P inside the ball."""
    gain, radius = np.array([0.01, 1.0]), 1.0
    w = np.array([0.8, 0.6])
    w /= np.linalg.norm(w)
    v, true = np.array([1.0, 0.0]), np.array([0.9, -0.4])
    corrected = v.copy()
    projection.project(w, corrected, gain, radius)

    unprojected, printed, taken = (
        -(true - w) @ (rate / gain) for rate in (v, printed_projection(w, v, radius), corrected)
    )

    assert np.linalg.norm(true) < radius
    assert printed > unprojected
    assert taken <= unprojected


def test_erratum_23_reference_excites_every_parameter_but_the_second_weakly():
    """Over a period of exact tracking, lambda_min of the mean of H^T H is 0.269."""
    H = np.zeros((2, 3))
    Phi = np.zeros((3, 3))
    t = np.arange(1000) * 2.0 * np.pi / 1000
    for time in t:
        q = np.array([1.9935, 1.3961]) + 0.3 * np.cos(time)
        dq, ddq = np.full(2, -0.3 * np.sin(time)), np.full(2, -0.3 * np.cos(time))
        MODEL.regressor(q, dq, dq, ddq, H)
        Phi += H.T @ H / t.size
    values, vectors = np.linalg.eigh(Phi)

    assert values[0] == pytest.approx(0.269, abs=5e-4)
    assert abs(vectors[1, 0]) > 0.9
