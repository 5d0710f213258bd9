# SPDX-License-Identifier: Apache-2.0
"""The guarded law: what acts after it stops, what is kept over that, and other gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fault_table import Rig
from nights import at_night
from plain_law import dynamics
from scenario import Scenario, changed, every, late, lost, repeated, run

import blf_dsc_controller as blf
from blf_dsc_controller.reference.trajectory import Trajectory

P = np.array([1.0, 0.32, 0.4])
KNOWN = {'two_link.initial_estimate': P.tolist(), 'two_link.learning_weight': 0.0}
HALF = {
    'two_link.initial_estimate': (0.5 * P).tolist(),
    'two_link.learning_weight': 0.0,
}
HOLDING = {'safety.torque': 'hold_gravity'}
QUIET = {'disturbance.constant': [0.0, 0.0], 'disturbance.amplitude': [0.0, 0.0]}
LEAVE = {
    'stop': lambda arm: arm.controller.fail('by hand'),
    'deactivation': lambda arm: arm.controller.stop(),
}


def arm_of(given=None, plant=None):
    return Scenario('recommended', given, plant=plant)


def weight(q):
    """Gravity torque of the true parameters."""
    return dynamics(P, 9.8, q, (0.0, 0.0))[2]


def pushed(*torque):
    """Return what drives give that another torque (n,) [N m] acts beside."""
    return lambda commanded: commanded + np.array(torque)


# The torque without the law.


@pytest.mark.parametrize('torque', ['zero', 'damping', 'hold_gravity'])
def test_safe_torque_does_what_its_name_says_within_the_torque_limit(torque):
    """In motion, and where the arm comes to rest."""
    given = KNOWN | {'safety.torque': torque}
    arm = arm_of(given, QUIET)
    before = arm.run(0.5)
    (first,) = arm.run(arm.T, spoil=changed(dq=lambda dq: np.nan * dq)).torque
    dq = before.dq[-1]
    damped = -np.array(arm.config.safety.damping) * dq
    if torque == 'zero':
        assert not first.any()
    elif torque == 'damping':
        np.testing.assert_allclose(first, damped, rtol=0.1)
    else:
        held = weight(before.q[-1])
        np.testing.assert_allclose(first, held, atol=2.0 * np.abs(damped).max())
        rest = arm.run(3.0)
        np.testing.assert_allclose(rest.torque[-1], weight(rest.q[-1]), atol=0.05)
        arm.change({'torque.limit': [3.0, 2.0]})
        np.testing.assert_allclose(np.abs(arm.run(arm.T).torque[0]), [3.0, 2.0])


def test_torque_of_a_law_that_is_deactivated_fades_in_a_straight_line():
    """Within 0.5 s, where no gravity is held."""
    arm = arm_of()
    last = arm.run(0.02).torque[-1]
    arm.controller.stop()
    after = arm.run(0.51).torque
    expected = np.outer(np.maximum(1.0 - 0.002 * np.arange(1, 511), 0.0), last)
    np.testing.assert_allclose(after, expected, atol=1e-12)


@pytest.mark.parametrize('way', LEAVE)
@pytest.mark.parametrize(
    ('factor', 'angle'), [(0.5, 0.2), *at_night((1.0, 0.12), (1.5, 0.2))]
)
def test_arm_that_leaves_command_rests_although_its_model_may_be_wrong(
    way, factor, angle
):
    """By the load that its motion shows, from the first torque on.

    With zero torque the arm falls by 1.5 rad.
    """
    estimate = {'two_link.initial_estimate': (factor * P).tolist()}
    arm = arm_of(KNOWN | HOLDING | estimate, QUIET)
    before = arm.run(0.5)
    assert (before.speed[-1] > 0.1).all()
    LEAVE[way](arm)
    after = arm.run(3.0)
    assert np.abs(after.q - before.q[-1]).max() < angle
    assert after.speed[-1].max() < 0.02
    np.testing.assert_allclose(after.torque[-1], weight(after.q[-1]), atol=0.15)
    # At once, and not only as the load is observed: within 0.05 s it hardly speeds up.
    faster = after.speed[:50].max(axis=0) - before.speed[-1]
    assert faster.max() < 0.05


def test_arm_that_is_deactivated_stays_where_it_rests():
    """A disturbance of 0.1 N m passed for another that moves it, and it fell by 1.6 rad."""
    arm = arm_of(HOLDING)
    arm.run(0.3)
    arm.controller.stop()
    rest = arm.run(2.0).q[-1]
    assert np.abs(arm.run(6.0).q - rest).max() < 0.02


def test_reset_of_a_stopped_arm_forgets_what_it_learned_and_drops_nothing():
    """Half of gravity was learned: the load that is carried on grows by what is forgotten."""
    arm = arm_of(HALF | HOLDING | {'two_link.learning_weight': 1.0}, QUIET)
    arm.run(9.0)
    learned = arm.controller.estimates
    assert learned['m2*l1*l2'] == pytest.approx(0.4, rel=0.15)
    arm.controller.fail('by hand')
    held = arm.run(2.0)
    arm.controller.reset()
    after = arm.run(0.05)
    assert arm.controller.estimates['m2*l1*l2'] == pytest.approx(0.2, rel=0.1)
    assert np.abs(after.q - held.q[-1]).max() < 0.003
    np.testing.assert_allclose(after.torque[0], held.torque[-1], atol=0.3)


GLITCHES = {
    'velocity of another arm': {'dq': lambda dq: dq + 20.0},
    'velocity beyond its limit': {'dq': lambda dq: dq + 1e6},
    'no velocity': {'dq': lambda dq: np.nan * dq},
    'no position': {'q': lambda q: np.nan * q},
    'position that jumps': {'q': lambda q: q + 0.02},
    'position of no arm': {'q': lambda q: q - 1e300},
}


@pytest.mark.parametrize(
    'glitch',
    [
        *('velocity of another arm', 'no position', 'position that jumps'),
        *at_night('velocity beyond its limit', 'no velocity', 'position of no arm'),
    ],
)
def test_one_wrong_state_hardly_moves_an_arm_that_is_held_in_a_stop(glitch):
    """Neither by damping nor by a load that it would show."""
    arm = arm_of(HALF | HOLDING, QUIET)
    arm.run(0.5)
    arm.controller.fail('by hand')
    before = arm.run(3.0)
    spoilt = arm.run(arm.T, spoil=changed(**GLITCHES[glitch]))
    after = arm.run(1.0)
    assert np.isfinite(spoilt.torque).all()
    assert np.abs(after.torque[50:] - before.torque[-1]).max() < 1.0
    far = 0.05 if glitch == 'position that jumps' else 0.005  # rad
    assert np.abs(after.q - before.q[-1]).max() < far


@pytest.mark.parametrize('torque', ['zero', 'damping', 'hold_gravity'])
@pytest.mark.parametrize(('last', 'speeds_up'), [(0.8, False), (2.3, True)])
def test_arm_that_was_fast_at_the_stop_speeds_up_only_if_it_gets_faster(
    last, speeds_up, torque
):
    """From 2 * 0.8 + 0.5 rad/s on; without a torque it may."""
    arm = arm_of({'safety.torque': torque, 'safety.error_ratio': 0.0})
    q = np.array([0.3, -0.4])
    for k in range(700):
        if k == 100:
            arm.controller.fail('by hand')
        dq = np.full(2, 0.8 if k < 100 else last)
        q += 1e-3 * dq
        arm.controller.update(1.0 + 1e-3 * k, q, dq)
    said = arm.text.count('speeds up in the safe stop')
    assert said == (speeds_up and torque != 'zero')


def test_arm_that_falls_after_a_refused_start_is_said_to_be_without_a_torque():
    limits = {'limits.position_lower': [-1.0] * 2, 'limits.position_upper': [1.0] * 2}
    refused = {'reference.type': 'hold', 'safety.torque': 'damping'}
    arm = arm_of(limits | refused)
    for k in range(400):
        t = 1e-3 * k
        q, dq = [1.2 + 6.0 * t * t, 0.0], [12.0 * t, 0.0]
        assert arm.controller.update(1.0 + t, q, dq) is None
    assert arm.reason == 'start rejected'
    assert 'speeds up while nothing is commanded' in arm.text


# What is kept, and how the law returns.


def test_torque_continues_after_immediate_reactivation():
    arm = arm_of()
    before = arm.run(0.2).torque[-1]
    arm.controller.stop()
    arm.run(arm.T)
    arm.controller.start()
    after = arm.run(0.1)
    assert arm.controller.phase is blf.Phase.TRACKING
    # The surface filter restarts: that changes the torque of 9 N m by K_p = 60 N m
    # s/rad times the few mrad/s that it lagged behind.
    assert np.abs(after.torque[0] - before).max() < 0.3
    assert after.ratio < 0.5


@pytest.mark.parametrize('again', ['start', 'reset'])
def test_rate_limit_applies_from_the_torque_before_an_activation(again):
    """The safe torque is zero and gravity takes 12 N m: it is approached at the rate limit."""
    rate = np.array([1000.0, 300.0])
    arm = arm_of({'torque.rate_limit': rate.tolist()})
    torques = [arm.run(0.2).torque[-1:]]
    torques += [arm.controller.fail('by hand')[None], arm.run(0.012).torque]
    assert not torques[-1][-1].any()
    getattr(arm.controller, again)()
    torques.append(arm.run(0.012).torque)
    steps = np.abs(np.diff(np.concatenate(torques), axis=0))
    assert (steps <= rate * arm.T * (1.0 + 1e-9)).all()
    np.testing.assert_allclose(steps[13], rate * arm.T)


@pytest.mark.parametrize('again', ['start', 'reset'])
def test_estimates_are_kept_over_an_activation_and_forgotten_by_a_reset(again):
    arm = arm_of()
    arm.run(arm.T)
    initial = np.array([*arm.controller.estimates.values()])
    arm.run(0.2)
    learned = np.array([*arm.controller.estimates.values()])
    arm.controller.stop()
    getattr(arm.controller, again)()
    arm.run(arm.T)
    kept = np.array([*arm.controller.estimates.values()])
    expected = learned if again == 'start' else initial
    assert np.abs(learned - initial).max() > 1e-3
    np.testing.assert_allclose(kept, expected, atol=5e-4)  # a sample later
    # an empty window fills from t = 0 on
    assert arm.events[-1].content['resumed'] == (again == 'start')


def test_estimates_from_before_a_fault_are_kept_and_nothing_else_is():
    arm = arm_of({'safety.error_ratio': 0.35})  # exceeded during the motion
    seen = []
    while not arm.reason.startswith('error'):
        arm.run(arm.T)
        seen.append([*arm.controller.estimates.values()])
    arm.controller.start()
    law = arm.guard.controller
    kept = law.save()
    estimate, disturbance = law.state.estimate.copy(), law.state.disturbance.copy()
    at = np.flatnonzero((np.array(seen) == estimate).all(axis=1))
    assert 0 < at[-1] < len(seen) - 1  # from before the error grew
    assert disturbance.any()
    law.reset()
    law.state.estimate[:] = estimate
    law.state.disturbance[:] = disturbance
    np.testing.assert_array_equal(kept, law.state_vector)


def test_reference_is_resumed_only_by_a_law_that_left_command_in_order():
    arm = arm_of()
    resumed = []
    for leave in (
        arm.controller.stop,
        lambda: arm.controller.fail('by hand'),
        lambda: arm.controller.fail('by hand') is None or arm.controller.stop(),
        lambda: arm.change({'safety.error_ratio': 1e-3}),  # at run time
    ):
        arm.run(0.1)
        assert arm.is_running
        leave()
        arm.run(arm.T)
        assert not arm.is_running
        arm.change({'safety.error_ratio': 1.0})
        arm.controller.start()
        arm.run(arm.T)
        resumed.append(arm.events[-1].content['resumed'])
    assert resumed == [True, False, False, False]


def test_start_that_was_planned_before_other_limits_is_planned_again():
    away = {'initial.position': [2.0, 1.5]}
    slower = {'limits.acceleration': [1.0, 1.0]}  # rad/s^2
    early, late = arm_of(plant=away), arm_of(slower, away)
    early.controller.prepare(early.plant.measure()[:2])
    early.change(slower)
    np.testing.assert_array_equal(early.run(0.5).dqr, late.run(0.5).dqr)


# Other parameters in motion.

NEW_GAINS = [
    {'two_link.feedback_gain': [120.0, 40.0]},
    {'two_link.surface_gain': [300.0, 75.0]},
    {'two_link.mu': [40.0, 10.0]},
    {'two_link.barrier_weight': [5000.0, 200.0]},
    {'barrier.bound': [0.004, 0.0015]},
]


def largest_step(given, samples):
    """Largest change of a torque after other gains, at the largest error of the start."""
    arm = arm_of()
    before = arm.run(0.06).torque[-1]
    assert arm.change(given) == []
    return np.abs(arm.run(samples * arm.T).torque - before).max()


@pytest.mark.parametrize(
    ('given', 'samples', 'most'),
    [
        *((given, 1, 2.0) for given in NEW_GAINS),
        *((given, 20, 1.2) for given in NEW_GAINS[1:3]),
    ],
)
def test_gain_change_is_bumpless(given, samples, most):
    """The torque changes about as little as from sample to sample without new gains.

    What the surface filter absorbed does not come back after ten of its time constants.
    """
    assert largest_step(given, samples) < most * largest_step({}, samples)


REFUSED = [
    ({'barrier.bound': [1e-6, 0.002]}, 'barrier.bound: joint1 is'),
    ({'torque.limit': [20.0, 2.0]}, 'torque.limit: joint2 is held with'),
]


@pytest.mark.parametrize('phase', ['approaching', 'tracking'])
@pytest.mark.parametrize(('given', 'message'), REFUSED)
def test_gains_that_a_running_law_cannot_adopt_are_refused(phase, given, message):
    away = {'initial.position': [2.0, 1.5]} if phase == 'approaching' else None
    arm = arm_of(plant=away)
    before = arm.run(0.2)
    assert before.phase[-1] == phase
    (problem,) = arm.change(given)
    assert problem.startswith(message)
    arm.controller.stop()
    assert arm.change(given) == []


def test_correction_of_the_estimate_that_would_diverge_is_refused_once_it_is_made():
    quick = {
        'learning.window': 0.2,
        'two_link.excitation_threshold': 1e-12,
    }
    arm = arm_of(quick)
    heavy = {'two_link.learning_weight': 2e5}
    arm.run(0.8)
    (problem,) = arm.change(heavy)
    assert problem.startswith('two_link.learning_weight: the Newton step')
    arm.restart(quick | {'two_link.excitation_threshold': 1e9})
    arm.run(0.4)
    assert arm.change(heavy) == []


def test_retuning_leaves_a_joint_without_integrator_without_a_disturbance():
    """It would keep it for ever: the torque of that joint steps instead."""
    arm = arm_of({'disturbance.gain': [0.0, 100.0]})
    arm.run(0.06)
    arm.change({'two_link.feedback_gain': [30.0, 10.0]})
    arm.run(arm.T)
    assert next(iter(arm.controller.disturbance.values())) == 0.0


def test_velocity_limit_changed_at_run_time_holds_from_the_next_state_on():
    arm = arm_of()
    speed = arm.run(0.1).speed[-1].max()
    arm.change({'safety.velocity_limit': [0.5 * float(speed)] * 2})
    arm.run(arm.T)
    assert arm.reason == 'velocity not plausible'


# Motions.

TO = (2.1, 1.5)  # rad


def test_arm_approaches_a_motion_that_begins_later_and_then_tracks_it():
    arm = arm_of()
    arm.run(1.5)
    assert arm.controller.phase is blf.Phase.TRACKING
    arm.controller.follow([(1.0, TO)], begin=1.8)
    later = arm.run(0.299)
    assert (later.phase == blf.Phase.APPROACHING).all()
    after = arm.run(1.2)
    assert after.phase[-1] == blf.Phase.TRACKING
    np.testing.assert_allclose(arm.controller.reference.q, TO)
    assert after.ratio < 1.0


def test_approach_is_over_once_another_motion_is_asked_for():
    arm = arm_of(plant={'initial.position': [2.0, 1.5]})
    assert arm.run(0.1).phase[-1] == blf.Phase.APPROACHING
    arm.guard.motions.brake()
    assert arm.run(arm.T).phase[-1] == blf.Phase.TRACKING


def test_plan_is_followed_from_its_start_unless_late_or_from_a_replaced_reference():
    """Whatever comes before it, a trajectory or a stop: the reference does not jump."""
    arm = arm_of()
    arm.run(0.1)
    motions, to = (
        arm.guard.motions,
        Trajectory(arm.config.joints, (blf.TrajectoryPoint(1.0, TO),)),
    )
    late, replaced, plan = (motions.plan(to, 0.1 + lead) for lead in (0.01, 0.03, 0.03))
    arm.run(0.02)
    with pytest.raises(blf.TrajectoryError, match='planned only at'):
        motions.adopt(late)
    motions.adopt(plan)
    with pytest.raises(blf.TrajectoryError, match='replaced while it was planned'):
        motions.adopt(replaced)
    before = arm.run(0.2)
    motions.brake()
    motions.adopt(motions.plan(to))
    after = arm.run(1.5)
    dqr = np.concatenate((before.dqr, after.dqr))
    assert np.abs(np.diff(dqr, axis=0)).max() < 0.02  # rad/s
    assert after.phase[-1] == blf.Phase.TRACKING
    np.testing.assert_allclose(arm.controller.reference.q, TO)


# States that are missed, and clocks.


@pytest.mark.parametrize(
    ('gap', 'missed'), [(1.0, 0), (1.4, 0), (1.6, 1), (1.9, 1), (2.1, 1), (2.9, 2)]
)
def test_gap_counts_to_the_nearest_number_of_missed_states(gap, missed):
    arm = arm_of()
    q, dq, _ = arm.plant.measure().reshape(3, -1)
    arm.controller.update(1.0, q, dq)
    arm.controller.update(1.0 + 1e-3 * gap, q, dq)
    assert arm.controller.missed == missed


@pytest.mark.parametrize(
    'spoil', [lost(0.3), repeated(3), late(2)], ids=['lost', 'repeated', 'late']
)
def test_arm_tracks_on_while_states_are_lost_repeated_or_late(spoil):
    record = run('recommended', until=2.0, spoil=spoil)
    assert record.phase[-1] == blf.Phase.TRACKING
    assert record.ratio < 0.8


def test_stop_names_both_rates_where_the_states_come_at_another():
    arm = arm_of()
    arm.run(0.03, spoil=every(0.003))
    arm.run(0.06, spoil=every(0.003), reach=pushed(40.0, 0.0))
    assert arm.reason == 'error past the bound'
    both = 'joint states come every 0.003 s, but sample_time is 0.001 s'
    assert both in arm.text


BACK = {
    'clock set': (lambda state, _: state, 'the clock was set'),
    # It has moved for less than the gap, at its mean velocity, since it has stood.
    'braked': (lambda state, q: replace(state, q=q, dq=0.1 * state.dq), ''),
    'no position': (lambda state, q: replace(state, q=np.nan * q), 'not finite'),
    'no velocity': (lambda state, q: replace(state, dq=np.nan * q), 'not finite'),
}


@pytest.mark.parametrize('back', BACK)
def test_clock_that_is_set_is_named_instead_of_the_error_it_makes(back):
    """By 35 ms, which safety.state_timeout allows: the reference would jump by 10 mrad."""
    arm = arm_of()
    last = arm.run(1.0).q[-1]
    change, text = BACK[back]
    arm.run(
        arm.T,
        spoil=lambda state: [replace(change(state, last), stamp=state.stamp + 0.035)],
    )
    assert text in arm.text
    assert ('the clock was set' in arm.text) == (back == 'clock set')


def test_states_that_are_really_missed_are_no_step_of_the_clock():
    arm = arm_of()
    arm.run(1.0)
    arm.run(0.008, spoil=lambda _: [])
    after = arm.run(0.02)
    assert (after.phase == blf.Phase.TRACKING).all(), arm.text


@pytest.mark.parametrize('gap', [0.1, 0.035])
def test_stop_after_a_gap_begins_at_the_torque_that_acts(gap):
    """Another node, such as the watchdog, may have commanded it meanwhile.

    A stop without a state begins at the last command: the effort after the gap is older.
    """
    step = 1.0  # N m in a sample
    arm = arm_of({'robot.effort': 'whole', 'torque.rate_limit': [1e3 * step] * 2})
    arm.run(1.0)
    arm.run(gap, spoil=lambda _: [])
    acting = np.array([7.0, -7.0])  # N m
    (after,) = arm.run(arm.T, spoil=changed(effort=lambda _: acting)).torque
    if gap > 0.05:
        assert arm.reason == 'stamp jump'
        np.testing.assert_allclose(after, acting, atol=step * (1.0 + 1e-9))
    else:
        assert arm.is_running, arm.text
        at_stop = arm.controller.fail('why')
        np.testing.assert_allclose(at_stop, after, atol=step * (1.0 + 1e-9))


@pytest.mark.parametrize(
    ('watchdog', 'late', 'why_off', 'stops'),
    [
        ('auto', 59.0, '', True),
        ('auto', 61.0, '61 s behind', False),
        ('auto', -61.0, '61 s ahead of', False),
        ('on', 61.0, '', True),
        ('off', 0.0, '', False),
    ],
)
def test_silence_stops_if_stamps_are_live_or_the_watchdog_is_on(
    watchdog, late, why_off, stops
):
    """Of stamps that are `late` by some seconds; what is switched off says why."""
    rig = Rig({'safety.watchdog': watchdog}, live=True)
    rig.base -= int(late * 1e9)
    rig.step(20)
    assert why_off in rig.guard.watchdog.why_off
    assert bool(rig.guard.watchdog.why_off) == bool(why_off)
    rig.wait(60 if stops else 5000)
    assert (str(rig.supervisor.reason) == 'state timeout') == stops
    assert rig.commands[-1].any() != stops
    rig.step(20)
    assert rig.supervisor.running != stops


def test_samples_past_the_bound_are_counted_where_they_do_not_stop_the_arm():
    arm = arm_of({'safety.error_ratio': 0.0})
    after = arm.run(0.06, reach=pushed(10.0, 0.0))
    past = (np.abs(after.error) > after.bound).any(axis=1).sum()
    assert arm.is_running
    assert 0 < arm.guard.samples.outside == past < 60


def test_arm_that_stands_still_under_noise_is_not_taken_for_braked():
    """Noise makes the torque chatter although nothing moves."""
    given = {'reference.type': 'hold', 'safety.oscillation': 'ignore'}
    arm = arm_of(KNOWN | given)
    draw = np.random.default_rng(0)
    noise = changed(dq=lambda dq: dq + 0.04 * draw.normal(size=2))
    steps = np.diff(arm.run(2.0, spoil=noise).torque, axis=0)
    assert arm.controller.phase is blf.Phase.TRACKING, arm.text
    assert np.abs(steps[-1000:]).max() > 2.0  # N m, a tenth of the limit
