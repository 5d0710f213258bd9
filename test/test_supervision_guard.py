# SPDX-License-Identifier: Apache-2.0
"""The guarded law: safe torques, ramps, what is kept over a stop, and gain changes at run time."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from fault_table import JOINTS, MILLISECOND, Rig, jammed, sparse
from paper_case import instead
from plain_law import dynamics

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.controller_groups import Safety
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.reference.terms import unpack
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryError,
    TrajectoryPoint,
)
from blf_dsc_controller.run import TURNING
from blf_dsc_controller.supervision.braking import braking_matrix, within_gap
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.last_state import LastState
from blf_dsc_controller.supervision.plan import LatePlanError
from blf_dsc_controller.supervision.recent_motion import RecentMotion
from blf_dsc_controller.supervision.retuning import apply, apply_bumpless
from blf_dsc_controller.supervision.running_reference import RunningReference
from blf_dsc_controller.supervision.safe_stop import SafeStop
from blf_dsc_controller.supervision.safe_torque import SafeTorque, safe_torque
from blf_dsc_controller.supervision.state_check import StateCheck
from blf_dsc_controller.supervision.state_watchdog import Watchdog
from blf_dsc_controller.supervision.stop_cause import chatter_of
from blf_dsc_controller.supervision.stop_speed import StopSpeed
from blf_dsc_controller.supervision.supervisor import Phase, Reason

Q, DQ = np.array([0.3, -0.4]), np.array([0.5, -2.0])
P = np.array([1.0, 0.32, 0.4])


def settings(**given):
    return settings_of_config(change(ControllerConfig(), given))


def weight(q):
    """Gravity torque of the true parameters."""
    return dynamics(P, 9.8, q, (0.0, 0.0))[2]


BRAKING = braking_matrix(settings(), np.array([2.0, 1.0]), Q)


@pytest.mark.parametrize(
    ('torque', 'dq', 'estimate', 'limit', 'expected'),
    [
        ('zero', DQ, P, 20.0, [0.0, 0.0]),
        ('damping', DQ, P, 20.0, [-1.0, 2.0]),
        ('hold_gravity', DQ, P, 20.0, weight(Q) - BRAKING @ DQ),
        ('hold_gravity', DQ, P, 3.0, [3.0, 3.0]),
        ('hold_gravity', DQ, P * np.nan, 20.0, [0.0, 0.0]),
        ('damping', np.array([1.7e308, 0.0]), P, 20.0, [0.0, 0.0]),
    ],
)
def test_safe_torque_does_what_its_name_says_limited_and_finite(
    torque, dq, estimate, limit, expected
):
    last = LastState(2)
    last.take(1, np.concatenate((Q, np.zeros(4))), dq)
    safety = Safety(torque=torque, damping=(2.0, 1.0))
    limited = {'torque.limit': (limit, limit)}
    got = safe_torque(safety, settings(**limited), last, estimate, np.zeros(2))
    np.testing.assert_allclose(got, expected)


def test_damping_alone_is_what_a_gap_of_states_allows():
    damping = np.array([20.0, 10.0])
    last = LastState(2)
    last.take(1, np.concatenate((Q, np.zeros(4))), DQ)
    last.gap = 0.1
    safety = Safety(torque='damping', damping=tuple(damping))
    unlimited = settings(**{'torque.limit': (1e3, 1e3)})
    borne = within_gap(unlimited, damping, Q, last.gap)
    assert (borne < 0.5 * damping).all()
    got = safe_torque(safety, unlimited, last, P, np.zeros(2))
    np.testing.assert_allclose(got, -borne * DQ)


def test_ramp_is_linear_and_ends_at_a_moving_goal():
    ramp = SafeTorque(2)
    safety = Safety(torque='damping', damping=(1.0, 1.0))

    def advance(goal):
        ramp.last.take(1, np.zeros(6), np.array([-goal, 0.0]))
        return ramp.advance(safety, settings(), P, 0.001)[0]

    ramp.commanded[0] = 4.0
    ramp.begin_ramp(0.004, np.zeros(2))
    got = [advance(goal) for goal in (0.0, 0.0, 8.0, 8.0, 7.0)]
    np.testing.assert_allclose(got, [3.0, 2.0, 7.0, 8.0, 7.0])
    ramp.commanded[0] = 4.0
    ramp.begin_ramp(0.0, np.zeros(2))
    assert advance(1.0) == 1.0
    ramp.commanded[0] = 4.0
    ramp.begin_ramp(1.0, np.zeros(2))
    lowered = settings(**{'torque.limit': (3.0, 3.0)})  # at run time
    assert ramp.advance(safety, lowered, P, 0.001)[0] == 3.0


def test_missed_states_are_averaged():
    """With every second state missed, the fraction is one half after a few windows."""
    states = StateCheck(JOINTS, (TURNING, TURNING), 1e-3)
    safety = Safety(overrun_fraction=1.0)
    for k in range(10_001):
        assert states.check(safety, (1 + 2 * k) * MILLISECOND) is None
    assert states.missed == 10_000
    assert states.missed_fraction == pytest.approx(0.5, abs=0.01)
    for k in range(10_000):
        assert states.check(safety, (20_002 + k) * MILLISECOND) is None
    assert states.missed_fraction < 1e-4


@pytest.mark.parametrize(
    ('watchdog', 'late', 'why_off', 'stops'),
    [
        ('auto', 0.0, '', True),
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
    assert (rig.supervisor.reason is Reason.STATE_TIMEOUT) == stops
    assert rig.commands[-1].any() != stops
    rig.step(20)
    assert rig.supervisor.running != stops


def test_silence_is_none_by_a_check_that_comes_late():
    """States may wait in the queue of a process that hung; the next check decides."""
    clock = SimpleNamespace(now=0)
    watchdog = Watchdog(lambda: clock.now, lambda: clock.now)
    found = []
    for pause in (8, 8, 100, 8):  # ms
        clock.now += pause * MILLISECOND
        if len(found) == 0:
            watchdog.restart()
        found.append(watchdog.measure_silence(0.05))
    assert found == [0.0, 0.0, 0.0, pytest.approx(0.116)]


@pytest.mark.parametrize('ramp', ['stop_ramp', 'deactivation_ramp'])
def test_torque_ramps_after_a_fault_or_a_deactivation_as_configured(ramp):
    rig = Rig({f'safety.{ramp}': 0.01})
    rig.step(20)
    last = rig.commands[-1]
    if ramp == 'stop_ramp':
        rig.deliver(b'')
    else:
        rig.guard.deactivate()
        rig.step()
    rig.step(12)
    ramp = np.array(rig.commands[-13:])
    np.testing.assert_allclose(
        ramp[:10], np.outer(np.linspace(0.9, 0.0, 10), last), atol=1e-12
    )
    assert not ramp[10:].any()


@pytest.mark.parametrize(('factor', 'angle'), [(1.0, 0.12), (0.5, 0.2), (1.5, 0.2)])
def test_stopped_arm_rests_although_its_model_may_be_wrong(factor, angle):
    """The safe torque observes what the model lacks.

    With zero torque the arm falls by 1.5 rad.
    """
    estimate = {
        'learning.initial_estimate': (factor * P).tolist(),
        'learning.weight': 0.0,
    }
    rig = Rig(
        estimate | {'safety.torque': 'hold_gravity'},
        plant={'disturbance.constant': [0.0, 0.0]},
    )
    rig.step(500)
    assert (np.abs(rig.state().dq) > 0.1).all()
    rig.deliver(b'')
    lacking = weight(rig.state().q) * (
        1.0 - factor
    )  # gravity, from the first torque on
    np.testing.assert_allclose(rig.guard.safe_torque.load, lacking, atol=1.0)
    start = rig.state().q
    rig.step(3000)
    assert rig.supervisor.phase is Phase.SAFE_STOP
    assert np.abs(rig.state().q - start).max() < angle
    assert np.abs(rig.state().dq).max() < 0.02
    np.testing.assert_allclose(rig.commands[-1], weight(rig.state().q), atol=0.15)
    observed = rig.guard.safe_torque.load.copy()
    rig.guard.deactivate()  # which goes on to hold it
    np.testing.assert_array_equal(rig.guard.safe_torque.load, observed)


def test_stopped_arm_is_held_by_what_was_learned():
    """The initial estimate is half of the truth, which is known by now."""
    given = {'safety.torque': 'hold_gravity', 'safety.stop_ramp': 0.0}
    rig = Rig(given, plant={'disturbance.constant': [0.0, 0.0]})
    rig.step(200)
    rig.guard.estimates.estimate[:3] = P
    needed = weight(rig.state().q)
    unlearned = rig.guard.held.load_before_learning()
    np.testing.assert_allclose(unlearned, 0.5 * needed, atol=1.0)
    np.testing.assert_allclose(rig.guard.fail('why'), needed, atol=1.0)
    carried = rig.guard.safe_stop.carried(rig.config.safety)  # after a reset
    np.testing.assert_allclose(carried, 0.5 * needed, atol=1.0)


def test_safe_torque_follows_what_the_law_finds_of_rotors_and_encoders():
    guard = Guard(ControllerConfig())
    found, used = guard.controller, guard.safe_torque
    for law, stop in (
        (found.state.rotors.gain_scale, used.scale),
        (found.checks.sensor.noise[:2], used.noise),
        (found.checks.sensor.resolution, used.resolution),
    ):
        law[:] = 0.25
        assert (stop == 0.25).all()


def test_deactivated_arm_is_held_although_its_model_is_wrong():
    """From the first torque on, by the load that its last motion shows."""
    half = {'learning.initial_estimate': (0.5 * P).tolist(), 'learning.weight': 0.0}
    rig = Rig(
        half | {'safety.torque': 'hold_gravity'},
        plant={'disturbance.constant': [0.0, 0.0]},
    )
    rig.step(500)
    rig.guard.deactivate()
    lacking = 0.5 * weight(rig.state().q)
    assert np.abs(lacking).min() > 1.0
    np.testing.assert_allclose(rig.guard.safe_torque.load, lacking, atol=1.0)


def test_load_is_bounded_and_left_as_it_is_while_brakes_hold_the_arm():
    """Without motion, the commanded torque says nothing about the load."""
    ramp = SafeTorque(2)
    safety = Safety(torque='hold_gravity', damping=(1.0, 1.0))
    ramp.commanded[:] = ramp.last.q[:] = 0.0
    ramp.begin_ramp(0.0, np.array([15.0, -2.0]))
    measurement = np.concatenate((Q, np.zeros(4)))
    ramp.last.take(1, measurement, np.zeros(2))
    for k in range(2, 300):
        ramp.last.take_usable(k * MILLISECOND, measurement, 50.0, 1e-3)
        torque = ramp.advance(safety, settings(), 0.1 * P, 1e-3)
    load = [10.0, -2.0]  # half of the limit of 20 N m
    # the first torque before it was zero
    np.testing.assert_allclose(ramp.load, load, atol=0.1)
    np.testing.assert_allclose(torque, 0.1 * weight(Q) + load, atol=0.1)


def test_arm_yields_to_a_contact_only_until_the_next_ramp():
    """It gives way by the torque that holds gravity, whatever is configured."""
    ramp = SafeTorque(2)
    ramp.last.take(1, np.concatenate((Q, np.zeros(4))), np.zeros(2))

    def torque():
        return ramp.advance(Safety(torque='zero'), settings(), P, 1e-3)

    assert not torque().any()  # also before the first ramp
    ramp.begin_ramp(0.0, np.zeros(2))
    ramp.yield_to_contact()
    np.testing.assert_allclose(torque(), weight(Q))
    assert not ramp.carries
    ramp.begin_ramp(0.0, np.zeros(2))
    assert not torque().any()
    assert ramp.carries


def test_single_jerk_changes_the_observed_load_by_what_a_torque_at_the_limit_would():
    """Within 1 ms by 20 N m through lags of 60 and 30 1/s, however large the acceleration."""
    ramp = SafeTorque(2)
    ramp.last.take(1, np.concatenate((Q, np.zeros(4))), np.zeros(2))
    ramp.last.ddq = np.array([1e5, -1e5])
    ramp.observe(settings(), P, 1e-3)
    np.testing.assert_allclose(np.abs(ramp.load), 20.0 * 0.06 * 0.03)


@pytest.mark.parametrize(('last', 'speeds_up'), [(0.8, False), (2.3, True)])
def test_arm_that_was_fast_at_the_stop_speeds_up_only_if_it_gets_faster(
    last, speeds_up
):
    """At a stop from 0.8 rad/s, from 2 * 0.8 + 0.5 rad/s on."""
    guard = Guard(change(ControllerConfig(), {'safety.torque': 'damping'}))
    guard.starting.activate()
    q = np.array([0.3, -0.4])
    for k in range(700):
        if k == 100:
            guard.fail('a test')
        dq = np.full(2, 0.8 if k < 100 else last)
        q += 1e-3 * dq
        stamp = (1000 + k) * MILLISECOND
        guard.update(stamp, np.concatenate((q, dq, np.zeros(2))))
    assert ('speeds up in the safe stop' in guard.supervisor.text) == speeds_up


def test_arm_that_falls_after_a_refused_start_is_told_to_be_without_a_torque():
    guard = Guard(change(ControllerConfig(), {'safety.torque': 'damping'}))
    guard.starting.activate()
    guard.supervisor.stop(Reason.START_REJECTED, 'a test')
    for k in range(400):
        q = np.array([0.3 + 1.5e-3 * k, -0.4])
        state = np.concatenate((q, [1.5, 0.0], np.zeros(2)))
        assert guard.update((1000 + k) * MILLISECOND, state) is None
    assert 'speeds up while nothing is commanded' in guard.supervisor.text


def test_torque_continues_after_immediate_reactivation():
    rig = Rig({'safety.deactivation_ramp': 10.0})
    rig.step(200)
    before = rig.commands[-1]
    rig.guard.deactivate()
    rig.step(1)
    rig.guard.starting.activate()
    rig.step(100)
    assert rig.supervisor.phase is Phase.TRACKING
    # The surface filter restarts: that changes the torque of 9 N m by K_p = 60 N m
    # s/rad times the few mrad/s that it lagged behind.
    assert np.abs(rig.commands[201] - before).max() < 0.3
    assert rig.guard.samples.ratio.max() < 0.5


@pytest.mark.parametrize('again', ['activate', 'reset'])
def test_rate_limit_applies_from_the_torque_before_an_activation(again):
    """The safe torque is zero and gravity takes 12 N m: it is approached at the rate limit."""
    rate = np.array([1000.0, 300.0])
    rig = Rig({'torque.rate_limit': rate.tolist(), 'safety.deactivation_ramp': 0.0})
    rig.step(200)
    rig.guard.deactivate()
    rig.step(12)
    assert not rig.commands[-1].any()
    steps = np.abs(np.diff(rig.commands[-13:], axis=0))
    assert (steps <= rate * 1e-3 * (1.0 + 1e-12)).all()
    rig.guard.starting.activate() if again == 'activate' else rig.guard.starting.reset()
    rig.step(12)
    steps = np.abs(np.diff(rig.commands[-13:], axis=0))
    assert (steps <= rate * 1e-3 * (1.0 + 1e-12)).all()
    np.testing.assert_allclose(steps[0], rate * 1e-3)
    assert rig.guard.controller.state.saturation.rate_cuts.min() >= 1.0
    # The law learns from what was commanded.
    np.testing.assert_array_equal(rig.guard.controller.state.torque, rig.commands[-1])


@pytest.mark.parametrize('again', ['activate', 'reset'])
def test_estimates_are_kept_over_an_activation_and_forgotten_by_a_reset(again):
    rig, keep = Rig(), again == 'activate'
    rig.step(200)
    state = rig.guard.controller.state
    learned = state.estimate.copy()
    window = state.window.rows[0]
    rig.guard.deactivate()
    getattr(rig.guard.starting, again)()
    start = rig.guard.controller.settings.initial_estimate
    np.testing.assert_array_equal(state.estimate, learned if keep else start)
    assert state.window.rows[0] == (window if keep else 0.0)
    assert not np.array_equal(learned, start)
    rig.step()
    assert (
        rig.guard.reference.time > 0.1
    ) == keep  # an empty window fills from t = 0 on


def test_estimates_before_a_fault_are_kept_but_not_the_window():
    # exceeded during the motion, without saturation
    rig = Rig({'safety.error_ratio': 0.35})
    seen = []
    while rig.supervisor.reason is Reason.NONE:
        seen.append(rig.guard.controller.state.estimate.copy())
        rig.step()
    assert rig.supervisor.reason is Reason.OUTSIDE_BOUND
    start = rig.guard.controller.settings.initial_estimate
    learned = rig.guard.estimates.estimate.copy()
    disturbance = rig.guard.estimates.disturbance.copy()
    assert disturbance.any()
    at = np.flatnonzero((np.array(seen) == learned).all(axis=1))
    assert at.size
    assert at[-1] < len(seen) - 1  # from before the error grew
    for other in (start, rig.guard.controller.state.estimate):
        assert not np.array_equal(other, learned)
    rig.guard.deactivate()
    rig.guard.starting.activate()
    controller = rig.guard.controller
    kept = controller.save()
    controller.reset()  # nothing else of the state survives
    controller.state.estimate[:] = learned
    controller.state.disturbance[:] = disturbance
    np.testing.assert_array_equal(kept, controller.state_vector)


def test_limit_changed_at_run_time_stops_the_arm_and_its_reference_begins_anew():
    """A deactivated law resumes along its reference, a stopped one does not."""
    rig = Rig()
    rig.step(200)
    rig.guard.deactivate()
    rig.guard.starting.activate()
    rig.step(50)
    assert rig.guard.reference.time > 0.2
    rig.guard.retune(change(rig.guard.config, {'safety.error_ratio': 1e-3}))
    rig.step()
    assert rig.supervisor.reason is Reason.OUTSIDE_BOUND
    rig.guard.retune(rig.config)
    rig.guard.starting.activate()
    rig.step(5)
    assert rig.supervisor.running
    assert rig.guard.reference.time < 0.01


def test_reactivation_restarts_the_surface_filter_at_the_current_state():
    """On the law's first sample alpha2 = beta2, not the value from an earlier motion."""
    rig = Rig()
    rig.step(1500)
    rig.guard.deactivate()
    rig.plant.state[3:5] = 0.0
    rig.guard.starting.activate()
    assert rig.guard.controller.samples == 0
    rig.step(1)
    # rad/s; it was at 0.3 rad/s
    assert np.abs(rig.guard.controller.sample.xi2).max() < 1e-3


