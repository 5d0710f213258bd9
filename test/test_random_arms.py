# SPDX-License-Identifier: Apache-2.0
"""The study of random arms: drawn independently, the same for all laws, rivals at equal margin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmark import (
    joint_pd,
    random_arms,
)
from blf_dsc_controller import change, controller_of
from blf_dsc_controller.supervision.model_torque import gravity_torque

ARMS = 300


@pytest.mark.parametrize('drawn', ['study', 'wide'])
def test_arms_do_not_depend_on_what_the_controller_has(drawn):
    for name in random_arms.ROBOTS:
        own = random_arms.study_of(name, drawn)
        others = {'feedback.stiffness': 0.1, 'disturbance.observer_bandwidth': 0.0}
        other = replace(own, controller=change(own.controller, others))
        assert all(
            random_arms.arm_of(own, k) == random_arms.arm_of(other, k)
            for k in (0, 1, ARMS)
        )


def test_laws_have_the_same_arm_limits_and_sampling_and_are_run_once(
    monkeypatch, tmp_path
):
    handed = []

    def run(config, plant, bound):
        handed.append((config, plant, bound))
        return random_arms.Result(np.nan, 'text', 0, *[0.25] * 8)

    def rows():
        kept = random_arms.Kept(tmp_path / 'runs.jsonl')
        return list(random_arms.arms(1, ['panda'], ['study'], kept))

    monkeypatch.setattr(random_arms, 'run', run)
    monkeypatch.setattr(random_arms, 'factor_of', lambda *_: 1.0)
    table = rows()
    assert len(handed) == len(random_arms.LAWS)
    first, arm, bound = handed[0]
    for config, plant, same in handed[1:]:
        assert plant == arm
        assert config.torque == first.torque
        assert config.sample_time == first.sample_time
        assert config.reference == first.reference
        assert not config.learning.enabled
        np.testing.assert_array_equal(same, bound)
    assert rows() == table
    assert len(handed) == len(random_arms.LAWS)


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
