# SPDX-License-Identifier: Apache-2.0
"""A controller that starts while another node, the watchdog, holds the arm with its load."""

from __future__ import annotations

import numpy as np
import pytest

import blf_dsc_controller as blf
from blf_dsc_controller import load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.last_state import LastState
from blf_dsc_controller.supervision.supervisor import Phase, Reason
from sim_plant.plant import plant_of

LOADED = {
    'duration': 0.0,
    'events.begin': [0.0],
    'events.duration': [1e6],
    'events.payload': [2.0],
}
HOLD = {'reference.type': 'hold'}


class Arm:
    """A simulated arm with 2 kg of which nobody knows, and one controller after another."""

    def __init__(self, preset):
        loop = load_loop(preset, {'sim_plant': LOADED, 'blf_dsc_controller': HOLD})
        self.config = loop.controller
        self.plant = plant_of(loop.plant)
        self.stamp = 10**9
        self.restart()

    def restart(self, acting=None):
        """Start another controller, which knows nothing but what it is told."""
        self.guard = Guard(self.config, lambda: 0, lambda: 0)
        self.guard.starting.activate()
        if acting is not None:
            self.guard.starting.take_over_from(acting)

    def run(self, seconds):
        """Return torques (k, n) and the largest speed [rad/s] of so many seconds."""
        n = len(self.config.joints)
        torques, fastest = [], 0.0
        for _ in range(round(seconds / self.config.sample_time)):
            torque = self.guard.update(self.stamp, self.plant.measure())
            self.guard.perceive()
            if torque is None:
                break
            torques.append(torque.copy())
            self.plant.step(torque)
            self.stamp += self.config.sample_time_ns
            fastest = max(fastest, np.abs(self.plant.truth()[-n:]).max())
        return np.array(torques), fastest

    def holding(self):
        """Return the torque (n,) [N m] that holds the arm, without what encoder steps add."""
        return np.median(self.run(0.1)[0], axis=0)

    def damping(self):
        """Return the damping (n,) [N m] of the velocities that are measured: encoders step."""
        _, dq, _ = self.plant.measure().reshape(3, -1)
        return np.array(self.config.feedback.gain) * np.abs(dq)


@pytest.fixture(params=['fr3', 'panda', 'ur5e'])
def arm(request):
    held = Arm(request.param)
    held.run(3.0)
    return held


def test_it_goes_on_from_the_torque_that_holds_the_arm(arm):
    held = arm.holding()
    arm.restart(held)
    limit = np.array(arm.config.torque.rate_limit) * arm.config.sample_time
    limit = np.where(limit > 0.0, limit, 0.5 + arm.damping()) + 1e-9
    torques, speed = arm.run(0.5)
    assert (np.abs(torques[0] - held) <= limit).all()
    assert speed < 0.02  # rad/s
    types = [event.type for event in arm.guard.journal.pending]
    assert types[-2:] == [EventType.TAKEOVER, EventType.START]


def test_a_reset_in_command_forgets_what_was_learned_and_goes_on_to_carry_the_load(arm):
    """Elsewhere the arm sags, as the next test shows."""
    held = arm.holding()
    arm.guard.starting.reset()
    state, settings = arm.guard.controller.state, arm.guard.controller.settings
    np.testing.assert_array_equal(state.estimate, settings.initial_estimate)
    limit = 0.5 + arm.damping()
    torques, speed = arm.run(0.5)
    assert speed < 0.02  # rad/s
    assert (np.abs(torques[0] - held) <= limit).all()


def test_a_reset_of_an_arm_that_has_stopped_goes_on_to_carry_its_load(arm):
    """As the safe torque does: else the arm falls until the feedback catches it."""
    arm.guard.fail('by hand')
    torques, _ = arm.run(2.0)
    arm.guard.starting.reset()
    limit = 0.5 + arm.damping()
    first, speed = arm.run(0.5)
    assert arm.guard.supervisor.running, arm.guard.supervisor.text
    assert speed < 0.02  # rad/s
    assert (np.abs(first[0] - torques[-1]) <= limit).all()


def test_a_start_that_is_refused_after_a_reset_leaves_the_load_to_the_safe_torque(arm):
    arm.guard.fail('by hand')
    arm.run(2.0)
    arm.guard.starting.reset()
    arm.guard.starting.refuse(StartError('by hand'))
    _, speed = arm.run(0.5)
    assert arm.guard.supervisor.phase is Phase.SAFE_STOP
    assert speed < 0.04  # rad/s; a Panda that is left alone has up to 0.03


def test_an_invalid_state_after_a_reset_lets_no_load_fall(arm):
    """The law waits for another, and the safe torque carries the load meanwhile."""
    arm.guard.starting.reset()
    n = len(arm.config.joints)
    for _ in range(round(0.2 / arm.config.sample_time)):
        measurement = arm.plant.measure().copy()
        measurement[n : 2 * n] = np.nan
        arm.plant.step(arm.guard.update(arm.stamp, measurement))
        arm.stamp += arm.config.sample_time_ns
    assert arm.guard.starting.waiting_for
    assert np.abs(arm.plant.truth()[-n:]).max() < 0.02  # rad/s
    _, speed = arm.run(0.5)
    assert arm.guard.supervisor.running, arm.guard.supervisor.text
    assert speed < 0.02


