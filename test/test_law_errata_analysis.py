# SPDX-License-Identifier: Apache-2.0
"""The paper's printed analysis against the corrected one: each erratum by its number."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import closed_loop, controller, plant, recommended
from paper_case import EXACT, configured, run
from plain_law import dynamics

P = np.array([1.0, 0.32, 0.4])
R = 9.8  # 1/s^2


def test_erratum_6_the_known_part_of_the_dynamics_is_subtracted():
    """(23): M xi2' + C xi2 is the torque LESS M alpha2' + C alpha2 + G; printed is a plus."""
    random = np.random.default_rng(3)
    q, alpha2, xi2, dalpha2, dxi2, tau_dist = random.normal(size=(6, 2))
    M, C, G = dynamics(P, R, q, alpha2 + xi2)
    tau = M @ (dalpha2 + dxi2) + C @ (alpha2 + xi2) + G + tau_dist
    known = M @ dalpha2 + C @ alpha2 + G
    np.testing.assert_allclose(M @ dxi2 + C @ xi2, tau - tau_dist - known, atol=1e-12)
    assert np.linalg.norm(M @ dxi2 + C @ xi2 - (tau - tau_dist + known)) > 1.0


def test_erratum_7_lambda_changes_with_the_unit_of_the_angles():
    """(24): x holds rad/s^2, rad/s and a plain 1, and Lambda adds their squares."""
    x, y = np.array([0.4, -0.3, 0.2, 0.1, 1.0]), np.array([0.3, -0.3, 0.2, 0.0, 1.0])
    degrees = np.array([180.0 / np.pi] * 4 + [1.0])

    def factor(unit):
        return (x * unit) @ (y * unit) / ((x * unit) @ (x * unit))

    assert abs(factor(degrees) - factor(1.0)) > 0.05
    parallel = y * degrees @ (y * degrees) / ((y * degrees) @ (y * degrees))
    assert parallel == pytest.approx(1.0)  # only without an error is it the same in all units


def test_erratum_11_the_filter_s_gap_enters_the_error_s_rate_with_a_minus():
    """(12): xi1' = xi2 + beta2 - (beta2 - alpha2) - alpha1'; printed is a plus."""
    law = controller(recommended())
    largest = 0.0
    for sample in closed_loop(law, plant(), 0.05):
        signals, dq = law.signals, sample.measurement[2:4]
        gap = signals.beta2 - (dq - signals.xi2)
        rate = dq - signals.dqr
        np.testing.assert_allclose(signals.xi2 + signals.beta2 - gap - signals.dqr, rate, atol=1e-9)
        printed = signals.xi2 + signals.beta2 + gap - signals.dqr
        largest = max(largest, np.abs(printed - rate).max())
    assert largest > 1e-2  # rad/s


def test_erratum_24_a_disturbance_that_moves_feeds_the_lyapunov_function():
    """(31) counts tau_dist as constant; its rate adds d3~ tau_dist' / gamma, and V then rises.

    With P^ = P and a constant disturbance V falls all the way; with a sinusoid it does not.
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


def test_erratum_16_the_disturbance_s_share_is_paid_from_the_velocity_feedback():
    """(31): with tau_dist = -d1 xi2, as (5) allows, V' holds K_p - d1 I and not K_p."""
    Kp, d1, xi2 = np.array([60.0, 20.0]), 15.0, np.array([0.02, -0.05])
    tau_dist = -d1 * xi2
    power = xi2 @ (-Kp * xi2 - tau_dist)
    assert power == pytest.approx(-xi2 @ ((Kp - d1) * xi2))
    assert power > -xi2 @ (Kp * xi2)