def test_learning_waits_for_a_full_window_after_a_reset_in_motion():
    rig = Rig({'learning.window': 0.5, 'learning.excitation_threshold': 1e-9})
    rig.step(1200)
    state = rig.guard.controller.state
    assert state.latch.latched[0] == 1.0
    rig.guard.starting.reset()
    rig.step(999)  # the window and the settling time of the filters
    assert rig.guard.supervisor.running
    assert state.latch.latched[0] == 0.0
    rig.step(20)
    assert state.latch.latched[0] == 1.0


NEW_GAINS = [
    {'feedback.gain': (120.0, 40.0)},
    {'surface.gain': (300.0, 75.0)},
    {'surface.mu': (40.0, 10.0)},
    {'barrier.weight': (5000.0, 200.0)},
    {'barrier.bound': (0.004, 0.0015)},
]


def jump(given, *, bumpless, samples):
    """Largest change of a torque after a gain change, at the largest error of the start."""
    rig = Rig()
    rig.step(60)
    candidate = change(rig.guard.config, given)
    if bumpless:
        assert rig.guard.problems(candidate) == []
        rig.guard.retune(candidate)
    else:
        apply(rig.guard.controller, candidate)
    rig.step(samples)
    return np.abs(np.array(rig.commands[-samples:]) - rig.commands[-samples - 1]).max()


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
    usual = jump({}, bumpless=True, samples=samples)
    assert jump(given, bumpless=False, samples=samples) > 4.0 * usual
    assert jump(given, bumpless=True, samples=samples) < most * usual


