# SPDX-License-Identifier: Apache-2.0
"""Each single fault is flagged, and no torque is commanded that depends on an unusable state."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from fault_table import FAST, FAULTS, R, Rig, named, outcome_of, page
from plain_law import dynamics
from scenario import Scenario, changed

import blf_dsc_controller as blf

LIMIT = 20.0  # N m, the default torque limit


@pytest.mark.parametrize(
    'number', range(len(FAULTS)), ids=lambda number: FAULTS[number].name
)
def test_fault_is_detected_and_named_and_the_loop_recovers(number):
    fault, outcome = FAULTS[number], outcome_of(number)

    assert outcome.reason is fault.reason, outcome.text
    for commands in (outcome.before, outcome.after):
        assert np.isfinite(commands).all()
        assert (np.abs(commands) <= LIMIT).all()
    # A controller that never started stays silent.
    assert len(outcome.after)
    if fault.reason is R.NONE:
        assert outcome.noticed == -1
        assert outcome.error < 1.0
    else:
        assert 1 <= outcome.noticed <= fault.within
        assert outcome.text
        # The default safe torque is zero; above all, the last torque is not repeated.
        assert not outcome.after.any()
        assert outcome.last.all()
    assert outcome.recovered


def test_faults_cover_all_reasons_and_their_page_is_up_to_date():
    # a contact is no fault, and its stop a reaction that is chosen: see test_contact;
    # an oscillation is one of the gains: see test_supervision_oscillation; starts that
    # are refused: see test_nodes_start and test_drive
    others = {R.FAILED, R.CONTACT, R.OSCILLATION, R.START_REJECTED}
    assert {fault.reason for fault in FAULTS} == set(R) - others
    text = (Path(__file__).parents[1] / 'doc/faults.md').read_text()
    assert text == page(text), 'run: python test/fault_table.py doc/faults.md'


# What the law computed.


@pytest.mark.parametrize(('every', 'stops'), [(4, True), (6, False)])
def test_torques_at_the_limit_add_up_if_they_take_more_than_a_fifth_of_the_time(
    every, stops
):
    """Of an arm at rest whose measured velocity jumps, in one direction and the other."""
    given = {'reference.type': 'hold', 'safety.oscillation': 'ignore'}
    arm = Scenario('recommended', given | {'safety.saturation_time': 0.05})
    arm.run(0.5)
    seen = []

    def jump(state):
        seen.append(state)
        sign = 1.0 if len(seen) % (2 * every) == 0 else -1.0
        dq = state.dq + sign * 2.0 * (len(seen) % every == 0)
        return changed(dq=lambda _: dq)(state)

    after = arm.run(2.0, spoil=jump, until=lambda: not arm.is_running)
    at_limit = (np.abs(after.torque) == LIMIT).any(axis=1)
    assert at_limit.mean() == pytest.approx(1.0 / every, abs=0.05)
    assert (arm.reason == 'torque saturated') == stops
    assert ('needs ' in arm.text) == stops


def test_joint_that_lacks_torque_is_named_where_another_needs_and_has_more():
    limits = {'torque.limit': [LIMIT, 2.0], 'safety.saturation_time': 0.01}
    arm = Scenario('recommended', limits)
    arm.run(2.0, until=lambda: not arm.is_running)
    assert arm.reason == 'torque saturated', arm.text
    assert re.search(
        r"'joint2' needs .* N m and has been at its limit of 2 N m", arm.text
    )


@pytest.mark.parametrize(('preset', 'usual'), [('recommended', 1.8), ('fr3', 0.0)])
def test_effort_that_lacks_no_more_than_usual_does_not_explain_an_error(preset, usual):
    """Of drives whose efforts always lack 9 % of the limit, or that add gravity themselves."""
    torque = 0.0 * np.array(blf.load_loop(preset).controller.torque.limit)
    torque[1] = 150.0  # N m
    push = {
        'events.begin': [3.0],
        'events.duration': [0.0],
        'events.torque': torque.tolist(),
    }
    arm = Scenario(preset, {'robot.effort': 'whole'}, plant=push)
    short = changed(0, effort=lambda effort: effort - usual)
    after = arm.run(4.0, spoil=short, until=lambda: not arm.is_running)
    assert after.t[-1] > 3.0
    assert arm.reason == 'error past the bound', arm.text
    assert 'lacks' not in arm.text


def test_velocities_of_an_arm_that_measures_none_go_on_where_a_reading_is_repeated():
    """With a new stamp, as a driver does that is faster than its bus."""
    seen = []

    def repeat(state):
        seen.append(state)
        q = seen[-2].q if len(seen) % 7 == 0 else state.q
        return changed(q=lambda _: q, dq=lambda dq: np.nan * dq)(state)

    arm = Scenario('recommended', FAST | {'safety.velocity': 'estimated'})
    record = arm.run(3.0, spoil=repeat).since(1000)
    assert arm.is_running, arm.text
    is_fast = record.speed[1:].max(axis=1) > 0.5  # rad/s: slower ones may be at rest
    assert is_fast.mean() > 0.5
    assert np.abs(np.diff(record.torque, axis=0))[is_fast].max() < 0.5  # N m


# Without usable joint states.

HOLDING = {'safety.torque': 'hold_gravity'}
QUIET = {'disturbance.constant': [0.0, 0.0], 'disturbance.amplitude': [0.0, 0.0]}
P = np.array([1.0, 0.32, 0.4])
LEARNED = HOLDING | {'two_link.initial_estimate': P.tolist()}
NAN = np.full(2, np.nan)
FIRST = {
    'unreadable': lambda _: b'',
    'not finite': lambda state: state.raw(q=NAN, dq=NAN),
    'of other joints': lambda state: state.raw(named('joint1', 'joint3')),
}
NEVER = FIRST | {
    'too fast': lambda state: state.raw(dq=np.array([0.0, 60.0])),
    'without velocities': lambda state: state.raw(
        named('joint1', 'joint2', fields=('position', 'effort')), dq=[]
    ),
    'without a stamp': lambda state: state.raw(stamp=0),
}
UNUSABLE = FIRST | {'frozen': lambda state: state.raw(stamp=1_000_000_000)}


def moving(given):
    """Rig after half a second, when both joints are moving, without a disturbance."""
    rig = Rig(given, plant=QUIET)
    rig.step(500)
    assert (np.abs(rig.state().dq) > 0.1).all()
    return rig


@pytest.mark.parametrize('raw', NEVER.values(), ids=NEVER)
def test_controller_waits_silently_for_the_first_usable_state(raw):
    rig = Rig(HOLDING)
    for _ in range(3):
        assert rig.deliver(raw(rig.state())) is None
        assert rig.guard.starting.waiting_for
    assert (rig.supervisor.phase, rig.supervisor.stops) == (blf.Phase.STARTING, 0)
    rig.step(2)
    assert rig.supervisor.phase is blf.Phase.TRACKING
    assert not rig.guard.starting.waiting_for
    assert len(rig.commands) == 2


@pytest.mark.parametrize('raw', UNUSABLE.values(), ids=UNUSABLE)
def test_without_states_the_load_fades_to_the_gravity_of_the_model(raw):
    """That of where the arm was seen last, for ever, until states return."""
    rig = moving(LEARNED)
    good, seen = rig.sense, rig.state().q
    rig.sense = lambda state: [raw(state)]
    rig.step(40)  # until the last velocity is no longer damped
    first = len(rig.commands)
    rig.step(600)
    fading = np.array(rig.commands[first:])
    steps = np.diff(fading, axis=0)[:480]
    np.testing.assert_allclose(steps, steps[[0] * 480], atol=1e-9)  # a straight line
    np.testing.assert_array_equal(fading[-1], fading[-50])
    gravity = dynamics(P, 9.81, seen, np.zeros(2))[2]
    np.testing.assert_allclose(fading[-1], gravity, rtol=0.02)
    rig.sense = good
    rig.step(1)
    assert (np.abs(rig.commands[-1]) > 0.1).all()


@pytest.mark.parametrize('raw', UNUSABLE.values(), ids=UNUSABLE)
def test_outdated_velocity_is_not_damped(raw):
    rig = moving({'safety.torque': 'damping'})
    rig.sense = lambda state: [raw(state)]
    rig.step(40)  # damping that takes 30 ms to stop an arm reverses none in that time
    assert rig.supervisor.phase is blf.Phase.SAFE_STOP
    np.testing.assert_array_equal(rig.commands[-1], [0.0, 0.0])


@pytest.mark.parametrize('given', [np.nan, np.inf])
def test_missing_and_implausible_velocities_are_differenced_from_the_positions(given):
    """Also without a velocity, gravity is held and the motion damped."""
    arm = Scenario('recommended', LEARNED, plant=QUIET)
    arm.run(0.5)
    after = arm.run(1.0, spoil=changed(dq=lambda _: given))
    assert arm.reason in {'measurement not finite', 'velocity not plausible'}
    assert after.speed[-1].max() < 0.1  # a falling arm has several rad/s by then


def test_joint_that_is_really_too_fast_is_damped_most():
    """At its velocity limit: D is 2 and 1 N m s/rad."""
    given = {'safety.torque': 'damping', 'safety.velocity_limit': [1.0, 1.0]}
    arm = Scenario('recommended', given)
    start = arm.run(0.02).q[-1]
    q, dq = start, np.array([3.0, 0.1])
    for k in range(330):  # ten times the lag of what is damped, after 30 ms from rest
        now = min(1.0, k / 30) * dq
        q = q + 1e-3 * now
        torque = arm.controller.update(1.02 + 1e-3 * k, q, now)
    np.testing.assert_allclose(torque, [-2.0, -0.1], rtol=1e-3)


# Silence, and the end.


def test_pause_in_which_no_torque_has_faded_ends_with_the_safe_torque():
    """As of a plant in lock-step, which waits: only a watchdog lets the torque fade."""
    rig = Rig(HOLDING)
    rig.step(20)
    rig.guard.deactivate()
    rig.base += 3_000_000_000
    rig.step(2)
    assert len(rig.commands) == 22


def test_states_before_the_first_start_are_not_back_after_a_silence():
    arm = Scenario('recommended')
    arm.controller.stop()
    assert np.isnan(arm.run(0.002).torque).all()
    assert not arm.text
    assert arm.controller.close() is None


def test_arm_that_is_pushed_while_the_law_is_inactive_is_in_no_safe_stop():
    arm = Scenario('recommended', HOLDING)
    arm.run(0.02)
    arm.controller.stop()
    after = arm.run(0.6, reach=lambda torque: torque + np.array([10.0, 0.0]))
    assert after.speed[-1].max() > 1.0  # rad/s
    assert not arm.text


def test_messages_that_cannot_be_read_are_no_silence():
    """Each gets a torque; those of the watchdog besides would let it fade twice as fast."""
    rig = Rig(HOLDING, live=True)
    rig.step(20)
    rig.sense = lambda _: [b'']
    rig.step(200)
    assert rig.supervisor.reason is R.BAD_MESSAGE
    assert len(rig.commands) == 220


CALLS = {
    'deactivate': lambda guard: guard.deactivate(),
    'activate': lambda guard: guard.starting.activate(),
    'reset': lambda guard: guard.starting.reset(),
}


@pytest.mark.parametrize('late', [0, 60])
@pytest.mark.parametrize(
    ('calls', 'phase'),
    [
        ((), blf.Phase.SAFE_STOP),
        (('deactivate',), blf.Phase.INACTIVE),
        (('deactivate', 'activate'), blf.Phase.STARTING),
        (('reset',), blf.Phase.STARTING),
    ],
)
def test_gravity_is_held_in_silence(calls, phase, late):
    """`late` [ms] of it have passed before the calls."""
    rig = Rig(HOLDING, live=True)
    rig.step(20)
    rig.wait(late)
    for call in calls:
        CALLS[call](rig.guard)
    rig.wait(60 - late)
    assert (np.abs(rig.commands[-1]) > 1.0).all()
    rig.wait(1000)
    assert (np.abs(rig.commands[-1]) > 1.0).all()
    assert rig.supervisor.phase is phase
    rig.base += rig.steady - 5_000_000_000
    rig.step(1)
    # it still moves, so its reference begins at its velocity
    starts = phase is blf.Phase.STARTING
    assert rig.supervisor.phase is (blf.Phase.APPROACHING if starts else phase)


def test_after_a_long_silence_nothing_is_commanded_until_a_reset():
    """Whoever restarted the driver may not expect another torque."""
    rig = Rig(HOLDING, live=True)
    rig.step(20)
    rig.wait(3000)
    commands = len(rig.commands)
    rig.base += 3_000_000_000
    rig.step(50)
    assert len(rig.commands) == commands
    why, back = rig.supervisor.text.split('; ')
    assert why.startswith('no joint state received')
    assert back.startswith('joint states are back after 3 s')
    assert rig.supervisor.stops == 1
    assert rig.guard.release() is None
    rig.guard.starting.reset()
    rig.wait(100)
    assert len(rig.commands) == commands  # before a state
    rig.step(5)
    assert rig.supervisor.running
    rig.guard.deactivate()
    rig.step()
    assert len(rig.commands) == commands + 6


@pytest.mark.parametrize('on_a_ramp', [False, True])
@pytest.mark.parametrize('safety', ['hold_gravity', 'damping', 'zero'])
def test_last_torque_is_the_safe_torque_of_an_arm_at_rest(safety, on_a_ramp):
    """A driver may hold it for ever: it is not damped, and there is no ramp any more."""
    given = {'safety.torque': safety}
    arm = Scenario('recommended', LEARNED | given, plant=QUIET)
    q = arm.run(0.5).q[-1]
    if on_a_ramp:
        arm.controller.stop()
    torque = arm.controller.close()
    held = dynamics(P, 9.8, q, (0.0, 0.0))[2] if safety == 'hold_gravity' else NAN * 0
    np.testing.assert_allclose(torque, np.nan_to_num(held), atol=0.1)


@pytest.mark.parametrize('reference', ['sinusoids', 'hold'])
def test_arm_settles_after_a_deactivation_and_its_end_says_so(reference):
    """Once it has rested for a third of a second; a watchdog holds it otherwise."""
    arm = Scenario('recommended', LEARNED | {'reference.type': reference}, plant=QUIET)
    arm.run(1.0 if reference == 'hold' else 0.5)
    settled = [arm.controller.is_settled]
    arm.controller.stop()
    for seconds in (0.3, 0.1, 3.6):
        after = arm.run(seconds)
        settled.append(arm.controller.is_settled)
    assert settled == [False, False, reference == 'hold', True]
    assert after.speed[-1].max() < 0.01
    for rests in (True, False):
        arm.guard.release()
        assert arm.events[-1].content == {'resting': rests}
        arm.controller.reset()
        arm.run(0.5, reach=lambda torque: torque + np.array([10.0, 0.0]))
