# SPDX-License-Identifier: Apache-2.0
"""The terms of (29) in a telemetry sample, against the formulas written out."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import plant
from paper_case import EXACT, P, configured
from plain_law import dynamics

from blf_dsc_controller.law.factory import controller_of

GAINS = {
    'learning.adaptation_gain': [0.5, 2.0, 1.5],
    'disturbance.gain': [40.0, 10.0],
    'barrier.weight': [800.0, 300.0],
    'comparison.position_gain': [25.0, 9.0],
    'truth.phase': [0.0, 0.4],
}


def samples(law, **changes):
    """Yield time, controller and measurement of 300 samples."""
    controller = controller_of(configured('recommended', 1.0, EXACT | {'law': law} | changes)[1])
    arm = plant()
    for k in range(300):
        measurement = arm.measure().copy()
        controller.update(k * 1e-3, 1e-3, measurement)
        yield k * 1e-3, controller, measurement
        arm.step(controller.signals.torque)


@pytest.mark.parametrize('law', ['blf_dsc', 'backstepping'])
def test_terms_are_those_of_equation_29(law):
    Gamma, gamma = np.array([0.5, 2.0, 1.5]), np.array([40.0, 10.0])
    w = np.array([800.0, 300.0] if law == 'blf_dsc' else [25.0, 9.0])
    for t, controller, measurement in samples(law, **GAINS):
        sample = controller.sample
        xi1, xi2 = sample.xi1, sample.xi2
        M, _, _ = dynamics(P, 9.8, measurement[:2], measurement[2:4])
        tau_dist = 0.1 + 0.1 * np.sin(t + np.array([0.0, 0.4]))
        if law == 'blf_dsc':
            error = np.sum(w * 0.002**2 / np.pi * np.tan(np.pi * xi1**2 / (2.0 * 0.002**2)))
            disturbance = 0.5 * np.sum((tau_dist - sample.disturbance) ** 2 / gamma)
        else:
            error, disturbance = 0.5 * np.sum(w * xi1**2), 0.0  # (35) has no d^3
        expected = (
            error,
            0.5 * xi2 @ M @ xi2,
            0.5 * np.sum((P - sample.estimate[:3]) ** 2 / Gamma),
            disturbance,
        )
        np.testing.assert_allclose(sample.lyapunov, expected, rtol=1e-11, atol=1e-18)


def test_estimates_that_are_not_adapted_do_not_count():
    frozen = {'learning.adaptation_gain': [0.0, 1.0, 0.0], 'disturbance.gain': [0.0, 50.0]}
    for t, controller, _ in samples('blf_dsc', **frozen):
        sample = controller.sample
        tau_dist = 0.1 + 0.1 * np.sin(t)
        np.testing.assert_allclose(sample.lyapunov[2], 0.5 * (P[1] - sample.estimate[1]) ** 2)
        np.testing.assert_allclose(
            sample.lyapunov[3], 0.5 * (tau_dist - sample.disturbance[1]) ** 2 / 50.0, rtol=1e-11
        )


def test_without_the_truth_only_the_term_of_the_error_is_published():
    for _, controller, _ in samples('blf_dsc', **{'truth.parameters': []}):
        assert controller.sample.lyapunov[0] >= 0.0
        assert np.all(np.isnan(controller.sample.lyapunov[1:]))