EXCITED = {
    'learning.window': 0.2,
    'learning.excitation_threshold': 1e-12,
    'learning.settling_time': 0.0,
}


@pytest.mark.parametrize(
    ('start', 'given', 'message'),
    [
        ({}, {'barrier.bound': (1e-6, 0.002)}, 'barrier.bound: joint1 is'),
        # 2.675 N m
        ({}, {'torque.limit': (20.0, 2.6)}, 'torque.limit: joint2 is held with'),
        ({}, {'learning.radius': 0.58}, 'learning.radius: the norm of the estimate is'),
        # Gradient: kappa Gamma lambda_max T >= 2; here kappa is 100 and lambda_max
        # about 100.
        (
            EXCITED | instead(),
            {'gains.update': 'gradient'},
            'learning.weight: the gradient step',
        ),
        (
            EXCITED | instead(),
            {'gains.update': 'gradient', 'learning.weight': 2.0},
            '',
        ),
    ],
)
def test_gains_that_a_running_law_cannot_adopt_are_rejected(start, given, message):
    rig = Rig(start)
    rig.step(400 if start else 200)
    assert rig.guard.controller.state.latch.latched[0] == bool(start)
    candidate = change(rig.guard.config, given)
    signals = rig.guard.controller.signals_vector.copy()
    found = rig.guard.problems(candidate)
    assert [problem.startswith(message) for problem in found] == [True] * bool(message)
    np.testing.assert_array_equal(rig.guard.controller.signals_vector, signals)
    rig.guard.deactivate()
    assert rig.guard.problems(candidate) == []


