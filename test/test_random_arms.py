# SPDX-License-Identifier: Apache-2.0
"""The study of random arms: drawn independently, the same for all laws, rivals at equal margin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmark import (
    joint_pd,
    many_arms,
    momentum_observer,
    random_arms,
    soft_arms,
)
from blf_dsc_controller.arms.linear_loop import Timing, law_response
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.supervision.model_torque import model_torque

ARMS = 300


@pytest.fixture
def study():
    return random_arms


@pytest.mark.parametrize('drawn', ['study', 'wide'])
def test_arms_do_not_depend_on_what_the_controller_has(study, drawn):
    for name in study.ROBOTS:
        own = study.study_of(name, drawn)
        others = {'feedback.stiffness': 0.1, 'disturbance.observer_bandwidth': 0.0}
        other = replace(own, controller=change(own.controller, others))
        assert all(study.arm_of(own, k) == study.arm_of(other, k) for k in (0, 1, ARMS))


def test_wide_arms_are_of_every_kind_independently(study):
    """With 300 arms two independent values correlate by 0.06; 0.2 is three times that."""
    own = study.study_of('panda', 'wide')
    guess = study.guessed_rotors(own.controller)
    arms = [study.arm_of(own, k) for k in range(ARMS)]
    values = np.array(
        [
            (
                *np.log(np.array(arm.truth.rotor_inertia) / guess)[:2],
                *np.log(arm.joint.stiffness)[:2],
                arm.sensor.side == 'motor',
                arm.actuator.loop_gain > 0.0,
                arm.base.mass,
                arm.actuator.delay,
            )
            for arm in arms
        ]
    )
    apart = np.corrcoef(values.T) - np.eye(values.shape[1])
    assert np.abs(apart).max() < 0.2
    rotors = np.exp(values[:, :2])
    assert 0.2 <= rotors.min() < 0.25  # uniform in the logarithm, 600 of them
    assert 6.0 < rotors.max() <= 7.0
    assert all(
        bool(arm.actuator.loop_gain) == bool(arm.actuator.loop_damping) for arm in arms
    )


def test_laws_have_the_same_arm_limits_and_sampling(study, monkeypatch):
    handed = []

    def run(config, plant, bound):
        handed.append((config, plant, bound))
        return study.Result(*[0.0] * len(study.Result._fields))

    monkeypatch.setattr(study, 'run', run)
    monkeypatch.setattr(study, 'factor_of', lambda *_: 1.0)
    list(study.arms(1, ['panda'], ['study'], study.Kept(None)))
    assert len(handed) == len(study.LAWS)
    first, arm, bound = handed[0]
    for config, plant, same in handed[1:]:
        assert plant == arm
        assert config.torque == first.torque
        assert config.sample_time == first.sample_time
        assert config.reference == first.reference
        assert config.learning.weight == 0.0
        np.testing.assert_array_equal(same, bound)


def test_rivals_have_the_margin_of_this_law(study, monkeypatch):
    """Nine bisections of two decades leave 1 % of a factor, and less than 0.02 of a margin."""
    monkeypatch.setattr(study, 'POSTURES', 2)
    study.described.cache_clear()
    study.factor_of.cache_clear()
    arm = study.described('ur5e')
    aim = arm.margin(study.feedback_of('ur5e', study.THIS))
    assert aim > study.LEAST
    for law in (study.PD, study.CT):
        factor = study.factor_of('ur5e', law)
        found = arm.margin(study.feedback_of('ur5e', law, factor))
        assert found == pytest.approx(aim, abs=0.02)
    study.described.cache_clear()
    study.factor_of.cache_clear()


def test_linear_pid_is_one(study):
    """tau = -(P + D v + I / s) y, up to the half sample of sums and differences."""
    rng = np.random.default_rng(1)
    P, D, I = (scale * rng.uniform(0.5, 1.0, (1, 2, 2)) for scale in (90.0, 6.0, 40.0))
    T = 1e-4
    s = 2j * np.pi * np.geomspace(1.0, 50.0, 7)
    found = law_response(study.pid(P, D, I, 3.0), Timing(T, velocity_lag=1e-9), s)
    expected = (
        P[:, None] + (D[:, None] * s[:, None, None]) + I[:, None] / s[:, None, None]
    )
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_joint_pd_is_a_pd_over_gravity_with_the_published_gains(study):
    robot = study.ROBOTS['panda']
    own = study.study_of('panda').controller
    config = study.law_of(own, 'panda', study.STOCK)
    assert config.barrier.weight == robot.stiffness
    assert config.feedback.gain == robot.damping
    controller = controller_of(own)
    settings, signals = controller.settings, controller.signals
    rng = np.random.default_rng(1)
    for each in (signals.q, signals.dq, signals.qr, signals.dqr, signals.xi1):
        each[:] = rng.uniform(-0.5, 0.5, settings.n)
    law = joint_pd.LAW(scale=2.0)
    law.compute_demand(settings, controller.state, signals, 0.0, 1e-3)
    expected = model_torque(settings, settings.initial_estimate, signals.q)
    expected -= 2.0 * settings.barrier.weight * signals.xi1
    expected -= 2.0 * settings.feedback.gain * (signals.dq - signals.dqr)
    np.testing.assert_allclose(signals.demand, expected, atol=1e-9)


def test_momentum_observer_feeds_forward_what_holds_a_load(study):
    """At rest, what is sent beyond gravity holds a load; a pole of 10 rad/s shows it in 1 s."""
    controller = controller_of(study.study_of('panda').controller)
    settings, signals = controller.settings, controller.signals
    n, dt = settings.n, 0.01
    state = controller.state._replace(memory=np.zeros(3 * n))
    rng = np.random.default_rng(1)
    signals.q[:] = rng.uniform(-0.5, 0.5, n)
    for each in (signals.dq, signals.dqr, signals.ddqr, signals.xi1):
        each[:] = 0.0
    gravity = model_torque(settings, settings.initial_estimate, signals.q)
    held = rng.uniform(-9.0, 9.0, n)
    signals.applied[:] = gravity + held
    law = momentum_observer.LAW(scale=1.0, bandwidth=10.0)
    for k in range(round(1.0 / dt) + 1):
        state.samples[0] = k
        law.compute_demand(settings, state, signals, k * dt, dt)
    np.testing.assert_allclose(signals.demand, gravity + held, atol=1e-3)


def test_what_shakes_is_told_from_motion(study):
    """A first-order high-pass at 8 Hz passes 0.97 of 30 Hz, and 0.06 of 0.5 Hz."""
    t = 1e-3 * np.arange(3000)[:, None]
    assert study.shaken(np.sin(60.0 * np.pi * t), 1e-3) == pytest.approx(
        0.686, abs=0.03
    )
    assert study.shaken(np.sin(np.pi * t), 1e-3) < 0.06


def test_runs_that_are_kept_are_not_made_again(study, monkeypatch, tmp_path):
    made = []

    def run(*_):
        made.append(1)
        return study.Result(np.nan, 'text', 0, *[0.25] * 8)

    monkeypatch.setattr(study, 'run', run)
    monkeypatch.setattr(study, 'factor_of', lambda *_: 1.0)
    path = tmp_path / 'runs.jsonl'
    rows = list(study.arms(2, ['openarm'], ['study'], study.Kept(path)))
    assert len(made) == 2 * len(study.LAWS)
    assert list(study.arms(2, ['openarm'], ['study'], study.Kept(path))) == rows
    assert len(made) == 2 * len(study.LAWS)


def test_published_gains_are_tried_where_this_law_does_not_hold(study, monkeypatch):
    """An arm on which those hold counts as a failure, any other does not."""
    kept = study.Kept(None)
    made = []

    def of(key, _):
        made.append(key)
        holds = key.number == 0 or (key.number == 1 and key.law == study.STOCK)
        stopped = np.nan if holds else 2.0
        errors = 0.001, 0.002, 0.003, 0.5 + key.number
        kept.results[key] = study.Result(stopped, 'text', 0, 0.01, *errors, 1, 1, 1)
        return kept.results[key]

    monkeypatch.setattr(kept, 'of', of)
    many_arms.make(3, ['panda'], ['study'], kept)
    assert [(key.number, key.law) for key in made] == [
        (0, study.THIS),
        (1, study.THIS),
        (1, study.STOCK),
        (2, study.THIS),
        (2, study.STOCK),
    ]
    (row,) = many_arms.rows(kept)
    found = dict(zip(many_arms.HEAD, row, strict=True))
    names = 'arms', 'hold', 'shake', 'stop', 'hold, beyond the bound'
    assert [found[name] for name in names] == ['3', '1', '0', '2', '0']
    assert found['not held, plausible'] == '1'
    assert found['settled [mrad]'] == '3 / 3 / 3'


def test_rivals_at_rest_have_the_gains_that_they_have_in_motion(monkeypatch):
    asked = []
    gains = soft_arms.Equal(0.2, 0.9, 10.0, ((0.9, 4.0), (0.7, 8.0), (0.5, 9.0)))

    def equal(name):
        asked.append(name)
        return gains

    monkeypatch.setattr(soft_arms, 'equal', equal)
    at_rest = soft_arms.ALL['ur5e_rest']
    assert set(at_rest.gains['reference.amplitude']) == {0.0}
    assert set(at_rest.plant['joint.backlash']) == {soft_arms.PLAY}
    config = soft_arms.loop_with(at_rest, at_rest.gains).controller
    found = soft_arms.law_of(config, 'ur5e_rest', soft_arms.DOB)
    assert asked == ['ur5e']
    assert (found.gains.scale, found.gains.bandwidth) == (
        0.7,
        8.0,
    )  # 5.6 is the most of 3.6, 4.5
    other = soft_arms.law_of(config, 'ur5e_rest', soft_arms.DOB, (0.5, 9.0))
    assert (other.gains.scale, other.gains.bandwidth) == (0.5, 9.0)


def test_table_of_soft_arms_has_the_laws_that_are_asked_for(monkeypatch):
    none = [0.0] * 3

    def figures(*run):
        rms = 2.0 if run[1] == soft_arms.NO_LEARNING else 1.0
        return soft_arms.Figures('', none, none, rms, np.nan, 0.0, is_softened=False)

    monkeypatch.setattr(soft_arms, 'figures', figures)
    asked = soft_arms.DOB, soft_arms.THIS
    rows = list(soft_arms.rows('ur5e', 1, asked))
    assert [row[1] for row in rows] == ['goal', soft_arms.THIS, soft_arms.DOB]
    assert {row[7] for row in rows[1:]} == {'-'}  # nothing to compare with
    rows = list(soft_arms.rows('ur5e', 1, (soft_arms.NO_LEARNING, *asked)))
    assert [row[7] for row in rows[1:]] == ['2', '1', '2']
