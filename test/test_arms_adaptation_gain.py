# SPDX-License-Identifier: Apache-2.0
"""Adaptation by the tracking error integrates no faster than the loop bears."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller import load_loop
from blf_dsc_controller.arms.base_parameters import prior_factor
from blf_dsc_controller.arms.joint_gains import linear, unknown_arm
from blf_dsc_controller.arms.linear_loop import Joints, Loop, Timing
from blf_dsc_controller.arms.model import inertia_matrices, regressors_at
from blf_dsc_controller.arms.tuning import gains_of
from blf_dsc_controller.configuration.controller import design_of

WINDOW = 5.0  # s, after which a window at rest is found unexcited, and adaptation ends
POSTURES = 20


class AtRest:
    """An arm at rest in random postures, and how it integrates the tracking error."""

    def __init__(self, preset, period):
        arm, _ = design_of(load_loop(preset).controller)
        joints = unknown_arm(arm.rotors)
        self.arm = arm._replace(sample_time=period, stiffness=1.0, joints=joints)
        n = len(arm.rotors)
        self.q = np.random.default_rng(3).uniform(*arm.limits, (POSTURES, n))
        self.viscous = np.full(n, 0.1)  # N m s/rad

    def growth(self, Gamma, payload):
        """Return the largest factor of an error within a window, with a payload [kg]."""
        arm, q = self.arm, self.q
        model, n = arm.parameters.model, len(arm.rotors)
        L = prior_factor(arm.chain, arm.parameters, arm.payload, np.zeros(n))
        Y = regressors_at(model, q, 0.0 * q, 0.0 * q, 0.0 * q) @ L
        P = arm.parameters.of(arm.chain.inertias, arm.rotors)
        law = linear(arm.joints, arm.over_postures().inertia, POSTURES)
        law = law._replace(integral=law.integral + Gamma * Y @ Y.swapaxes(1, 2))
        M = inertia_matrices(model, P + payload * arm.parameters.load, q)
        timing = Timing(arm.sample_time, 1, 0.5 * arm.lag, 0.5 * arm.lag)
        joints = Joints(0.0 * self.viscous, self.viscous)
        A, _ = Loop(M, joints, timing, law).transition()
        radius = np.abs(np.linalg.eigvals(A)).max()
        return float(radius ** (WINDOW / arm.sample_time))


@pytest.mark.parametrize('period', [0.001, 0.01])
@pytest.mark.parametrize('preset', ['panda', 'ur5e', 'fr3', 'openarm', 'widowx', 'yam'])
def test_soft_joints_hardly_drift_within_a_window(preset, period):
    """Their loops are near the least damped that adaptation allows: 1.35 times at most."""
    at_rest = AtRest(preset, period)
    Gamma = gains_of(at_rest.arm).adaptation
    for payload in (0.0, at_rest.arm.payload):
        assert at_rest.growth(Gamma, payload) < 1.5