def test_gains_can_change_while_the_projection_holds_the_estimate():
    rig = Rig({'learning.radius': 0.7})
    rig.step(200)
    estimate = rig.guard.controller.state.estimate
    estimate[:] *= np.nextafter(0.7, 1.0) / np.linalg.norm(estimate)
    assert np.linalg.norm(estimate) > 0.7
    assert (
        rig.guard.problems(change(rig.guard.config, {'feedback.gain': (60.0, 25.0)}))
        == []
    )


def test_trial_that_cannot_be_made_leaves_the_checks_on():
    law = Rig().guard.controller
    limit = law.checks.velocity_limit[0]
    with pytest.raises(BlfDscError, match='positions, velocities and torques'):
        law.trial(0.0, 1e-3, np.zeros(3))
    assert law.checks.velocity_limit[0] == limit > 0.0


def test_plan_keeps_one_in_force_that_has_not_begun():
    """Two within the lead of the first: the reference continues until each of them begins."""
    rig = Rig()
    rig.step(100)
    to = Trajectory(JOINTS, (TrajectoryPoint(1.0, (2.1, 1.5)),))
    guard = rig.guard
    running = guard.controller.reference_at
    times = guard.reference.time + np.linspace(0.001, 0.02, 20)
    before = [running(t) for t in times]
    guard.motions.adopt(guard.motions.plan(to, guard.reference.time + 0.02))
    rig.step(10)
    guard.motions.adopt(guard.motions.plan(to, guard.reference.time + 0.02))
    np.testing.assert_allclose([running(t) for t in times], before, atol=1e-12)
    rig.step(1200)
    assert rig.supervisor.phase is Phase.TRACKING
    guard.motions.adopt(guard.motions.plan(to))
    assert len(unpack(guard.controller.reference_vector)) == 1  # the past is forgotten


