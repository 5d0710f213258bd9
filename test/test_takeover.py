# SPDX-License-Identifier: Apache-2.0
"""A controller that starts, or starts again, while something holds the arm with its load."""

from __future__ import annotations

import numpy as np
import pytest
from nights import at_night
from scenario import Scenario, carrying, changed, frozen

import blf_dsc_controller as blf
from blf_dsc_controller.factory.gains import law_gains

LOAD = carrying(2.0)  # of which nobody knows
HOLD = {'reference.type': 'hold'}
SLOW = 0.02  # rad/s


def arm_of(preset, given=None):
    """Return an arm that its controller has held with its load for 1.5 s."""
    arm = Scenario(preset, HOLD | (given or {}), plant=LOAD)
    arm.run(1.5)
    return arm


@pytest.fixture(params=['fr3', 'ur5e', *at_night('panda')])
def arm(request):
    return arm_of(request.param)


def holding(arm):
    """Return the torque (n,) [N m] that holds an arm, without what encoder steps add."""
    return np.median(arm.run(0.1).torque, axis=0)


def damping(arm):
    """Return the damping (n,) [N m] of the velocities that are measured: encoders step."""
    _, dq, _ = arm.plant.measure().reshape(3, -1)
    return law_gains(arm.config).feedback * np.abs(dq)


def carried(arm):
    """Return the largest torque [N m] besides the model that the law has."""
    return max(map(abs, arm.controller.disturbance.values()))


def test_it_goes_on_from_the_torque_that_holds_the_arm(arm):
    held = holding(arm)
    arm.restart(acting=held)
    limit = np.array(arm.config.torque.rate_limit) * arm.T
    limit = np.where(limit > 0.0, limit, 0.5 + damping(arm)) + 1e-9
    after = arm.run(0.5)
    assert (np.abs(after.torque[0] - held) <= limit).all()
    assert after.speed.max() < SLOW


@pytest.mark.parametrize('is_stopped', [False, True])
def test_a_reset_goes_on_to_carry_the_load(arm, is_stopped):
    """As the safe torque does: else the arm falls until the feedback catches it."""
    if is_stopped:
        arm.controller.fail('by hand')
        held = arm.run(2.0).torque[-1]
    else:
        held = holding(arm)
    arm.controller.reset()
    limit = 0.5 + damping(arm)
    after = arm.run(0.5)
    assert arm.is_running, arm.text
    assert after.speed.max() < SLOW
    assert (np.abs(after.torque[0] - held) <= limit).all()


def test_a_start_that_is_refused_after_a_reset_leaves_the_load_to_the_safe_torque(arm):
    arm.controller.fail('by hand')
    elsewhere = arm.run(2.0).q[-1] + 0.2
    lowest = np.array(arm.config.limits.position_lower)
    lowest[0] = elsewhere[0]
    arm.change({'limits.position_lower': lowest.tolist()})
    arm.controller.reset()
    after = arm.run(0.5)
    assert arm.controller.phase is blf.Phase.SAFE_STOP
    assert arm.reason == 'start rejected'
    assert after.speed.max() < 2.0 * SLOW  # a Panda that is left alone has up to 0.03


def test_an_invalid_state_after_a_reset_lets_no_load_fall(arm):
    """The law waits for another, and the safe torque carries the load meanwhile."""
    arm.controller.reset()
    waiting = arm.run(0.2, spoil=changed(dq=lambda dq: np.nan * dq))
    assert arm.controller.phase is blf.Phase.STARTING
    assert arm.text
    after = arm.run(0.5)
    assert arm.is_running, arm.text
    assert max(waiting.speed.max(), after.speed.max()) < SLOW


@pytest.mark.parametrize('torque', ['hold_gravity', 'damping'])
@pytest.mark.parametrize('change', ['none', 'gap', 'jump', 'other program'])
@pytest.mark.parametrize('is_stopped', [True, False])
def test_a_reset_begins_without_a_load_that_nothing_shows(torque, change, is_stopped):
    """After a gap, another may hold the arm; behind mere damping, something else does.

    Where positions jump, the simulation of another episode begins.
    """
    arm = arm_of('fr3')
    before = carried(arm)
    arm.change({'safety.torque': torque})
    if is_stopped:
        arm.controller.fail('by hand')
        arm.run(0.1)
    if change == 'other program':
        arm.controller.withdraw('the robot stopped by itself')
    arm.controller.reset()
    if change == 'gap':
        arm.run(0.1, spoil=lambda _: [])
    far = 0.02 if change == 'jump' else 0.0  # rad, four times what a fast arm moves
    arm.run(arm.T, spoil=changed(slice(3), q=lambda q: q + far))
    assert arm.is_running, arm.text
    # a law in command knows by its own last motion what it carries
    is_shown = change == 'none' or (change == 'other program' and not is_stopped)
    is_shown = is_shown and not (is_stopped and torque == 'damping')
    begins = carried(arm)
    assert begins > 0.5 * before if is_shown else begins < 0.01 * before


