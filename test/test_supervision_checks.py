# SPDX-License-Identifier: Apache-2.0
"""Each single fault is flagged, and no torque is commanded that depends on an unusable state."""

from __future__ import annotations

from math import inf, nan
from pathlib import Path

import numpy as np
import pytest
from closed_loop_case import controller, plant, recommended
from fault_table import FAULTS, Rig, named, page, run
from plain_law import dynamics

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.schema import build, change
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.law.check_state import INVALID, OUTSIDE, SUSPECT
from blf_dsc_controller.law.checks import check_sample
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.supervision.calming import Calming
from blf_dsc_controller.supervision.kept_estimates import KeptEstimates
from blf_dsc_controller.supervision.sample_check import SampleCheck
from blf_dsc_controller.supervision.supervisor import Phase, Reason
from blf_dsc_controller.supervision.velocity import Velocity
from sim_plant.plant import plant_of

DT = 1e-3
LIMIT = 20.0  # N m, the default torque limit


@pytest.fixture
def law():
    """A controller that has processed one sample, inside its bound and below its limit."""
    law = controller(recommended())
    law.checks.velocity_limit[0] = 50.0
    law.update(0.0, DT, plant().measure())
    assert law.flags == 0
    return law


def sample_check(config, law):
    return SampleCheck(config, law, Calming(config, law), KeptEstimates(law))


def verdict(law, error_ratio=1.0):
    law.checks.error_ratio[0] = error_ratio
    return check_sample(law.settings, law.checks, law.state, law.signals, law.sample)


def test_estimates_of_a_valid_sample_are_kept(law):
    law.checks.ratio[:] = (0.9, 0.0)
    law.checks.estimates.kept[:] = 0.0
    assert verdict(law) == 0
    np.testing.assert_array_equal(
        law.checks.estimates.kept, [*law.state.estimate, *law.state.disturbance]
    )
    # The largest ratio so far is kept; a smaller one is replaced.
    assert law.checks.ratio[0] == 0.9
    assert law.checks.ratio[1] == abs(law.sample.xi1[1]) / law.sample.bound[1]


BAD = [
    (part, name, i, bad, 1.0, SUSPECT)
    for part, name, i in (
        ('state', 'estimate', 4),
        ('state', 'disturbance', 1),
        ('signals', 'demand', 0),
    )
    for bad in (nan, inf, -inf)
]


@pytest.mark.parametrize(
    ('part', 'name', 'i', 'value', 'error_ratio', 'flags'),
    [
        *BAD,
        ('signals', 'demand', 1, -np.nextafter(LIMIT, 21.0), 1.0, SUSPECT),
        ('sample', 'xi1', 0, 0.002, 1.0, OUTSIDE | SUSPECT),
        ('sample', 'xi1', 0, -0.0021, 1.0, OUTSIDE | SUSPECT),
        ('sample', 'xi1', 0, 0.0021, 2.0, OUTSIDE),
        ('sample', 'xi1', 0, 0.0021, 0.0, OUTSIDE),
        ('sample', 'xi1', 0, nan, 2.0, OUTSIDE | SUSPECT),
        ('sample', 'estimate', 4, nan, 1.0, 0),  # of a rejected column
    ],
)
def test_suspect_samples_are_flagged_and_not_kept(
    law, part, name, i, value, error_ratio, flags
):
    getattr(getattr(law, part), name)[i] = value
    law.checks.estimates.kept[:] = 3.0
    assert verdict(law, error_ratio) == flags
    assert (law.checks.estimates.kept == 3.0).all() == bool(flags & SUSPECT)