def test_arm_approaches_a_motion_that_begins_later_and_then_tracks_it():
    rig = Rig()
    rig.step(1500)
    assert rig.supervisor.phase is Phase.TRACKING
    to = Trajectory(JOINTS, (TrajectoryPoint(1.0, (2.1, 1.5)),))
    begin = rig.guard.reference.time + 0.3
    plan = rig.guard.motions.plan(to, begin)
    assert plan.motion.settled >= begin
    rig.guard.motions.adopt(plan)
    assert rig.supervisor.phase is Phase.APPROACHING
    T = rig.guard.config.sample_time
    rig.step(round((plan.motion.settled - rig.guard.reference.time) / T) - 1)
    assert rig.supervisor.phase is Phase.APPROACHING
    rig.step(2)
    assert rig.supervisor.phase is Phase.TRACKING


def test_plan_is_followed_from_its_start_unless_late_or_from_a_replaced_reference():
    rig = Rig()
    rig.step(100)
    to = Trajectory(JOINTS, (TrajectoryPoint(1.0, (2.1, 1.5)),))
    late, replaced, plan = (
        rig.guard.motions.plan(to, rig.guard.reference.time + lead)
        for lead in (0.01, 0.03, 0.03)
    )
    before = rig.guard.controller.reference_at(plan.at)
    rig.step(20)
    with pytest.raises(LatePlanError):
        rig.guard.motions.adopt(late)
    rig.guard.motions.adopt(plan)
    with pytest.raises(TrajectoryError, match='replaced while it was planned'):
        rig.guard.motions.adopt(replaced)
    np.testing.assert_allclose(
        rig.guard.controller.reference_at(plan.at), before, atol=1e-12
    )
    rig.step(1200)
    np.testing.assert_allclose(
        rig.guard.controller.reference_at(rig.guard.reference.time)[0], (2.1, 1.5)
    )
    assert rig.supervisor.phase is Phase.TRACKING


def test_trajectory_in_the_sample_of_a_stop_continues_from_there():
    rig = Rig()
    rig.step(100)
    away = Trajectory(JOINTS, (TrajectoryPoint(1.0, (2.1, 1.5)),))
    rig.guard.motions.adopt(rig.guard.motions.plan(away))
    rig.step(200)
    rig.guard.motions.brake()
    before = rig.guard.controller.reference_at(rig.guard.reference.time)
    rig.guard.motions.adopt(rig.guard.motions.plan(away))
    after = rig.guard.controller.reference_at(rig.guard.reference.time)
    np.testing.assert_allclose(after[:2], before[:2], atol=1e-12)
    rig.step(1500)
    assert rig.supervisor.phase is Phase.TRACKING


def test_retuning_leaves_the_estimate_of_a_joint_without_integrator():
    """A gain of 0 says that its disturbance is not estimated: the torque of that joint steps."""
    config = change(ControllerConfig(), {'disturbance.gain': [0.0, 100.0]})
    law = controller_of(config)
    measurement = np.array([2.2935, 1.6961, 0.1, 0.1, 0.0, 0.0])
    for k in range(2):
        law.update(k * 1e-3, 1e-3, measurement)
    before = law.state.disturbance.copy()
    gains = {'feedback.gain': [30.0, 10.0]}
    apply_bumpless(law, change(config, gains), 1e-3, measurement)
    moved = law.state.disturbance != before
    assert moved.tolist() == [False, True]


def test_samples_past_the_bound_are_counted_where_they_do_not_stop_the_arm():
    rig = Rig({'safety.error_ratio': 0.0})
    rig.push = np.array([10.0, 0.0])
    rig.step(60)
    assert rig.supervisor.running
    assert 0 < rig.guard.samples.outside < 60


def test_law_without_a_barrier_is_not_stopped_by_its_bound():
    rig = Rig({'law': 'backstepping'})
    rig.push = np.array([40.0, 0.0])  # past the torque limit, too
    rig.step(60)
    assert rig.supervisor.running
    assert rig.guard.samples.ratio[0] > 1.0
    assert rig.guard.samples.saturated > 0


def test_states_of_a_run_relieve_saturation_as_those_that_come_one_by_one():
    """A quarter of their time: as of a compiled run, whose states were all checked."""
    rig = Rig({'law': 'backstepping', 'safety.saturation_time': 10.0})
    rig.push = np.array([40.0, 0.0])
    rig.step(60)
    guard, T, k = rig.guard, rig.guard.config.sample_time, 20
    before = guard.samples.saturated_time
    assert before > 0.25 * k * T
    stamps = guard.reference.last_stamp + guard.config.sample_time_ns * np.arange(
        1, k + 1
    )
    measurements = np.tile(guard.safe_torque.last.measurement, (k, 1))
    guard.advance(stamps, measurements, np.zeros((k, 2)))
    assert guard.samples.saturated_time == pytest.approx(before - 0.25 * k * T)


def test_stop_names_both_rates_where_the_states_come_at_another():
    rig = Rig({'safety.overrun_fraction': 1.0})
    sparse(3)(rig)
    rig.step(30)
    rig.push = np.array([40.0, 0.0])
    rig.step(60)
    assert rig.supervisor.reason is Reason.OUTSIDE_BOUND
    assert (
        'joint states come every 0.003 s, but sample_time is 0.001 s'
        in rig.supervisor.text
    )


def test_commands_without_effect_stop_the_arm_with_the_model_from_before():
    """Brakes, or an inactive effort controller: the law would learn its own commands."""
    learned = {'learning.initial_estimate': P.tolist(), 'safety.torque': 'hold_gravity'}
    rig = Rig(learned, plant={'disturbance.amplitude': [0.0, 0.0]})
    rig.step(40)
    before = rig.guard.estimates.estimate.copy()
    jammed(rig)
    rig.step(500)
    assert rig.supervisor.reason is Reason.NO_EFFECT
    assert (
        'release the brakes, and activate the effort controller' in rig.supervisor.text
    )
    np.testing.assert_allclose(rig.guard.estimates.estimate, before, rtol=1e-3)
    state = rig.state()
    rig.sense = lambda state: [state.raw()]  # the brakes open
    rig.step(1000)
    assert np.abs(rig.state().q - state.q).max() < 0.025  # while the load is observed


