# SPDX-License-Identifier: Apache-2.0
"""Without usable joint states, no torque is commanded that depends on them."""

from __future__ import annotations

import numpy as np
import pytest
from fault_rig import Rig
from fault_table import named

from blf_dsc_controller.supervision.supervisor import Phase

HOLDING = {'safety.torque': 'hold_gravity'}
NAN = np.full(2, np.nan)
FIRST = {
    'unreadable': lambda _: b'',
    'not finite': lambda state: state.raw(q=NAN, dq=NAN),
    'of other joints': lambda state: state.raw(named('joint1', 'joint3')),
}
UNUSABLE = FIRST | {'frozen': lambda state: state.raw(stamp=1_000_000_000)}


def moving(given):
    """Rig after half a second, when both joints are moving."""
    rig = Rig(given)
    rig.step(500)
    assert (np.abs(rig.state().dq) > 0.1).all()
    return rig


@pytest.mark.parametrize('safety', ['damping', 'hold_gravity'])
@pytest.mark.parametrize('raw', FIRST.values(), ids=FIRST)
def test_nothing_is_commanded_before_the_first_usable_state(safety, raw):
    rig = Rig({'safety.torque': safety})
    assert rig.deliver(raw(rig.state())) is None
    assert rig.deliver(raw(rig.state())) is None
    assert rig.supervisor.phase is Phase.SAFE_STOP


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
    np.testing.assert_array_equal(fading[-1], [0.0, 0.0])
    rig.sense = good
    rig.step(1)
    assert (np.abs(rig.commands[-1]) > 0.1).all()


def torque_after_silence(rig):
    rig.wait(1000)
    return rig.commands[-1].tolist()


def test_gravity_is_held_in_silence_only_for_the_fade_time():
    rig = Rig(HOLDING | {'safety.fade_time': 0.2}, live=True)
    rig.step(20)
    rig.wait(60)
    assert (np.abs(rig.commands[-1]) > 1.0).all()
    assert torque_after_silence(rig) == [0.0, 0.0]


@pytest.mark.parametrize('again', [False, True])
def test_torque_fades_when_silence_follows_a_deactivation(again):
    """A driver would apply the last torque forever."""
    rig = Rig(HOLDING, live=True)
    rig.step(20)
    rig.guard.deactivate()
    if again:
        rig.guard.activate()
    assert torque_after_silence(rig) == [0.0, 0.0]
    assert rig.supervisor.phase is (Phase.STARTING if again else Phase.INACTIVE)
    rig.base += rig.steady - 5_000_000_000
    rig.step(1)
    assert rig.supervisor.phase is (Phase.TRACKING if again else Phase.INACTIVE)
