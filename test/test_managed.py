# SPDX-License-Identifier: Apache-2.0
"""Both nodes under a manager's hands: life cycle, resets in any order, death of one of them."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from fake_clock import FakeClock
from ros_rig import activate, cleanup, configure, deactivate, shutdown, torques, values

import sim_plant.node
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import ControllerNode
from sim_plant.node import PlantNode

SECOND = 1_000_000_000  # ns


def in_command(node):
    return node.guard is not None and node.guard.supervisor.running


def assert_runs(ros, arm, law, samples=60):
    """The loop goes on, the law is in command, and the error within its bound."""
    ros.run(arm, samples)
    assert in_command(law), law.guard.supervisor.text
    assert law.guard.samples.ratio.max() < 1.0


def test_nodes_start_by_themselves(ros):
    arm, law = ros.loop()
    assert (arm.state_label, law.state_label) == ('active', 'active')
    assert_runs(ros, arm, law)


def test_nodes_that_wait_for_a_manager_do_nothing_until_it_comes(ros):
    heard = ros.listen(topics.COMMANDS)
    arm, law = ros.loop({'autostart': False}, {'autostart': False})
    assert (arm.state_label, law.state_label) == ('unconfigured', 'unconfigured')
    for node in (arm, law):
        assert configure(ros, node)
    ros.spin(0.4)  # longer than the plant lets its peers settle
    assert not heard
    assert activate(ros, arm)
    ros.spin(0.4)
    assert not heard
    assert activate(ros, law)
    assert_runs(ros, arm, law)


def test_a_transition_that_is_not_possible_is_rejected_and_nothing_ends(ros):
    arm, law = ros.loop()
    assert not activate(ros, law)
    assert not configure(ros, arm)
    assert not cleanup(ros, law)
    assert_runs(ros, arm, law)


def test_deactivated_the_torque_ramps_to_the_safe_one_while_states_come(ros):
    heard = ros.listen(topics.COMMANDS)
    arm, law = ros.loop(controller={'safety__deactivation_ramp': 0.1})
    ros.run(arm, 50)
    assert deactivate(ros, law)
    ros.run(arm, 150)
    commanded = torques(heard)
    start = np.flatnonzero((commanded == 0.0).all(axis=1))[0] - 100
    ramp = commanded[start : start + 101]
    # A hundred samples of a millisecond, each a hundredth of the last torque of the law less.
    np.testing.assert_allclose(ramp, np.outer(np.linspace(1.0, 0.0, 101), ramp[0]), atol=1e-12)
    assert (np.abs(ramp[0]) > 1.0).all()
    assert not commanded[start + 101 :].any()


def test_a_node_that_was_never_in_command_stays_silent_when_inactive(ros):
    heard = ros.listen(topics.COMMANDS)
    arm, law = ros.loop(controller={'autostart': False})
    assert configure(ros, law)
    ros.spin(0.4)
    assert not heard
    assert arm.plant.sample == 0


def test_a_pause_of_the_plant_is_a_pause_of_time(ros):
    arm, law = ros.loop()
    ros.run(arm, 50)
    assert deactivate(ros, arm)
    sample = arm.plant.sample
    ros.spin(0.3)
    assert arm.plant.sample == sample
    assert activate(ros, arm)
    assert_runs(ros, arm, law)


def test_cleaned_up_and_configured_again_it_runs_again(ros):
    arm, law = ros.loop()
    ros.run(arm, 30)
    for node in (law, arm):
        assert deactivate(ros, node)
        assert cleanup(ros, node)
        assert node.state_label == 'unconfigured'
    for node in (arm, law):
        assert configure(ros, node)
        assert activate(ros, node)
    assert_runs(ros, arm, law)


def test_shut_down_the_node_ends(ros):
    _, law = ros.loop()
    assert shutdown(ros, law)
    assert law.finished
    assert law.failure is None


@pytest.mark.parametrize('order', ['p', 'c', 'pc', 'cp', 'ppc', 'ccp', 'pcpc'])
def test_resets_in_any_order_leave_a_loop_that_runs(ros, order):
    arm, law = ros.loop()
    ros.run(arm, 300)
    for who in order:
        assert ros.reset(arm if who == 'p' else law).success
        ros.spin(0.02)
    if 'p' in order:
        ros.until(lambda: arm.plant.sample > 30)
    assert_runs(ros, arm, law)


def test_a_reset_of_both_is_the_same_run_again(ros):
    heard = ros.listen(topics.COMMANDS)
    clock = FakeClock()
    arm, _ = ros.loop({'sensor__position_noise': 1e-5, 'seed': 3}, clock=clock)
    ros.until(lambda: clock.advance(0.01) or arm._offered)
    ros.run(arm, 100)
    begin = arm.stamp - arm.plant.elapsed_ns
    ros.reset(arm)
    # The clock stands still, and the plant with it, until all torques of the first run have come.
    samples = (arm.stamp - SECOND - begin) // (SECOND // 1000) + 1
    ros.until(lambda: len(heard) == samples)
    assert arm.plant.sample == 0
    first = torques(heard)[:100]
    heard.clear()
    ros.until(lambda: clock.advance(0.01) or arm._offered)
    ros.until(lambda: len(heard) >= 100)
    np.testing.assert_array_equal(torques(heard)[:100], first)


def test_a_reset_is_rejected_where_there_is_nothing_to_reset(ros):
    arm, law = ros.loop({'autostart': False}, {'autostart': False})
    for node in (arm, law):
        response = ros.reset(node)
        assert not response.success
        assert 'unconfigured: activate it first' in response.message


def test_a_plant_killed_and_started_again_stops_the_controller_until_reset(ros):
    arm, law = ros.loop()
    ros.run(arm, 50)
    ros.kill(arm)
    again = ros.add(PlantNode, mode='lockstep')
    ros.until(lambda: law.guard.supervisor.text)
    assert 'before the last one' in law.guard.supervisor.text
    assert ros.reset(again).success
    ros.until(lambda: in_command(law))
    assert_runs(ros, again, law)


def test_a_controller_killed_and_started_again_takes_the_arm_where_it_is(ros, monkeypatch):
    monkeypatch.setattr(sim_plant.node, '_REPEAT_PERIOD', 0.1)
    arm, law = ros.loop()
    ros.run(arm, 50)
    ros.kill(law)
    ros.until(lambda: arm.stamp == law.guard.journal.stamp + SECOND // 1000)
    sample = arm.plant.sample
    ros.spin(0.3)
    assert arm.plant.sample == sample  # without torques, time stands still
    again = ros.add(ControllerNode)
    assert_runs(ros, arm, again)


@pytest.mark.parametrize('brake', ['zero', 'brake'])
def test_in_real_time_a_torque_that_is_too_old_is_not_applied(ros, brake):
    diagnostics, states = ros.listen(topics.DIAGNOSTICS), ros.listen(topics.JOINT_STATES)
    clock = FakeClock()
    arm = ros.add(PlantNode, clock=clock, actuator__without_command=brake)
    law = ros.add(ControllerNode, clock=clock)
    ros.until(lambda: clock.advance(0.01) or states)
    ros.until(arm.input.torque.any)
    for sample in range(1, 21):
        clock.advance(0.001)
        ros.until(lambda k=sample: arm.plant.sample == k and arm._has_torque)
    assert arm.plant.measure()[4:].any()
    ros.kill(law)
    ros.until(lambda: clock.advance(0.001) or arm.input.stale_steps > 5)
    measured = arm.plant.measure()
    assert not measured[4:].any()
    assert measured[2:4].any() == (brake == 'zero')
    ros.until(lambda: last_error(diagnostics, 'sim_plant/torque'))
    assert 'too old' in last_error(diagnostics, 'sim_plant/torque')
    # A controller that comes back and starts with the arm gets it going again.
    again = ros.add(ControllerNode, clock=clock)
    ros.reset(arm)
    ros.until(lambda: clock.advance(0.01) or in_command(again))


def last_error(diagnostics, name):
    """Return the message of the last error of a status; empty if there was none."""
    statuses = [status for array in diagnostics for status in array.status if status.name == name]
    errors = [status.message for status in statuses if status.level == b'\2']
    return errors[-1] if errors else ''


def test_the_state_is_latched_and_names_the_reason(ros):
    arm, _ = ros.loop()
    ros.run(arm, 20)
    late = ros.listen(topics.STATE)
    ros.until(lambda: late)
    assert late[-1].message == 'tracking'
    assert values(late[-1])['phase'] == 'tracking'
    arm._start_stamp -= 10**9
    ros.until(lambda: len(late) > 1)
    assert late[-1].level == b'\2'
    assert late[-1].message.startswith('stopped: the stamp of a joint state is 0.999 s before')
    assert values(late[-1]) | {'phase': 'safe stop', 'reason': 'stamp backward'} == values(late[-1])
    assert late[-1].name == 'blf_dsc_controller/state'
    assert late[-1].hardware_id == 'joint1 joint2'