@pytest.mark.parametrize(('effort', 'stops'), [('unknown', False), ('commanded', True)])
def test_constant_command_that_does_not_reach_the_arm_shows_only_in_its_effort(
    effort, stops
):
    """An inactive effort controller, on an arm that its drives hold."""
    hold = {'reference.type': 'hold', 'learning.initial_estimate': P.tolist()}
    rig = Rig(
        hold | {'robot.effort': effort}, plant={'disturbance.amplitude': [0.0, 0.0]}
    )
    rig.step(100)
    assert rig.supervisor.running
    q = rig.state().q
    rig.sense = lambda state: [state.raw(q=q, dq=np.zeros(2), effort=np.zeros(2))]
    rig.step(300)
    assert rig.supervisor.running != stops
    assert ('lacks' in rig.supervisor.text) == stops


def test_arm_that_stands_still_under_noise_is_named_but_not_taken_for_braked():
    """Coarse encoders make the torque chatter although nothing moves."""
    hold = {'reference.type': 'hold', 'learning.initial_estimate': P.tolist()}
    rig, quiet = Rig(hold), Rig(hold)
    rng = np.random.default_rng(0)
    rig.sense = lambda state: [state.raw(dq=state.dq + 0.04 * rng.normal(size=2))]
    for each in (rig, quiet):
        each.step(2000)
        assert each.supervisor.phase is Phase.TRACKING, each.supervisor.text
    steps = np.diff(rig.commands, axis=0)[-1000:]
    assert np.abs(steps).max() > 2.0  # a tenth of the limit
    measured = np.sqrt(rig.guard.controller.checks.effect.chatter)
    assert measured == pytest.approx(np.sqrt((steps**2).mean(axis=0)), rel=0.2)
    assert 'joint1 changes by' in chatter_of(rig.guard.controller, rig.guard.config)
    assert chatter_of(quiet.guard.controller, quiet.guard.config) == ''


def test_estimates_are_discarded_by_a_reset_at_once():
    """The safe torque between a reset and the next start must not be that of what it discards."""
    rig = Rig({'safety.torque': 'hold_gravity'})
    rig.step(300)
    initial = rig.guard.controller.settings.initial_estimate
    assert rig.guard.estimates.disturbance.any()
    rig.guard.starting.reset()
    np.testing.assert_array_equal(rig.guard.estimates.estimate, initial)
    assert not rig.guard.estimates.disturbance.any()


def test_velocity_limit_changed_at_run_time_holds_from_the_next_state_on():
    rig = Rig()
    rig.step(100)
    speed = np.abs(rig.state().dq).max()
    safety = {'safety.velocity_limit': 0.5 * float(speed)}
    rig.guard.retune(change(rig.config, safety))
    rig.step()
    assert rig.supervisor.reason is Reason.VELOCITY


@pytest.mark.parametrize(
    ('gap', 'missed'), [(1.0, 0), (1.4, 0), (1.6, 1), (1.9, 1), (2.1, 1), (2.9, 2)]
)
def test_gap_counts_to_the_nearest_number_of_missed_states(gap, missed):
    check = StateCheck(('joint1', 'joint2'), (TURNING, TURNING), 1e-3)
    safety = ControllerConfig().safety
    assert check.check(safety, 10**9) is None
    assert check.check(safety, 10**9 + round(gap * 10**6)) is None
    assert check.missed == missed


def test_acceleration_is_unknown_after_a_missed_state():
    """Else it would count again and again, as if the arm went on accelerating."""
    last = LastState(2)
    for k in range(3):
        state = np.array([k * k * 1e-3, 0.0, 2e-3 * k, 0.0, 0.0, 0.0])
        last.take_usable(10**9 + k * 10**6, state, 50.0, 1e-3)
    assert last.ddq is not None
    last.miss(1e-3)
    assert last.ddq is None
    assert not last.dq.any()


def test_state_after_a_silence_shows_its_measured_velocity_and_no_acceleration():
    last = LastState(2)
    last.take_usable(10**9, np.array([0.0, 0.0, 0.5, 0.5, 0.0, 0.0]), 50.0, 1e-3)
    later = np.array([0.1, 0.1, 0.7, -0.2, 0.0, 0.0])
    last.take_usable(10**9 + 10**8, later, 50.0, 1e-3)
    assert last.ddq is None
    assert last.slow.tolist() == [0.7, -0.2]


def test_velocity_of_positions_that_jump_is_within_its_limit():
    last = LastState(2)
    last.take_usable(10**9, np.zeros(6), 50.0, 1e-3)
    jumped = np.array([1.0, -1.0, np.nan, np.nan, 0.0, 0.0])
    last.take_usable(10**9 + 10**6, jumped, 50.0, 1e-3)
    assert last.dq.tolist() == [50.0, -50.0]


@pytest.mark.parametrize(('stamp', 'q'), [(10**9, 0.2), (10**9 + 10**6, np.nan)])
def test_positions_that_show_no_arm_leave_the_last_ones_and_no_velocity(stamp, q):
    """Those with the stamp of the state before, and those that are not finite."""
    last = LastState(2)
    state = np.array([0.1, 0.3, 0.5, 0.5, 0.0, 0.0])
    last.take_usable(10**9, state, 50.0, 1e-3)
    last.take_usable(stamp, np.array([q, *state[1:]]), 50.0, 1e-3)
    assert last.q.tolist() == [0.1, 0.3]
    assert not last.dq.any()
    assert last.age == 1e-3


def test_clock_that_is_set_is_named_instead_of_the_error_it_makes():
    """By 35 ms, which safety.state_timeout allows: the reference would jump by 10 mrad."""
    rig = Rig(live=True)
    rig.step(1000)
    rig.base += 35 * 10**6
    rig.step(2)
    assert rig.supervisor.reason is Reason.STAMP_JUMP
    assert 'the clock was set' in rig.supervisor.text


