# SPDX-License-Identifier: Apache-2.0
"""The study of random arms: drawn independently, the same for all laws, rivals at equal margin."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from types import SimpleNamespace

import numpy as np
import pytest

from benchmark import (
    chosen_poles,
    joint_pd,
    many_arms,
    momentum_observer,
    observer_poles,
    random_arms,
    rise,
    soft_arms,
    soft_pairs,
    two_encoders,
)
from blf_dsc_controller.arms.linear_loop import (
    Loop,
    Timing,
    arm_response,
    law_response,
)
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.supervision.model_torque import gravity_torque

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
    expected = gravity_torque(settings, settings.initial_estimate, signals.q)
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
    gravity = gravity_torque(settings, settings.initial_estimate, signals.q)
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


def test_what_does_not_hold_is_counted_by_the_joint_named_and_by_what_was_drawn(study):
    """Of eight UR5es the three whose springs are damped least fail."""
    kept, own = study.Kept(None), study.study_of('ur5e')
    damping = [study.arm_of(own, k).joint.damping_ratio for k in range(8)]
    fail = set(np.argsort(damping)[:3].tolist())
    texts = iter(
        ["joint 'pan' oscillates at 31 Hz with", "joint 'pan' at 1.9e+02 Hz,", '']
    )
    for k in range(8):
        stopped = 2.0 if k in fail else np.nan
        text = next(texts) if k in fail else ''
        result = study.Result(stopped, text, 0, *[0.01] * 8)
        kept.results[study.Key('ur5e', 'study', k, study.THIS)] = result
        kept.results[study.Key('ur5e', 'study', k, study.STOCK)] = result
    assert list(many_arms.named(kept)) == [
        ['ur5e', 'study', 'pan', '2', '2', '31 to 190'],
        ['ur5e', 'study', 'none', '1', '1', '-'],
    ]
    rows = {label: counts for _, _, label, *counts in many_arms.quarters(kept)}
    assert rows['damping of the springs'] == ['2', '1', '0', '0']
    assert all(sum(map(int, counts)) == 3 for counts in rows.values())


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

    def figures(*run, **_):
        rms = 2.0 if run[1] == soft_arms.NO_LEARNING else 1.0
        return soft_arms.Figures('', none, none, rms, np.nan, 0.0, is_softened=False)

    monkeypatch.setattr(soft_arms, 'figures', figures)
    asked = soft_arms.DOB, soft_arms.THIS
    rows = list(soft_arms.rows('ur5e', 1, asked, soft_arms.Kept(None)))
    assert [row[1] for row in rows] == ['goal', soft_arms.THIS, soft_arms.DOB]
    assert {row[7] for row in rows[1:]} == {'-'}  # nothing to compare with
    asked = soft_arms.NO_LEARNING, *asked
    rows = list(soft_arms.rows('ur5e', 1, asked, soft_arms.Kept(None)))
    assert [row[1] for row in rows[1:]] == [
        soft_arms.NO_LEARNING,
        soft_arms.THIS,
        soft_arms.DOB,
    ]
    assert [row[7] for row in rows[1:]] == ['1', '2', '2']


def figures_of(worst, stop='', *, is_softened=False):
    errors = [worst] * 3
    return soft_arms.Figures(stop, errors, errors, worst, np.nan, 0.02, is_softened)


def test_rows_of_soft_arms_say_median_worst_and_what_does_not_hold():
    stopped = figures_of(np.nan, '2.00 s: oscillation')
    found = [*map(figures_of, (1.0, 2.0, 6.0)), stopped]
    others = [*map(figures_of, (2.0, 8.0, 6.0)), figures_of(1.0)]
    found[0] = found[0]._replace(is_softened=True)
    row = soft_arms.row('ur5e', soft_arms.DOB, found, others)
    assert row[2:5] == ['2.00 (6.00)'] * 3
    assert row[7] == '2 (1)'  # 2 / 1, 8 / 2 and 6 / 6, of arms that go on
    assert row[8] == '2.0 %, 1 of 4 stop, 2.00 s: oscillation, 1 of 4 oscillate'
    gone = soft_arms.row('ur5e', soft_arms.DOB, [stopped], [])
    assert gone[2] == '1 of 1 stop, 2.00 s: oscillation'
    assert len(gone) == len(row)


def test_true_arms_are_the_same_for_all_laws_and_spread_about_that_of_the_row():
    arm = soft_arms.ARMS['panda']
    arms = [soft_arms.drawn(arm, number) for number in range(1, 6)]
    other = arm._replace(gains={'feedback.stiffness': 0.5})
    assert [soft_arms.drawn(other, number) for number in range(1, 6)] == arms
    nominal = soft_arms.flatten(soft_arms.loop_with(arm, {}).plant)
    for name, most in soft_arms.SPREADS.items():
        factors = np.array([each[name] for each in arms]) / nominal[name]
        assert 1.0 / most <= factors.min() < 1.0 < factors.max() <= most
        assert np.unique(factors.round(9)).size == factors.size
    falling = [each['disturbance.stribeck'] for each in arms]
    assert len(set(falling)) == len(arms)
    assert all(0.0 < each['disturbance.load_share'] < 0.08 for each in arms)


def test_runs_of_soft_arms_that_are_kept_are_not_made_again(monkeypatch, tmp_path):
    made = []

    def figures(name, law, number, true):
        made.append((name, law, number, true['disturbance.stribeck']))
        return figures_of(1.0 + number)

    monkeypatch.setattr(soft_arms, 'figures', figures)
    path = tmp_path / 'runs.jsonl'
    asked = 'fr3', 2, (soft_arms.THIS, soft_arms.PD)
    rows = list(soft_arms.rows(*asked, soft_arms.Kept(path)))
    assert list(soft_arms.rows(*asked, soft_arms.Kept(path))) == rows
    assert len(made) == 4
    assert made[0][2:] == made[2][2:]  # the same true arm
    assert made[0][3] != made[1][3]


def rise_of(law, controller, error):
    """Return torques (k, n) of RISE at rest at the errors (k, n), 1 ms apart."""
    settings, signals = controller.settings, controller.signals
    state = controller.state._replace(memory=np.zeros(3 * settings.n))
    for each in (signals.dq, signals.dqr, signals.ddqr):
        each[:] = 0.0
    torques = []
    for k, xi1 in enumerate(error):
        state.samples[0] = k
        signals.xi1[:] = xi1
        law.compute_demand(settings, state, signals, 1e-3 * k, 1e-3)
        law.finish(settings, state, signals, 1e-3, k >= len(error) - 3)
        torques.append(signals.demand.copy())
    return np.array(torques)


def test_rise_is_a_pid_over_the_model_and_the_integral_of_a_sign():
    controller = controller_of(random_arms.study_of('panda').controller)
    settings, signals = controller.settings, controller.signals
    rng = np.random.default_rng(1)
    signals.qr[:] = rng.uniform(-0.5, 0.5, settings.n)
    gravity = gravity_torque(settings, settings.initial_estimate, signals.qr)
    K = settings.barrier.weight
    error = rng.uniform(-0.01, 0.01, settings.n)
    law = rise.LAW(scale=0.8, rate=3.0, sign=0.2)
    torque = rise_of(law, controller, np.tile(error, (9, 1)))
    rate = 0.8 * (3.0 * K * error + 0.2 * K * np.sign(error))
    for k in range(7):  # then torques are cut, and nothing is added
        np.testing.assert_allclose(torque[k], gravity - 1e-3 * k * rate, atol=1e-9)
    np.testing.assert_allclose(torque[8], torque[6], atol=1e-9)
    law = rise.LAW(scale=0.8, rate=3.0, sign=0.0)
    step = rise_of(law, controller, np.array([0.0 * error, error]))
    np.testing.assert_allclose(step[1], gravity - 0.8 * K * error, atol=1e-9)


def test_integral_of_rise_has_its_rate_at_the_amplitude_of_its_sign():
    """The first harmonic over a slow period, in which D^-1 K e is the whole of e2.

    The sum over 2000 samples is within 1e-3 of the integral.
    """
    controller = controller_of(random_arms.study_of('panda').controller)
    settings = controller.settings
    wave = np.sin(2.0 * np.pi * np.arange(2003) / 2000.0)
    errors = soft_arms.SIGN * np.tile(wave[:, None], settings.n)
    gains = soft_arms.rise_gains((0.9, 8.0))
    law = rise.LAW(**{name.partition('.')[2]: each for name, each in gains.items()})
    torque = rise_of(law, controller, errors)
    K = settings.barrier.weight
    integral = -(torque - torque[:1]) - 0.9 * K * errors
    rate = np.diff(integral[:2001], axis=0) / 1e-3
    found = 2.0 * (rate * wave[:2000, None]).mean(axis=0)
    np.testing.assert_allclose(found, 0.9 * 8.0 * K * soft_arms.SIGN, rtol=2e-3)


def test_two_encoders_have_the_loop_of_one_where_they_are_at_the_same_place():
    loop = soft_arms.loop_with(soft_arms.ARMS['panda_no_loop'], {})
    arm = random_arms.describe(loop.controller, loop.plant, 1)
    own = random_arms.own_feedback(loop.controller, arm.M0)
    feedback = two_encoders.with_ratio(own, 1.0)
    seen = two_encoders.responses(arm)
    C = law_response(feedback, arm.timing, seen.s)
    for place, side in ((two_encoders.LINKS, False), (two_encoders.MOTORS, True)):
        joints = arm.joints._replace(motor_side=side)
        G = arm_response(arm.links, joints, arm.timing, seen.s)
        gain = two_encoders.loop_gain(seen, arm.timing, feedback, (place, place))
        np.testing.assert_allclose(gain, C @ G, rtol=1e-6, atol=1e-12)
        factor = two_encoders.largest(seen, gain)
        assert 0.0 < factor < 1.0
        scaled = feedback._replace(
            position=factor * feedback.position,
            surface=factor * feedback.surface,
            integral=1e-3 * own.integral,  # 0 keeps what it has, which is not stable
        )
        assert Loop(arm.links, joints, arm.timing, scaled).is_stable()


def test_other_damping_leaves_the_stiffness():
    loop = soft_arms.loop_with(soft_arms.ARMS['panda'], {})
    arm = random_arms.describe(loop.controller, loop.plant, 1)
    feedback = random_arms.own_feedback(loop.controller, arm.M0)
    slow = 2j * np.pi * np.array([0.3, 30.0])
    usual, other = (
        law_response(two_encoders.with_ratio(feedback, ratio), arm.timing, slow)
        for ratio in (1.0, 2.0)
    )
    np.testing.assert_allclose(other[:, 0].real, usual[:, 0].real, rtol=0.02)
    diagonal = np.arange(feedback.rate.size)
    damping, more = (each[0, 1, diagonal, diagonal] for each in (usual, other))
    np.testing.assert_allclose(np.abs(more / damping), 2.0, rtol=0.1)


def test_rows_of_pairs_count_what_learning_and_noise_break():
    yes, no = (True,) * 3, (False,) * 3
    found = [
        soft_pairs.Pair('panda', 0, yes, yes, (1.0, 2.0, 2.0)),
        soft_pairs.Pair('panda', 1, (False, True, True), yes, (2.4, 2.0, 2.1)),
        soft_pairs.Pair('panda', 2, (True, False, False), yes, (2.1, 2.0, 2.0)),
        soft_pairs.Pair('panda', 3, (True, True, False), yes, (1.0, 2.0, 3.0)),
        soft_pairs.Pair('panda', 4, no, (False, True, True), (np.nan, 2.0, 2.0)),
    ]
    row = soft_pairs.row('panda', found)
    assert row[1:6] == ['5', '3 / 3', '1 / 1', '1 / 0', '4']
    assert row[6:] == ['0.78, 1.20 (1)', '2, 1', '1.50']
    assert len(row) == len(soft_pairs.HEADS) == len(soft_pairs.row('panda', found[4:]))


def test_pairs_that_are_kept_are_not_run_again(monkeypatch, tmp_path):
    made = []

    def figures_of(study, *_):
        made.append(1)
        rms = {f'rms_error_rad.{name}': 3e-3 for name in study.plant.joints}
        return {'outcome': 'kept', **rms}

    def simulate(law, _):  # arm 1 stops without learning
        is_second = len(made) >= 3
        stops = is_second and law.learning.weight == 0.0
        return SimpleNamespace(stopped=4.0 if stops else inf)

    monkeypatch.setattr(soft_pairs, 'simulate', simulate)
    monkeypatch.setattr(soft_pairs, 'figures_of', figures_of)
    path = tmp_path / 'pairs.jsonl'
    found = list(soft_pairs.pairs(2, ['ur5e'], path))
    assert list(soft_pairs.pairs(2, ['ur5e'], path)) == found
    assert len(made) == 2 * 3
    assert found[1].rms == pytest.approx([3e-3 * 6**0.5] * 3)
    assert found[0].kept == found[0].ends == (True,) * 3
    assert found[1].kept == found[1].ends == (True, False, False)


def test_arms_of_pairs_that_are_commissioned_have_the_gains_that_follow(monkeypatch):
    """An arm that gets none has not kept its bound."""
    stiffness = []

    def simulate(law, _):
        stiffness.append(law.feedback.joint_stiffness)
        return SimpleNamespace(stopped=inf)

    def figures_of(study, *_):
        return {'outcome': 'kept'} | {
            f'rms_error_rad.{name}': 1.0 for name in study.plant.joints
        }

    def commissioned(controller, runs):
        if runs == ['none']:
            raise BlfDscError('no gains have the margin')
        gains = {'feedback.joint_stiffness': [123.0] * len(controller.joints)}
        return SimpleNamespace(config=change(controller, gains))

    monkeypatch.setattr(soft_pairs, 'simulate', simulate)
    monkeypatch.setattr(soft_pairs, 'figures_of', figures_of)
    monkeypatch.setattr(soft_pairs, 'commissioned', commissioned)
    monkeypatch.setattr(soft_pairs, 'runs_of', lambda *_: ['a run'])
    (pair,) = soft_pairs.pairs(1, ['ur5e'], None, measures=True)
    assert pair.kept == (True,) * 3
    assert stiffness == [(123.0,) * 6] * 3
    monkeypatch.setattr(soft_pairs, 'runs_of', lambda *_: ['none'])
    (pair,) = soft_pairs.pairs(1, ['ur5e'], None, measures=True)
    assert pair.kept == pair.ends == (False,) * 3
    assert len(stiffness) == 3


def test_chosen_poles_are_compared_with_one_for_all(monkeypatch, tmp_path):
    made = []

    def outcome(robot, number, pole):
        made.append((robot, number, pole))
        L = 100.0 * (1 + number) if pole == chosen_poles.CHOSEN else float(pole)
        errors = 0.001, 0.6 / L, 0.002
        return chosen_poles.Outcome(L, *errors, number > 0, number > 1, number > 1)

    monkeypatch.setattr(chosen_poles, 'outcome', outcome)
    path = tmp_path / 'runs.jsonl'
    found = chosen_poles.outcomes(3, path)
    assert chosen_poles.outcomes(3, path) == found
    assert len(made) == 3 * 2 * 3
    rows = list(chosen_poles.rows(found))
    assert [row[:2] for row in rows[3:]] == [
        ['fr3', '60'],
        ['fr3', '150'],
        ['fr3', 'chosen: 100, 200, 300'],
    ]
    assert rows[0][2:] == ['3', '1, 1', '10, 10', '2, 2', '2', '1', '1']
    assert rows[5][2:5] == ['3', '1, 1', '3, 6']
    assert all(len(row) == len(chosen_poles.HEADS) for row in rows)


def test_bandwidths_are_compared_on_arms_that_ran_with_all_of_them(
    monkeypatch, tmp_path
):
    made = []

    def outcome(_, number, bandwidth):
        made.append(number)
        figures = 1.0 + bandwidth, 0.002, bandwidth > 0.0, number < 0, number < 0
        return observer_poles.Outcome(*figures)

    monkeypatch.setattr(observer_poles, 'outcome', outcome)
    path = tmp_path / 'runs.jsonl'
    found = observer_poles.outcomes(2, path)
    assert observer_poles.outcomes(2, path) == found
    assert len(made) == 2 * 2 * len(observer_poles.BANDWIDTHS)
    found.pop(('fr3', 300.0, 1))
    rows = list(observer_poles.rows(found))
    at_60, at_150 = rows[1], rows[3]
    assert at_60 == ['panda', '60', '2', '1.00, 1.00', '2.0, 2.0, 2.0', '2', '0', '0']
    assert at_150[:4] == ['panda', '150', '2', '2.48, 2.48']
    assert [row[2] for row in rows] == ['2'] * 6 + ['1'] * 6
    assert all(len(row) == len(observer_poles.HEADS) for row in rows)


@pytest.mark.parametrize('name', soft_pairs.ROBOTS)
def test_arms_of_pairs_are_elastic_and_their_friction_falls_and_follows_the_load(name):
    study = soft_pairs.load_study(f'monte_carlo_elastic_changes_{name}')
    arms = [random_arms.arm_of(study, number) for number in range(5)]
    assert study.settings.pairs
    assert min(min(arm.joint.stiffness) for arm in arms) >= 1e4
    assert len({arm.disturbance.stribeck for arm in arms}) == len(arms)
    assert len({arm.disturbance.load_share for arm in arms}) == len(arms)
    assert all(arm.events.begin[0] >= 1.0 for arm in arms)
    assert any(any(arm.events.payload) for arm in arms)
