# SPDX-License-Identifier: Apache-2.0
"""A state that does not come from the arm moves it by no torque, in the law and in a stop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from nights import at_night
from scenario import Scenario, carrying, repeated
from watched_arm import WatchedArm

import blf_dsc_controller as blf

HOLD = {'reference.type': 'hold'}


def resting(preset):
    """Return an arm that has rested for a second."""
    arm = Scenario(preset, HOLD, plant=carrying(0.0))
    assert arm.run(1.0).speed[-1].max() < 0.01
    return arm


def moving(preset):
    """Return an arm on the way to a posture 0.4 rad away, at its fastest."""
    arm = resting(preset)
    q = arm.plant.truth()[-2 * arm.n : -arm.n].copy()
    arm.controller.follow([(1.5, q + 0.4), (3.0, q)])
    assert arm.run(0.75).speed[-1].max() > 0.3
    return arm


def second_sender(offset, every):
    """Add states of another sender of the same joints, which rests `offset` [rad] away."""
    seen = []

    def spoil(state):
        seen.append(state)
        nothing = np.zeros_like(state.q)
        other = replace(
            seen[0],
            stamp=state.stamp - 5e-4,
            q=seen[0].q + offset,
            dq=nothing,
            effort=nothing,
        )
        return [other, state] if len(seen) % every == 0 else [state]

    return spoil


@pytest.mark.parametrize('preset', ['fr3', 'ur5e_driver'])
@pytest.mark.parametrize(
    ('offset', 'every'), [(0.5, 1), (0.3, 10), *at_night((-0.05, 1))]
)
def test_second_sender_of_its_joints_does_not_move_a_resting_arm(preset, offset, every):
    """An FR3 was accelerated to 79 rad/s by its safe stop, a UR5e to 47."""
    arm = resting(preset)
    record = arm.run(1.0, spoil=second_sender(offset, every))
    assert record.phase[-1] == blf.Phase.SAFE_STOP
    assert 'two nodes publish joint states' in arm.text
    assert record.speed.max() < 0.05
    assert np.abs(record.q - record.q[0]).max() < 0.005


@pytest.mark.parametrize('preset', ['fr3', 'ur5e_driver'])
def test_second_sender_leaves_a_moving_arm_its_brakes(preset):
    arm = moving(preset)
    spoil = second_sender(0.5, 1)
    record = arm.run(1.0, spoil=spoil)
    assert record.phase[-1] == blf.Phase.SAFE_STOP
    assert record.speed.max() < record.speed[0].max() + 0.1
    assert record.speed[-1].max() < 0.05


@pytest.mark.parametrize('times', [4, *at_night(2)])
def test_stop_brakes_as_well_if_each_state_arrives_several_times(times):
    """Copies switched the damping off: a Panda went on at 0.6 rad/s."""

    def stopped(spoil):
        arm = moving('panda')
        arm.controller.stop()
        return arm.run(1.5, spoil=spoil)

    alone, several = stopped(None), stopped(repeated(times))
    np.testing.assert_allclose(several.q, alone.q, atol=1e-3)
    assert several.speed[-1].max() < 0.5 * several.speed[0].max()


@pytest.mark.parametrize('preset', ['fr3', 'ur5e_driver'])
def test_states_that_hang_while_their_stamps_go_on_stop_a_moving_arm_at_once(preset):
    """They stopped it after 50 ms, at 1.7 rad/s instead of 0.45."""
    arm = moving(preset)
    hanging = []

    def spoil(state):
        hanging.append(state)
        return [replace(hanging[0], stamp=state.stamp)]

    record = arm.run(0.3, spoil=spoil)
    assert arm.reason == 'stamp repeated'
    assert 'the driver does not read its arm any more' in arm.text
    assert record.stop <= 6
    assert record.speed.max() < record.speed[0].max() + 0.3


def test_arm_that_rests_may_send_the_same_values_for_ever():
    arm = resting('recommended')
    same = []

    def spoil(state):
        same.append(state)
        nothing = np.zeros_like(state.dq)
        return [replace(same[0], stamp=state.stamp, dq=nothing)]

    arm.run(0.5, spoil=spoil)
    assert arm.reason != 'state timeout'


def test_load_is_not_observed_while_another_node_moves_the_arm():
    """A UR5e's shoulder was moved by 0.5 rad: the torque that held it had grown by 60 N m."""
    arm = resting('ur5e')
    arm.guard.deactivate()
    before = arm.run(1.0).torque[-1]
    begin, q = arm.plant.elapsed_ns, arm.plant.truth()[-2 * arm.n : -arm.n].copy()

    def moved(state):
        s = min(1.0, (state.stamp - 1.0 - 1e-9 * begin) / 2.0)
        way = np.zeros_like(q)
        way[2] = 0.3 * (10 * s**3 - 15 * s**4 + 6 * s**5)
        rate = np.zeros_like(q)
        rate[2] = 0.3 * (30 * s**2 - 60 * s**3 + 30 * s**4) / 2.0
        return [replace(state, q=q + way, dq=rate)]

    record = arm.run(2.0, spoil=moved)
    back = arm.run(0.8, spoil=lambda state: [replace(state, q=q, dq=0.0 * q)])
    assert np.isfinite(record.torque).all()
    np.testing.assert_allclose(back.torque[-1], before, atol=2.0)


@pytest.mark.parametrize('torque', ['zero', 'hold_gravity'])
def test_clock_that_is_set_by_an_hour_leaves_the_rate_limit_of_a_torque(torque):
    """The torque jumped by 4.3 to 9.8 N m in a sample, of 1 allowed."""
    given = {'torque.rate_limit': [1000.0] * 2, 'safety.torque': torque}
    arm = Scenario('recommended', given)
    before = arm.run(1.5)
    after = arm.run(
        0.05, spoil=lambda state: [replace(state, stamp=state.stamp + 3600.0)]
    )
    assert arm.reason == 'stamp jump'
    torques = np.vstack((before.torque[-1:], after.torque))
    assert np.abs(np.diff(torques, axis=0)).max() < 1.0 + 1e-9


@pytest.mark.parametrize('bad', [np.inf, np.nan, 1e300])
def test_watchdog_holds_a_resting_arm_after_a_command_that_is_none(bad):
    """It commanded 87 N m for 0.1 s after one `inf`."""
    arm = WatchedArm('fr3', HOLD)
    arm.run(0.2)
    arm.line.take_torque(np.full(arm.n, bad), arm.now)
    arm.run(0.2, hangs=True)
    assert arm.taken
    assert np.abs(arm.taken).max() < 1.0