@pytest.mark.parametrize(
    ('speed', 'share', 'gap', 'is_set'),
    [
        (0.021, 0.0, 0.035, True),
        (0.019, 0.0, 0.035, False),  # noise
        (0.5, 0.49, 0.035, True),
        (0.5, 0.51, 0.035, False),
        (0.5, 0.0, 0.0026, True),
        (0.5, 0.0, 0.0024, False),  # less than the law notices
    ],
)
def test_clock_was_set_if_a_moving_arm_has_moved_for_less_than_half_the_gap(
    speed, share, gap, is_set
):
    """`share` is the part of `gap` [s] for which it moved at its `speed` [rad/s]."""
    dq = np.array([0.6, -0.8]) * speed
    fault = StateCheck(JOINTS, (TURNING, TURNING), 1e-3).clock_step(
        gap, share * gap * dq, dq
    )
    assert (fault is not None) == is_set


def test_arm_that_was_braked_in_a_gap_is_no_step_of_the_clock():
    """It has moved for less than the gap, at its mean velocity, since it has stood."""
    rig = Rig(live=True)
    rig.step(1000)
    before = rig.state()
    rig.base += 35 * 10**6
    rig.sense = lambda state: [state.raw(q=before.q, dq=0.1 * before.dq)]
    rig.step()
    assert 'the clock was set' not in rig.supervisor.text


@pytest.mark.parametrize('what', ['q', 'dq'])
def test_what_is_not_finite_after_a_gap_is_no_step_of_the_clock(what):
    rig = Rig(live=True)
    rig.step(1000)
    rig.base += 35 * 10**6
    rig.sense = lambda state: [state.raw(**{what: np.full(2, np.nan)})]
    rig.step()
    assert rig.supervisor.reason is Reason.NOT_FINITE


def test_start_that_was_planned_before_other_limits_is_planned_again():
    away = {'initial.position': [2.0, 1.5]}
    rig = Rig(plant=away)
    rig.guard.starting.prepare(rig.state().q)
    slower = {'limits.acceleration': (1.0, 1.0)}  # rad/s^2
    rig.guard.retune(change(rig.config, slower))
    rig.step()
    assert rig.supervisor.running
    planned = rig.guard.reference.settled
    rig = Rig(slower, plant=away)
    rig.step()
    assert planned == rig.guard.reference.settled


def test_stop_after_a_gap_begins_at_the_torque_that_acts():
    """Another node, such as the watchdog, may have commanded it meanwhile."""
    rig = Rig({'robot.effort': 'whole', 'safety.stop_ramp': 1.0})
    rig.step(1000)
    rig.sense = lambda _: []
    rig.step(100)
    acting = np.array([7.0, -7.0])  # N m
    rig.sense = lambda state: [state.raw(effort=acting)]
    rig.step()
    assert rig.supervisor.reason is Reason.STAMP_JUMP
    # a tenth of the ramp is over: the time of the gap has passed
    np.testing.assert_allclose(rig.commands[-1], 0.9 * acting, atol=0.1)


def test_arm_that_is_not_seen_is_not_known_to_rest():
    ramp = SafeTorque(2)
    ramp.last.take(1, np.zeros(6), np.zeros(2))
    assert ramp.is_settled
    ramp.last.miss(1e-3)
    assert not ramp.is_settled


def test_arm_is_not_settled_before_its_ramp_is_over_nor_while_it_moves():
    ramp = SafeTorque(2)
    ramp.last.take(1, np.zeros(6), np.zeros(2))
    ramp.begin_ramp(0.5, np.zeros(2))
    settled = []
    for _ in range(5):
        settled.append(ramp.is_settled)
        ramp.advance(Safety(torque='damping'), settings(), P, 0.125)
    assert settled == [False] * 4 + [True]
    ramp.last.take(2, np.array([0.0, 0.0, 0.0, -0.1, 0.0, 0.0]), np.zeros(2))
    assert not ramp.is_settled


def test_joint_that_passes_for_a_light_one_keeps_half_of_its_damping():
    """As an elastic one does that oscillates; a heavier one gets more."""
    ramp = SafeTorque(2)
    ramp.scale[:] = 0.1, 2.0
    ramp.last.take(1, np.zeros(6), np.array([1.0, -1.0]))
    safety = Safety(torque='damping', damping=(2.0, 1.0))
    torque = ramp.advance(safety, settings(), P, 0.0)
    np.testing.assert_allclose(torque, [-0.5 * 2.0, 2.0 * 1.0])


@pytest.mark.parametrize('torque', ['zero', 'damping', 'hold_gravity'])
def test_only_a_torque_that_holds_carries_a_load(torque):
    rig = Rig({'safety.torque': torque})
    rig.step(200)
    rig.guard.fail('why')
    rig.step(2)
    load = rig.guard.safe_stop.carried(rig.config.safety)
    assert (load is not None) == (torque == 'hold_gravity')


def test_reference_begins_anew_after_a_stop_that_was_deactivated():
    """It has gone on: only that of a law which left command in order is resumed."""
    rig = Rig()
    rig.step(100)
    rig.guard.fail('why')
    rig.guard.deactivate()
    rig.guard.starting.activate()
    stamp = rig.state().stamp
    rig.step()
    assert rig.guard.reference.start_stamp == stamp


@pytest.mark.parametrize('way', ['fail', 'time_out'])
def test_stop_without_a_state_begins_at_the_last_command_also_after_a_gap(way):
    """The effort of the state after the gap is older."""
    rig = Rig({'robot.effort': 'whole', 'safety.stop_ramp': 0.1})
    rig.step(1000)
    rig.sense = lambda _: []
    rig.step(35)
    rig.sense = lambda state: [state.raw(effort=state.effort + 5.0)]
    rig.step()
    assert rig.supervisor.running, rig.supervisor.text
    before = rig.guard.commanded.copy()
    torque = getattr(rig.guard, way)('why')
    # N m: 8 ms of a ramp of 0.1 s, from 8.5 N m to none
    np.testing.assert_allclose(torque, before, atol=1.0)