@pytest.mark.parametrize('names', [(), ('q', 'dq')], ids=['efforts too', 'motion'])
def test_a_reset_begins_without_a_load_if_commands_may_not_have_reached_the_arm(names):
    """An arm at rest does not show it: brakes hold it as well."""
    arm = Scenario('fr3', plant=LOAD)
    arm.run(3.0)
    before = carried(arm)
    brakes = frozen(*names)
    arm.run(1.0, spoil=brakes, until=lambda: not arm.is_running)
    assert arm.reason in {'commands without effect', 'error past the bound'}
    arm.run(arm.T, spoil=brakes)
    arm.controller.reset()
    arm.run(arm.T, spoil=brakes)
    assert arm.is_running, arm.text
    assert carried(arm) < 0.01 * before


def test_two_resets_in_a_row_carry_the_load():
    """The second finds no sample, or too few to observe it."""
    arm = arm_of('fr3')
    for seconds in (0.0, 0.05, 0.1):
        arm.controller.reset()
        if seconds > 0.0:
            assert arm.run(seconds).speed.max() < SLOW


@pytest.mark.parametrize('arm', ['fr3', 'panda'], indirect=True)
def test_a_controller_without_the_torque_that_acts_lets_the_load_sag(arm):
    """Also after a reset, which forgets it."""
    arm.restart(acting=holding(arm))
    arm.controller.reset()
    assert arm.run(0.5).speed.max() > 2.0 * SLOW


def test_without_it_an_arm_that_rests_by_another_torque_is_not_taken_over():
    """Whenever it is asked: also while an encoder steps, which looks like motion."""
    arm = arm_of('ur5e')
    holds, fastest = arm.controller, 0.0
    for _ in range(20):
        arm.controller = holds
        arm.run(0.01)
        fastest = max(fastest, np.abs(arm.plant.measure()[6:12]).max())
        arm.restart()
        assert np.isnan(arm.run(0.001).torque).all()
        assert 'gravity twice' in arm.text
    assert fastest > 0.005  # rad/s


def test_the_largest_first_step_is_one_from_there():
    arm = arm_of('fr3')
    held = holding(arm)
    assert np.abs(held).max() > 2.0 * max(arm.config.torque.first_step)
    arm.restart(acting=held)
    arm.run(0.1)
    assert arm.is_running
    arm.restart(acting=held + 50.0 * np.sign(held))
    assert np.isnan(arm.run(0.1).torque).all()
    assert arm.reason == 'start rejected'


def test_torque_of_another_node_counts_and_not_the_last_own_one():
    """The controller has commanded before, and has been activated again."""
    arm = arm_of('fr3')
    acting = holding(arm) + 3.0  # N m
    arm.controller.start()
    arm.guard.starting.take_over_from(acting)
    (torque,) = arm.run(arm.T).torque
    step = np.array(arm.config.torque.rate_limit) * arm.T
    assert (np.abs(torque - acting) <= step + 1e-9).all()


def test_load_is_left_out_where_no_integrator_could_ever_unlearn_it():
    arm = arm_of('fr3')
    gain = {'disturbance.gain': [0.0, *[100.0] * 6]}
    arm.restart(gain, acting=np.full(7, 2.0))  # N m
    arm.run(arm.T)
    found = [value != 0.0 for value in arm.controller.disturbance.values()]
    assert found[:7] == [False, *[True] * 6]


def test_a_bag_of_it_replays_bit_for_bit(tmp_path):
    arm = Scenario('fr3', HOLD, plant=LOAD)
    held = arm.run(1.0).torque[-1]
    arm.restart(acting=held, record=tmp_path / 'bag')
    arm.run(0.2)
    arm.controller.close()
    verified = blf.verify(tmp_path / 'bag')
    assert verified.difference is None
    assert 'takeover' in [str(event.type) for event in verified.events]
