# SPDX-License-Identifier: Apache-2.0
"""Adaptation by the tracking error integrates no faster than the loop bears."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.arms.base_parameters import prior_factor
from blf_dsc_controller.arms.joint_gains import linear, unknown_arm
from blf_dsc_controller.arms.linear_loop import Joints, Loop, Timing
from blf_dsc_controller.arms.model import inertia_matrices, regressors_at
from blf_dsc_controller.arms.tuning import (
    gains_of,
    loop_delay,
    through_inertia,
)
from blf_dsc_controller.configuration.controller import design_of
from blf_dsc_controller.configuration.nodes import load_loop

FASTEST = 0.625  # rad, phase that the delay may cost
WINDOW = 5.0  # s, after which a window at rest is found unexcited, and adaptation ends
POSTURES = 20


class AtRest:
    """An arm at rest in random postures, and how it integrates the tracking error."""

    def __init__(self, preset, inertia, period, stiffness):
        arm, _ = design_of(load_loop(preset).controller)
        n = len(arm.rotors)
        joints = unknown_arm(arm.rotors) if inertia == 'none' else None
        self.arm = arm._replace(sample_time=period, stiffness=stiffness, joints=joints)
        self.q = np.random.default_rng(3).uniform(*arm.limits, (POSTURES, n))
        self.viscous = np.full(n, 0.1)  # N m s/rad
        self.Gamma = gains_of(self.arm).adaptation

    def growth(self, Gamma, payload):
        """Return the largest factor of an error within a window, with a payload [kg]."""
        arm, q = self.arm, self.q
        model, n = arm.parameters.model, len(arm.rotors)
        L = prior_factor(arm.chain, arm.parameters, arm.payload, np.zeros(n))
        Y = regressors_at(model, q, 0.0 * q, 0.0 * q, 0.0 * q) @ L
        P = arm.parameters.of(arm.chain.inertias, arm.rotors)
        if arm.joints is None:
            rate = arm.stiffness * FASTEST / loop_delay(arm.sample_time, arm.lag)
            law = through_inertia(inertia_matrices(model, P, q), rate)
        else:
            inertia = arm.over_postures().inertia
            law = linear(arm.joints.scaled(arm.stiffness), inertia, POSTURES)
        law = law._replace(integral=law.integral + Gamma * Y @ Y.swapaxes(1, 2))
        M = inertia_matrices(model, P + payload * arm.parameters.load, q)
        timing = Timing(arm.sample_time, 1, 0.5 * arm.lag, 0.5 * arm.lag)
        A, _ = Loop(
            M, Joints(0.0 * self.viscous, self.viscous), timing, law
        ).transition()
        radius = np.abs(np.linalg.eigvals(A)).max()
        return float(radius ** (WINDOW / arm.sample_time))


@pytest.mark.parametrize('stiffness', [1.0, 0.25, 0.0625])
@pytest.mark.parametrize('period', [0.001, 0.004, 0.01])
@pytest.mark.parametrize('preset', ['panda', 'ur5e', 'fr3', 'openarm'])
def test_stiff_loops_stay_stable_with_and_without_the_rated_payload(
    preset, period, stiffness
):
    at_rest = AtRest(preset, 'whole', period, stiffness)
    for payload in (0.0, at_rest.arm.payload):
        assert at_rest.growth(at_rest.Gamma, payload) < 1.0


@pytest.mark.parametrize('period', [0.001, 0.004, 0.01])
@pytest.mark.parametrize('preset', ['panda', 'ur5e', 'fr3', 'openarm', 'widowx', 'yam'])
def test_soft_joints_hardly_drift_within_a_window(preset, period):
    """Their loops are near the least damped that adaptation allows: 1.35 times at most."""
    at_rest = AtRest(preset, 'none', period, 1.0)
    for payload in (0.0, at_rest.arm.payload):
        assert at_rest.growth(at_rest.Gamma, payload) < 1.5


def test_half_of_the_prior_would_diverge_on_slow_loops():
    """What was the gain of every stiff loop."""
    at_rest = AtRest('ur5e', 'whole', 0.01, 0.25)
    assert at_rest.growth(0.5, 0.0) > 10.0