def test_states_that_are_really_missed_are_no_step_of_the_clock():
    rig = Rig(live=True)
    rig.step(1000)
    rig.sense = lambda _: []
    rig.step(8)
    rig.sense = lambda state: [state.raw()]
    rig.step(20)
    assert rig.supervisor.phase is Phase.TRACKING, rig.supervisor.text


@pytest.mark.parametrize('shape', [(5,), (7,), (1,), (), (3, 2), (2, 6)])
def test_measurement_of_another_shape_is_rejected(shape):
    law = Guard(ControllerConfig()).controller
    with pytest.raises(BlfDscError, match=r'2 joints need \(6,\)'):
        law.update(0.0, 1e-3, np.zeros(shape))


def test_each_stop_counts_the_time_anew_for_which_the_arm_is_faster():
    """0.3 s is longer than 0.2 s; each stop says so once, also after one at a higher speed."""
    speed = StopSpeed()
    for at_stop in (0.0, 1.0, 0.0):
        speed.begin(at_stop)
        faster = 2.0 * at_stop + 0.51
        found = [speed.observe(faster, 0.1) for _ in range(4)]
        assert found == [False, False, True, False]


BREAKS = {
    'gap': (50 * MILLISECOND, 0.0),
    'earlier stamp': (-MILLISECOND, 0.0),
    'torque that is no number': (MILLISECOND, np.nan),
}


@pytest.mark.parametrize('what', [*BREAKS, 'restart'])
def test_load_by_the_last_motion_is_unknown_after_a_break(what):
    """Of an arm that stands still and carries 1 N m more than its model."""
    recent = RecentMotion(2, 1e-3)
    state = np.concatenate((Q, np.zeros(4)))
    for k in range(recent.size):
        assert recent.load(settings(), P) is None
        recent.take((1 + k) * MILLISECOND, state, weight(Q) + 1.0)
    np.testing.assert_allclose(recent.load(settings(), P), 1.0)
    if what == 'restart':
        recent.restart()
    else:
        later, torque = BREAKS[what]
        stamp = recent.size * MILLISECOND + later
        recent.take(stamp, state, np.full(2, torque))
        recent.take(stamp + MILLISECOND, state, weight(Q))
    assert recent.load(settings(), P) is None


def test_load_known_at_the_stop_is_that_of_the_last_ramp():
    ramp = SafeTorque(2)
    for load in ([1.0, -2.0], [3.0, 0.5]):
        ramp.begin_ramp(0.0, np.array(load))
        ramp.load[:] = 9.0  # observed since
        ramp.stop_observing()
        np.testing.assert_array_equal(ramp.load, load)


@pytest.mark.parametrize(('settled', 'expected'), [(5.0, 2.0), (1.0, 1.0)])
def test_approach_is_over_once_another_reference_is_followed(settled, expected):
    controller = controller_of(ControllerConfig())
    reference = RunningReference(controller)
    reference.start_stamp, reference.last_stamp = 0, 2000 * MILLISECOND
    reference.settled = settled
    reference.follow(controller.reference_vector)
    assert reference.settled == pytest.approx(expected)


AFTER_WINDING_UP = {
    Reason.OUTSIDE_BOUND,
    Reason.SATURATED,
    Reason.VELOCITY,
    Reason.CONTACT,
    Reason.OSCILLATION,
    Reason.NO_EFFECT,
}


@pytest.mark.parametrize('reason', list(Reason))
@pytest.mark.parametrize('gap', [False, True])
def test_stop_that_winds_the_estimates_up_holds_with_those_from_before(reason, gap):
    """Unless the states had a gap: then the torque that holds the arm shows its load."""
    stop = SimpleNamespace(
        _held=SimpleNamespace(
            command=lambda: None,
            after_gap=np.zeros(2) if gap else None,
            load=lambda: 'of the torque that holds it',
        ),
        _estimates=SimpleNamespace(disturbance='from before'),
    )
    winds_up = reason in AFTER_WINDING_UP and not gap
    expected = 'from before' if winds_up else 'of the torque that holds it'
    assert SafeStop._load_at_stop(stop, reason) == expected


@pytest.mark.parametrize('reason', list(Reason))
@pytest.mark.parametrize('oscillates', [False, True])
def test_load_is_observed_in_a_stop_unless_its_cause_may_be_commands_that_do_not_arrive(
    reason, oscillates
):
    """Of an arm that oscillates they do: else it would not."""
    guard = Guard(ControllerConfig())
    safety = guard.config.safety
    guard.safe_stop.begin(safety, reason, 0.0, was_running=False, oscillates=oscillates)
    unreached = {Reason.OUTSIDE_BOUND, Reason.SATURATED, Reason.NO_EFFECT}
    assert guard.safe_torque.carries == (reason not in unreached or oscillates)


@pytest.mark.parametrize('torque', ['zero', 'damping', 'hold_gravity'])
def test_arm_that_nothing_holds_may_speed_up(torque):
    """Else the load that was known before holds it again."""
    guard = Guard(ControllerConfig())
    safety = Safety(torque=torque)
    stop = guard.safe_stop
    stop.begin(safety, Reason.FAILED, 0.0, was_running=False, oscillates=False)
    found = [stop.observe_speed(safety, 1.0, 0.1) for _ in range(4)]
    assert any(found) == (torque != 'zero')
    assert guard.safe_torque.carries == (torque == 'zero')


@pytest.mark.parametrize('is_withdrawn', [False, True])
def test_reset_carries_nothing_on_once_another_program_has_taken_command(is_withdrawn):
    rig = Rig({'safety.torque': 'hold_gravity'})
    rig.step(200)
    rig.guard.fail('why')
    rig.step(2)
    if is_withdrawn:
        rig.guard.withdraw('the robot stopped by itself')
    rig.guard.starting.reset()
    assert (rig.guard.starting._takeover.carried is None) == is_withdrawn