@pytest.mark.parametrize(('every', 'stops'), [(4, True), (6, False)])
def test_cuts_add_up_if_they_take_more_than_a_fifth_of_the_time(law, every, stops):
    check = sample_check(build(ControllerConfig, {'safety.saturation_time': 0.05}), law)
    found = []
    law.signals.saturation.added[1] = (
        5.0  # by the drive, so that the command is at its limit
    )
    for k in range(2000):
        law.signals.demand[1] = -16.0 * (k % every == 0)
        law.flags = verdict(law)
        found += filter(None, [check.check(DT)])
    assert bool(found) == stops
    assert all(fault.reason is Reason.SATURATED for fault in found)
    assert all("joint 'joint2' needs 21 N m" in fault.text for fault in found)
    assert check.saturated == -(-2000 // every)
    check.restart()
    assert (check.saturated, check.saturated_time) == (0, 0.0)


def test_what_is_learned_at_the_torque_limit_is_kept_while_it_is_tolerated(law):
    check = sample_check(ControllerConfig(), law)
    law.state.estimate[:] = 0.5
    law.signals.demand[1] = 2.0 * LIMIT
    law.flags = verdict(law)
    assert law.flags == SUSPECT
    assert check.check(DT) is None
    assert (law.checks.estimates.kept[: law.settings.m] == 0.5).all()


@pytest.mark.parametrize(
    ('lack', 'now', 'reason'),
    [
        (1.8, 4.8, Reason.OUTSIDE_BOUND),  # what it lacks now does not last
        (2.3, 4.8, Reason.OUTSIDE_BOUND),  # or is still little on average
        (3.8, 2.3, Reason.OUTSIDE_BOUND),  # what it lacked is over
        (3.8, -4.8, Reason.OUTSIDE_BOUND),  # it is over, and another has come
        (3.8, 4.8, Reason.NO_EFFECT),
    ],
)
def test_only_an_effort_that_lacks_more_than_usual_explains_an_error(
    law, lack, now, reason
):
    """Of drives whose efforts always lack 1.8 N m, 9 % of the torque limit."""
    given = {'robot.effort': 'whole', 'safety.error_ratio': 1.0}
    check = sample_check(build(ControllerConfig, given), law)
    law.checks.effect.usual_shortfall[0] = 1.8
    law.checks.effect.shortfall[0] = lack
    law.checks.repeats.used[4:] = law.sample.torque - [now, 0.0]
    law.sample.xi1[0] = 2.0 * law.sample.bound[0]
    law.flags = verdict(law)
    fault = check.check(DT)
    assert fault.reason is reason
    assert ('lacks +2 N m' in fault.text) == (reason is Reason.NO_EFFECT)


def test_what_drives_add_is_no_lack_of_a_whole_effort():
    """An FR3 of which a joint did lack a third of its limit, and now has what is commanded."""
    loop = load_loop('fr3')
    config = change(loop.controller, {'safety.error_ratio': 1.0})
    law = controller_of(config)
    law.update(0.0, DT, plant_of(loop.plant).measure())
    check = sample_check(config, law)
    added, limit = law.signals.saturation.added, law.settings.torque.limit
    i = int(np.argmax(np.abs(added) / limit))
    assert abs(added[i]) > 0.1 * limit[i]
    law.checks.effect.shortfall[i] = -np.sign(added[i]) * limit[i] / 3.0
    law.checks.repeats.used[14:] = law.sample.torque + added
    law.sample.xi1[i] = 2.0 * law.sample.bound[i]
    law.flags = verdict(law)
    assert check.check(DT).reason is Reason.OUTSIDE_BOUND


def test_usual_lack_of_an_effort_is_its_average_over_a_second():
    law, arm, effort = controller(recommended()), plant(), np.zeros(2)
    sample_check(build(ControllerConfig, {'robot.effort': 'whole'}), law)
    for k in range(1001):
        measurement = arm.measure().copy()
        measurement[4:] = effort - [1.5, 0.0]
        law.update(k * DT, DT, measurement)
        effort = law.signals.torque.copy()
        arm.step(effort)
    expected = [1.5 * (1.0 - np.exp(-1.0)), 0.0]
    np.testing.assert_allclose(law.checks.effect.usual_shortfall, expected, atol=0.02)


def test_estimates_of_before_a_restart_are_consistent_with_it(law):
    """A stop at once does not return to the estimates of an earlier run."""
    check = sample_check(ControllerConfig(), law)
    law.state.estimate[:] = 0.5
    law.state.disturbance[:] = 0.25
    law.state.rotors.gain_scale[:] = 0.75
    estimates = KeptEstimates(law)
    check.restart()
    law.checks.estimates.kept[:] = 9.0  # by what made it stop
    estimates.return_to_consistent()
    assert (estimates.estimate == 0.5).all()
    assert (estimates.disturbance == 0.25).all()
    assert (law.checks.estimates.consistent_scale == 0.75).all()


def test_law_continues_with_the_kept_estimates_after_a_stop(law):
    law.state.estimate[:] = 0.5
    law.state.disturbance[:] = 0.25
    estimates = KeptEstimates(law)
    law.state.estimate[:] = law.state.disturbance[:] = 9.0  # by what made it stop
    estimates.restore()
    assert (law.state.estimate == 0.5).all()
    assert (law.state.disturbance == 0.25).all()
    assert law.samples == 0


@pytest.mark.parametrize(
    ('index', 'value', 'is_valid'),
    [
        (0, nan, False),
        (1, -inf, False),
        (3, nan, False),
        (2, 50.0, True),
        (3, -50.1, False),
    ],
)
def test_invalid_state_leaves_the_law_as_it_was(law, index, value, is_valid):
    measurement, before = plant().measure(), law.save()
    measurement[index] = value
    law.update(DT, DT, measurement)
    assert (law.flags == INVALID) == (not is_valid)
    assert (law.save() == before).all() == (not is_valid)


MILLISECOND = 1_000_000  # ns


def estimated(*states, index=2):
    """Estimated velocity (rad/s) of joint 1 at each (stamp in ms, position in rad)."""
    velocity, found = Velocity(2), []
    for stamp, position in states:
        measurement = np.array([position, 0.0, 7.0, 7.0, 8.0, 8.0])
        velocity.replace(stamp * MILLISECOND, measurement)
        found.append(measurement[index])
        assert (measurement[4:] == 8.0).all()
    return found


def test_velocity_is_the_difference_quotient_of_two_states():
    """A repeated stamp keeps it, and where the stamps restart, or after a pause, it is zero."""
    np.testing.assert_allclose(
        estimated((1, 0.5), (2, 0.502), (4, 0.501)), [0.0, 2.0, -0.5]
    )
    found = estimated((1, 0.5), (2, 0.502), (2, 0.502), (2, 0.502), (3, 0.503))
    np.testing.assert_allclose(found, [0.0, 2.0, 2.0, 2.0, 1.0])
    np.testing.assert_allclose(
        estimated((5, 0.5), (6, 0.502), (1, 0.1), (2, 0.1)), [0, 2, 0, 0]
    )
    # of the simulated arm: a second later
    reset = (2, 0.502), (1002, 0.1), (1003, 0.102)
    np.testing.assert_allclose(estimated((1, 0.5), *reset), [0.0, 2.0, 0.0, 2.0])


def test_repeated_reading_with_a_new_stamp_is_continued_at_its_velocity():
    """Once; an arm that really stands still is at rest in the sample after."""
    moving = (1, 0.5), (2, 0.502)
    found = estimated(*moving, (3, 0.502), (3, 0.504), (4, 0.506), (5, 0.508))
    np.testing.assert_allclose(found, [0.0, 2.0, 2.0, 2.0, 2.0, 2.0])
    np.testing.assert_allclose(
        estimated(*moving, (3, 0.502), (4, 0.502)), [0.0, 2.0, 2.0, 0.0]
    )
    np.testing.assert_allclose(
        estimated(*moving, (3, 0.502), index=0), [0.5, 0.502, 0.504]
    )
    coarse = (1, 0.5), (2, 0.5002), (3, 0.5002)  # less than three counts of 16 bits
    np.testing.assert_allclose(estimated(*coarse), [0.0, 0.2, 0.0])


@pytest.mark.parametrize('fault', FAULTS, ids=lambda fault: fault.name)
def test_fault_is_detected_and_named_and_the_loop_recovers(fault):
    outcome = run(fault)

    assert outcome.reason is fault.reason, outcome.text
    for commands in (outcome.before, outcome.after):
        assert np.isfinite(commands).all()
        assert (np.abs(commands) <= LIMIT).all()
    # A controller that never started stays silent.
    assert bool(len(outcome.after)) == (fault.reason is not Reason.START_REJECTED)
    if fault.reason is Reason.NONE:
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
    # an oscillation is one of the gains: see test_supervision_oscillation
    others = {Reason.FAILED, Reason.CONTACT, Reason.OSCILLATION}
    assert {fault.reason for fault in FAULTS} == set(Reason) - others
    text = (Path(__file__).parents[1] / 'doc/faults.md').read_text()
    assert text == page(text), 'run: python test/fault_table.py doc/faults.md'


# Without usable joint states.

HOLDING = {'safety.torque': 'hold_gravity'}
QUIET = {'disturbance.constant': [0.0, 0.0], 'disturbance.amplitude': [0.0, 0.0]}
LEARNED = HOLDING | {'learning.initial_estimate': [1.0, 0.32, 0.4]}
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


@pytest.mark.parametrize('safety', ['damping', 'hold_gravity'])
@pytest.mark.parametrize('raw', NEVER.values(), ids=NEVER)
def test_controller_waits_silently_for_the_first_usable_state(safety, raw):
    rig = Rig({'safety.torque': safety})
    for _ in range(3):
        assert rig.deliver(raw(rig.state())) is None
        assert rig.guard.starting.waiting_for
    assert (rig.supervisor.phase, rig.supervisor.stops) == (Phase.STARTING, 0)
    rig.step(2)
    assert rig.supervisor.phase is Phase.TRACKING
    assert not rig.guard.starting.waiting_for
    assert len(rig.commands) == 2


def test_unusable_states_after_a_reset_leave_the_safe_torque_in_force():
    """A driver that holds the last torque of the law for ever must get another."""
    rig = Rig(HOLDING)
    rig.step(20)
    rig.guard.starting.reset()
    torque = rig.deliver(rig.state().raw(dq=NAN))
    assert rig.supervisor.phase is Phase.STARTING
    assert (np.abs(torque) > 1.0).all()


@pytest.mark.parametrize('raw', UNUSABLE.values(), ids=UNUSABLE)
def test_outdated_velocity_is_not_damped(raw):
    rig = moving({'safety.torque': 'damping'})
    rig.sense = lambda state: [raw(state)]
    rig.step(10)
    assert rig.supervisor.phase is Phase.SAFE_STOP
    np.testing.assert_array_equal(rig.commands[-1], [0.0, 0.0])


@pytest.mark.parametrize('raw', UNUSABLE.values(), ids=UNUSABLE)
def test_held_gravity_fades_out_without_states_and_returns_with_them(raw):
    rig = moving(HOLDING)
    good = rig.sense
    rig.sense = lambda state: [raw(state)]
    rig.step(10)
    first = len(rig.commands)
    rig.step(500)
    fading = np.abs(rig.commands[first:])
    assert (fading[0] > 1.0).all()
    steps = np.diff(fading, axis=0)[:480]
    np.testing.assert_allclose(steps, steps[[0] * 480], atol=1e-9)  # a straight line
    assert (steps[0] < -1e-3).all()
    np.testing.assert_array_equal(fading[-1], [0.0, 0.0])
    rig.sense = good
    rig.step(1)
    assert (np.abs(rig.commands[-1]) > 0.1).all()


def test_pause_in_which_no_torque_has_faded_ends_with_the_safe_torque():
    """As of a plant in lock-step, which waits: only a watchdog lets the torque fade."""
    rig = Rig(HOLDING)
    rig.step(20)
    rig.guard.deactivate()
    rig.base += 3_000_000_000
    rig.step(2)
    assert len(rig.commands) == 22
    assert not rig.guard.silenced


def test_states_before_the_first_start_are_not_back_after_a_silence():
    rig = Rig(live=True)
    rig.guard.deactivate()
    rig.step(2)
    assert not rig.commands
    assert rig.guard.release() is None
    assert not rig.guard.silenced
    assert not rig.supervisor.text


def test_arm_that_is_pushed_while_the_law_is_inactive_is_in_no_safe_stop():
    rig = Rig(HOLDING)
    rig.step(20)
    rig.guard.deactivate()
    rig.push = np.array([10.0, 0.0])
    rig.step(600)
    assert rig.guard.readings.speed > 1.0  # rad/s
    assert not rig.supervisor.text


def test_messages_that_cannot_be_read_are_no_silence():
    """Each gets a torque; those of the watchdog besides would let it fade twice as fast."""
    rig = Rig(HOLDING, live=True)
    rig.step(20)
    rig.sense = lambda _: [b'']
    rig.step(200)
    assert rig.supervisor.reason is Reason.BAD_MESSAGE
    assert len(rig.commands) == 220


def test_messages_of_another_arm_are_counted():
    rig = Rig()
    other = JointStateEncoder(('left', 'right'))
    rig.sense = lambda state: [state.raw(other), state.raw()]
    rig.step(3)
    assert rig.guard.foreign == 3


CALLS = {
    'deactivate': lambda guard: guard.deactivate(),
    'activate': lambda guard: guard.starting.activate(),
    'reset': lambda guard: guard.starting.reset(),
}


@pytest.mark.parametrize('late', [0, 60])
@pytest.mark.parametrize(
    ('calls', 'phase'),
    [
        ((), Phase.SAFE_STOP),
        (('deactivate',), Phase.INACTIVE),
        (('deactivate', 'activate'), Phase.STARTING),
        (('reset',), Phase.STARTING),
    ],
)
def test_gravity_is_held_in_silence_only_for_the_fade_time(calls, phase, late):
    """A driver would apply the last torque forever.

    `late` [ms] the torque fades already.
    """
    rig = Rig(HOLDING | {'safety.fade_time': 0.2}, live=True)
    rig.step(20)
    rig.wait(late)
    for call in calls:
        CALLS[call](rig.guard)
    rig.wait(60 - late)
    assert (np.abs(rig.commands[-1]) > 1.0).all()
    rig.wait(1000)
    assert rig.commands[-1].tolist() == [0.0, 0.0]
    assert rig.supervisor.phase is phase
    rig.base += rig.steady - 5_000_000_000
    rig.step(1)
    # it still moves, so its reference begins at its velocity
    assert rig.supervisor.phase is (
        Phase.APPROACHING if phase is Phase.STARTING else phase
    )


def test_torque_that_has_faded_is_not_commanded_again_after_a_reset():
    rig = Rig(HOLDING, live=True)
    rig.step(20)
    rig.wait(1000)
    commands = len(rig.commands)
    rig.guard.starting.reset()
    rig.wait(100)
    assert len(rig.commands) == commands


def test_after_a_long_silence_nothing_is_commanded_until_a_reset():
    """By then the torque has faded: whoever restarted the driver may not expect another."""
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
    rig.step(5)
    assert rig.supervisor.running
    rig.guard.deactivate()
    rig.step()
    assert len(rig.commands) == commands + 6


@pytest.mark.parametrize(
    'dq', [NAN, np.array([60.0, np.inf])], ids=['missing', 'too fast']
)
def test_missing_and_implausible_velocities_are_differenced_from_the_positions(dq):
    """Also without a velocity, gravity is held and the motion damped."""
    rig = moving(LEARNED)
    true = rig.state().dq
    rig.sense = lambda state: [state.raw(dq=dq)]
    rig.step(2)
    assert rig.supervisor.phase is Phase.SAFE_STOP
    np.testing.assert_allclose(rig.guard.safe_torque.last.dq, true, atol=0.05)
    rig.step(1000)
    assert np.abs(rig.state().dq).max() < 0.1  # a falling arm has several rad/s by then


def test_joint_that_is_really_too_fast_is_damped_most():
    rig = Rig({'safety.torque': 'damping', 'safety.velocity_limit': 1.0})
    rig.step(20)
    state, torque = rig.state(), None
    for k in range(1, 300):  # ten times the lag of what is damped
        later = state.q + k * 1e-3 * np.array([3.0, 0.1])
        torque = rig.deliver(
            state.raw(stamp=state.stamp + k * 10**6, q=later, dq=[3.0, 0.1])
        )
    # D is 2 and 1 N m s/rad; e^-10 of the velocity is still missing
    np.testing.assert_allclose(torque, [-2.0, -0.1], rtol=1e-3)


@pytest.mark.parametrize('on_a_ramp', [False, True])
@pytest.mark.parametrize('safety', ['hold_gravity', 'damping', 'zero'])
def test_last_torque_is_the_safe_torque_of_an_arm_at_rest(safety, on_a_ramp):
    """A driver may hold it for ever: it is not damped, and there is no ramp any more."""
    rig = moving({'safety.torque': safety, 'safety.deactivation_ramp': 10.0})
    if on_a_ramp:
        rig.guard.deactivate()
    torque = rig.guard.release()
    estimate = rig.guard.estimates.estimate
    q = rig.guard.safe_torque.last.q
    load = rig.guard.held.recent.load(rig.guard.controller.settings, estimate)
    holding = dynamics(estimate[:3], 9.8, q, (0.0, 0.0))[2] + load
    np.testing.assert_allclose(
        torque, holding if safety == 'hold_gravity' else [0.0, 0.0]
    )
    assert np.abs(load).min() > 0.01


def test_end_says_whether_the_arm_rests():
    """Else a watchdog would leave an arm in motion to itself."""
    rig = moving(LEARNED)
    rig.guard.deactivate()
    for rests in (False, True):
        rig.guard.release()
        assert rig.guard.journal.pending[-1].content == {'resting': rests}
        rig.step(4000)


def test_arm_settles_after_a_deactivation():
    """Then the last torque holds it: at rest after the ramp of half a second, not before."""
    resting = Rig(LEARNED | {'reference.type': 'hold'}, plant=QUIET)
    resting.step(1000)
    for rig in (moving(LEARNED), resting):
        assert not rig.guard.is_settled
        rig.guard.deactivate()
        rig.step(400)
        assert not rig.guard.is_settled
        rig.step(110)
        assert rig.guard.is_settled == (rig is resting)
        rig.step(3000)
        assert rig.guard.is_settled
    assert np.abs(resting.state().dq).max() < 0.01
