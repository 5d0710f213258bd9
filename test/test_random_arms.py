# SPDX-License-Identifier: Apache-2.0
"""The study of random arms: drawn independently, the same for all laws, rivals at equal margin."""

from __future__ import annotations

import numpy as np
import pytest

from benchmark import (
    joint_pd,
    random_arms,
)
from blf_dsc_controller import controller_of
from blf_dsc_controller.supervision.model_torque import gravity_torque


def test_rivals_have_the_margin_of_this_law(monkeypatch):
    """Nine bisections of two decades leave 1 % of a factor, and less than 0.02 of a margin."""
    monkeypatch.setattr(random_arms, 'POSTURES', 2)
    random_arms.described.cache_clear()
    random_arms.factor_of.cache_clear()
    arm = random_arms.described('ur5e')
    aim = arm.margin(random_arms.feedback_of('ur5e', random_arms.THIS))
    assert aim > random_arms.LEAST
    for law in (random_arms.PD, random_arms.CT):
        factor = random_arms.factor_of('ur5e', law)
        found = arm.margin(random_arms.feedback_of('ur5e', law, factor))
        assert found == pytest.approx(aim, abs=0.02)
    random_arms.described.cache_clear()
    random_arms.factor_of.cache_clear()


def test_joint_pd_is_a_pd_over_gravity_with_the_published_gains():
    robot = random_arms.ROBOTS['panda']
    own = random_arms.study_of('panda').controller
    config = random_arms.law_of(own, 'panda', random_arms.STOCK)
    assert config.feedback.joint_stiffness == robot.stiffness
    assert config.feedback.joint_damping == robot.damping
    controller = controller_of(config)
    settings, signals = controller.settings, controller.signals
    rng = np.random.default_rng(1)
    for each in (signals.q, signals.dq, signals.qr, signals.dqr, signals.xi1):
        each[:] = rng.uniform(-0.5, 0.5, settings.n)
    law = joint_pd.LAW(scale=2.0)
    law.compute_demand(settings, controller.state, signals, 0.0, 1e-3)
    expected = gravity_torque(settings, settings.initial_estimate, signals.q)
    expected -= 2.0 * np.array(robot.stiffness) * signals.xi1
    expected -= 2.0 * np.array(robot.damping) * (signals.dq - signals.dqr)
    np.testing.assert_allclose(signals.demand, expected, rtol=1e-3)
