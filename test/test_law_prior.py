# SPDX-License-Identifier: Apache-2.0
"""Parameters of different units: the effect of the information R of their prior."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from arbitrary_case import arbitrary
from closed_loop_case import closed_loop, controller, plant, quick, recommended, record
from scipy.linalg import eigh

from blf_dsc_controller.law import adaptation, consistency, window
from blf_dsc_controller.law.settings import COMPENSATIONS

SCALE = np.array([1e-3, 5.0, 0.2, 30.0, 1.0, 1e-2, 4.0])  # of theta: p = 4 and 3 columns


def window_case(seed, **changes):
    """Case of a full random window, and its mean Phi (7, 7) and b (7,)."""
    random = np.random.default_rng(seed)
    A = random.normal(size=(7, 7))
    R = (A @ A.T + np.eye(7)) / np.outer(SCALE, SCALE)
    settings, state, signals = arbitrary(seed, information=R, rho=1e-5, **changes)
    rows = random.normal(size=(8, 3, 8)) / np.append(SCALE, 1.0)
    state.running[:] = np.einsum('kia,kib->ab', rows, rows)
    state.rows[0] = 8.0
    state.active[:] = 1.0
    return settings, state, signals, state.running[:7, :7] / 8.0, state.running[:7, 7] / 8.0


@pytest.mark.parametrize('seed', range(3))
def test_excitation_is_the_minimum_eigenvalue_relative_to_the_information(seed):
    settings, state, signals, Phi, _ = window_case(seed, prior_weight=0.0)
    found = window.excitation(settings, state, signals, 200)

    values, vectors = eigh(Phi, settings.information)
    assert found == pytest.approx(values[0], rel=1e-8)
    direction = state.min_eigenvector / state.min_eigenvector[0] * vectors[0, 0]
    np.testing.assert_allclose(direction, vectors[:, 0], rtol=1e-5)


def test_prior_pulls_the_solution_to_the_initial_estimate_in_its_own_metric():
    settings, state, signals, Phi, b = window_case(4, prior_weight=0.5, change_detection=0)
    window.excitation(settings, state, signals, 1)
    R = settings.information

    np.testing.assert_allclose(signals.Phi, Phi + 0.5 * R, rtol=1e-12)
    np.testing.assert_allclose(signals.b, b + 0.5 * R @ settings.initial_estimate, rtol=1e-12)


def test_tracking_error_adapts_each_parameter_in_its_scale():
    settings, state, signals = arbitrary(1, variance=SCALE**2, kappa=0.0)
    state.latched[0] = 0.0
    before = state.estimate.copy()
    adaptation.adapt(settings, state, signals, 1e-3, saturated=False)
    H, xi2 = signals.H[:, :4], signals.xi2
    expected = -1e-3 * settings.Gamma[:4] * SCALE[:4] ** 2 * (H.T @ xi2)
    np.testing.assert_allclose((state.estimate - before)[:4], expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize('compensation', range(len(COMPENSATIONS)))
def test_damping_by_the_initial_inertia_is_omega_v_M_xi2(compensation):
    plain, damped = (
        controller(recommended(Kp=np.zeros(2), damping_rate=rate, compensation=compensation))
        for rate in (0.0, 30.0)
    )
    measurement = np.array([2.2935, 1.6961, 0.3, -0.2, 0.0, 0.0])
    for law in (plain, damped):
        law.update(0.0, 1e-3, measurement)
    P1, P2, P3 = plain.settings.initial_estimate[:3]
    c = P3 * np.cos(measurement[1])
    M = np.array([[P1 + P2 + 2.0 * c, P2 + c], [P2 + c, P2]])

    np.testing.assert_allclose(
        damped.signals.demand - plain.signals.demand, -30.0 * M @ plain.signals.xi2, rtol=1e-9
    )


def test_window_of_every_fifth_row_gives_the_same_estimate():
    sparse = controller(quick(row_interval=5, window=200, sigma=1e-9))
    dense = controller(quick(sigma=1e-9))
    runs = [record(law, plant(constant=(0, 0), amplitude=(0, 0)), 4.0) for law in (sparse, dense)]

    assert sparse.state.ring.size * 5 == dense.state.ring.size
    assert sparse.state.rows[0] == 200.0
    np.testing.assert_allclose(runs[0].estimate[-1, :3], runs[1].estimate[-1, :3], rtol=0.02)


def test_rows_of_a_joint_at_rest_count_less():
    """Both sides of X theta = u are scaled by |dqr| / sqrt(dqr^2 + v^2)."""
    scaled, plain = (controller(quick(motion_scale=scale)) for scale in (0.05, 0.0))
    samples = zip(*(closed_loop(law, plant(), 0.5) for law in (scaled, plain)), strict=True)
    for _ in samples:
        dqr = abs(plain.signals.dqr[0])
        weight = dqr / sqrt(dqr**2 + 0.05**2)
        np.testing.assert_allclose(scaled.signals.row, weight * plain.signals.row, rtol=1e-9)


@pytest.mark.parametrize(('P2', 'physical'), [(0.32, True), (0.02, False), (-0.3, False)])
def test_only_estimates_with_a_positive_inertia_are_physical(P2, physical):
    law = controller(recommended())
    theta = np.array([1.0, P2, 0.0, 0.0, 0.0])
    q = np.array([2.0, 1.4])
    if P2 == 0.02:  # positive definite, but below a tenth of the initial estimate
        law.settings.initial_estimate[:3] = [1.0, 0.32, 0.0]
    assert consistency.is_physical(law.settings, law.signals, q, theta) == physical
