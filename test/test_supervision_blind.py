# SPDX-License-Identifier: Apache-2.0
"""Without usable joint states, no torque is commanded that depends on them."""

from __future__ import annotations

import numpy as np
import pytest
from fault_rig import Rig
from fault_table import named
from plain_law import dynamics

from blf_dsc_controller.supervision.checks import Phase

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
        assert rig.guard.waiting_for
    assert (rig.supervisor.phase, rig.supervisor.stops) == (Phase.STARTING, 0)
    rig.step(2)
    assert rig.supervisor.phase is Phase.TRACKING
    assert not rig.guard.waiting_for
    assert len(rig.commands) == 2


def test_unusable_states_after_a_reset_leave_the_safe_torque_in_force():
    """A driver that holds the last torque of the law for ever must get another."""
    rig = Rig(HOLDING)
    rig.step(20)
    rig.guard.reset()
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
    good, rig.sense = rig.sense, lambda state: [raw(state)]
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


@pytest.mark.parametrize(
    ('calls', 'phase'),
    [
        ((), Phase.SAFE_STOP),
        (('deactivate',), Phase.INACTIVE),
        (('deactivate', 'activate'), Phase.STARTING),
    ],
)
def test_gravity_is_held_in_silence_only_for_the_fade_time(calls, phase):
    """A driver would apply the last torque forever."""
    rig = Rig(HOLDING | {'safety.fade_time': 0.2}, live=True)
    rig.step(20)
    for call in calls:
        getattr(rig.guard, call)()
    rig.wait(60)
    assert (np.abs(rig.commands[-1]) > 1.0).all()
    rig.wait(1000)
    assert rig.commands[-1].tolist() == [0.0, 0.0]
    assert rig.supervisor.phase is phase
    rig.base += rig.steady - 5_000_000_000
    rig.step(1)
    assert rig.supervisor.phase is (Phase.TRACKING if phase is Phase.STARTING else phase)


def test_torque_that_fades_in_silence_fades_on_after_a_reset():
    rig = Rig(HOLDING | {'safety.fade_time': 0.2}, live=True)
    rig.step(20)
    rig.wait(60)
    assert (np.abs(rig.commands[-1]) > 1.0).all()
    rig.guard.reset()
    rig.wait(1000)
    assert rig.commands[-1].tolist() == [0.0, 0.0]
    assert rig.supervisor.phase is Phase.STARTING
    rig.base += rig.steady - 5_000_000_000
    rig.step(1)
    assert rig.supervisor.running


def test_after_a_long_silence_nothing_is_commanded_until_a_reset():
    """By then the torque has faded: whoever restarted the driver may not expect another."""
    rig = Rig(HOLDING, live=True)
    rig.step(20)
    rig.wait(3000)
    commands = len(rig.commands)
    rig.base += 3_000_000_000
    rig.step(50)
    assert len(rig.commands) == commands
    assert 'joint states are back after 3 s' in rig.supervisor.text
    assert rig.guard.release() is None
    rig.guard.reset()
    rig.step(5)
    assert rig.supervisor.running
    rig.guard.deactivate()
    rig.step()
    assert len(rig.commands) == commands + 6


@pytest.mark.parametrize('dq', [NAN, np.array([60.0, np.inf])], ids=['missing', 'too fast'])
def test_missing_and_implausible_velocities_are_differenced_from_the_positions(dq):
    """Also without a velocity, gravity is held and the motion damped."""
    rig = moving(LEARNED)
    true = rig.state().dq
    rig.sense = lambda state: [state.raw(dq=dq)]
    rig.step(2)
    assert rig.supervisor.phase is Phase.SAFE_STOP
    np.testing.assert_allclose(rig.guard._safe_torque.last.dq, true, atol=0.05)
    rig.step(1000)
    assert np.abs(rig.state().dq).max() < 0.1  # a falling arm has several rad/s by then


def test_joint_that_is_really_too_fast_is_damped_most():
    rig = Rig({'safety.torque': 'damping', 'safety.velocity_limit': 1.0})
    rig.step(20)
    state, torque = rig.state(), None
    for k in range(1, 3):
        later = state.q + k * 1e-3 * np.array([3.0, 0.1])
        torque = rig.deliver(state.raw(stamp=state.stamp + k * 10**6, q=later, dq=[3.0, 0.1]))
    np.testing.assert_allclose(torque, [-2.0, -0.1])  # D is 2 and 1 N m s/rad


@pytest.mark.parametrize('on_a_ramp', [False, True])
@pytest.mark.parametrize('safety', ['hold_gravity', 'damping', 'zero'])
def test_last_torque_is_the_safe_torque_of_an_arm_at_rest(safety, on_a_ramp):
    """A driver may hold it for ever: it is not damped, and there is no ramp any more."""
    rig = moving({'safety.torque': safety, 'safety.deactivation_ramp': 10.0})
    if on_a_ramp:
        rig.guard.deactivate()
    torque = rig.guard.release()
    samples, q = rig.guard.samples, rig.guard._safe_torque.last.q
    holding = dynamics(samples.estimate[:3], 9.8, q, (0.0, 0.0))[2] + samples.disturbance
    np.testing.assert_allclose(torque, holding if safety == 'hold_gravity' else [0.0, 0.0])
    assert np.abs(samples.disturbance).min() > 0.01


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