@pytest.mark.parametrize('torque', ['hold_gravity', 'damping'])
@pytest.mark.parametrize('gap', [0.0, 0.1])
@pytest.mark.parametrize('is_stopped', [True, False])
def test_a_reset_begins_without_a_load_that_nothing_shows(torque, gap, is_stopped):
    """After a gap, another may hold the arm; behind mere damping, something else does."""
    arm = Arm('fr3')
    arm.run(3.0)
    carried = np.abs(arm.guard.controller.state.disturbance).max()
    arm.guard.retune(change(arm.config, {'safety.torque': torque}))
    if is_stopped:
        arm.guard.fail('by hand')
        arm.run(0.1)
    arm.guard.starting.reset()
    arm.stamp += round(1e9 * gap)
    arm.run(arm.config.sample_time)
    assert arm.guard.supervisor.running, arm.guard.supervisor.text
    begins = np.abs(arm.guard.controller.state.disturbance).max()
    is_shown = gap == 0.0 and not (is_stopped and torque == 'damping')
    assert begins > 0.5 * carried if is_shown else begins < 0.01 * carried


@pytest.mark.parametrize('reason', [Reason.SATURATED, Reason.OUTSIDE_BOUND])
def test_a_reset_begins_without_a_load_if_commands_may_not_have_reached_the_arm(reason):
    """An arm at rest does not show it: brakes hold it as well."""
    arm = Arm('fr3')
    arm.run(3.0)
    carried = np.abs(arm.guard.controller.state.disturbance).max()
    arm.guard.stop(reason, 'by hand')
    arm.run(arm.config.sample_time)
    arm.guard.starting.reset()
    arm.run(arm.config.sample_time)
    assert np.abs(arm.guard.controller.state.disturbance).max() < 0.01 * carried


@pytest.mark.parametrize(
    ('elapsed', 'moved', 'leads'),
    [
        (0.001, 0.0029, True),
        (0.001, -0.0031, False),  # as the simulation of another episode begins
        (0.02, 0.05, True),
        (0.031, 0.0, False),
        (0.0, 0.0, False),
    ],
)
def test_last_state_leads_to_one_that_an_arm_of_3_rad_s_can_reach(
    elapsed, moved, leads
):
    last = LastState(1)
    assert not last.leads_to(10**9, np.zeros(1), 3.0, 0.001)
    last.take(10**9, np.array([0.5, 0.0, 0.0]), np.zeros(1))
    stamp = 10**9 + round(elapsed * 1e9)
    q = np.array([0.5 + moved])
    assert last.leads_to(stamp, q, 3.0, 0.001) == leads


def test_two_resets_in_a_row_carry_the_load():
    """The second finds no sample, or too few to observe it."""
    arm = Arm('fr3')
    arm.run(3.0)
    for seconds in (0.0, 0.05, 0.1):
        arm.guard.starting.reset()
        _, speed = arm.run(seconds)
        assert speed < 0.02


@pytest.mark.parametrize('arm', ['fr3', 'panda'], indirect=True)
def test_a_controller_that_is_told_nothing_lets_the_load_sag(arm):
    """What the torque that is told saves; also after a reset, which forgets it."""
    held = arm.guard.controller.state.torque.copy()
    arm.restart(held)
    arm.guard.starting.reset()
    _, speed = arm.run(0.5)
    assert speed > 0.05


def test_without_it_an_arm_that_rests_by_another_torque_is_not_taken_over():
    """Whenever it is asked: also while an encoder steps, which looks like motion."""
    arm = Arm('ur5e')
    arm.run(3.0)
    holding, fastest = arm.guard, 0.0
    for _ in range(20):
        arm.run(0.01)
        fastest = max(fastest, np.abs(arm.plant.measure()[6:12]).max())
        arm.restart()
        assert not len(arm.run(0.001)[0])
        assert 'gravity twice' in str(arm.guard.starting.error)
        arm.guard = holding
    assert fastest > 0.005  # rad/s


def test_the_largest_first_step_is_one_from_there():
    arm = Arm('fr3')
    arm.run(3.0)
    held = arm.guard.controller.state.torque.copy()
    assert np.abs(held).max() > 2.0 * max(arm.config.torque.first_step)
    arm.restart(held)
    torques, _ = arm.run(0.1)
    assert len(torques) == 100
    far = held + 50.0 * np.sign(held)
    arm.restart(far)
    assert not len(arm.run(0.1)[0])
    assert isinstance(arm.guard.starting.error, StartError)


def test_torque_of_another_node_counts_and_not_the_last_own_one():
    """The controller has commanded before, and has been activated again."""
    arm = Arm('fr3')
    arm.run(3.0)
    acting = arm.holding() + 3.0  # N m
    arm.guard.starting.activate()
    arm.guard.starting.take_over_from(acting)
    (torque,), _ = arm.run(arm.config.sample_time)
    assert arm.guard.starting._takeover.acting is None  # it holds the arm no more
    step = np.array(arm.config.torque.rate_limit) * arm.config.sample_time
    assert (np.abs(torque - acting) <= step + 1e-9).all()


def test_load_is_left_out_where_no_integrator_could_ever_unlearn_it():
    gain = [0.0, *[100.0] * 6]
    arm = Arm('fr3')
    arm.config = change(arm.config, {'disturbance.gain': gain})
    arm.restart(np.full(7, 2.0))  # N m
    arm.run(arm.config.sample_time)
    assert (arm.guard.controller.state.disturbance != 0.0).tolist() == [
        each > 0.0 for each in gain
    ]


def test_a_bag_of_it_replays_bit_for_bit(tmp_path):
    arm = Arm('fr3')
    arm.run(1.0)
    held = arm.guard.controller.state.torque.copy()
    with blf.ArmController(arm.config, record=tmp_path / 'bag') as controller:
        controller.guard.starting.take_over_from(held)
        for k in range(200):
            q, dq, effort = arm.plant.measure().reshape(3, -1)
            arm.plant.step(controller.update(1.0 + 0.001 * k, q, dq, effort))
    verified = blf.verify(tmp_path / 'bag')
    assert verified.difference is None
    assert EventType.TAKEOVER in [event.type for event in verified.events]
