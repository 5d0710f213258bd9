# SPDX-License-Identifier: Apache-2.0
"""Both nodes under a lifecycle manager: transitions, resets in any order, one node killed."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from rclpy.node import Node
from ros_rig import FakeClock, activate, cleanup, configure, deactivate, torques, values

import blf_dsc_controller.nodes.plant_node
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.endpoints import message_class
from blf_dsc_controller.nodes.plant_node import PlantNode

SECOND = 1_000_000_000  # ns


def is_running(node):
    return node.guard is not None and node.guard.supervisor.running


def assert_runs(ros, arm, law, samples=60):
    """Run the loop on, and check that the law is running and the error within its bound."""
    ros.run(arm, samples)
    assert is_running(law), law.guard.supervisor.text
    assert law.guard.samples.ratio.max() < 1.0


def test_nodes_without_autostart_do_nothing_until_a_manager_starts_them(ros):
    commands = ros.listen(topics.COMMANDS)
    arm, law = ros.loop({'autostart': False}, {'autostart': False})
    for node in (arm, law):
        assert node.state_label == 'unconfigured'
        assert 'unconfigured: activate it first' in ros.reset(node).message
        assert configure(ros, node)
    ros.spin(0.4)  # longer than the plant waits for its peers to settle
    assert not commands
    assert activate(ros, arm)
    ros.spin(0.4)
    assert not commands
    assert activate(ros, law)
    assert_runs(ros, arm, law)


def test_loop_waits_for_a_recorder_and_not_for_any_listener(ros):
    waiting = {'wait_for_subscribers': 1}
    arm, _ = ros.loop(waiting, waiting | {'telemetry__enabled': False})
    outputs = topics.JOINT_STATES, topics.TRUTH, topics.COMMANDS
    listener = ros.add(partial(Node, 'listener'))
    for topic in outputs:
        type_ = message_class(topic.type)
        listener.create_subscription(type_, topic.resolved, lambda _: None, 10)
    ros.spin(0.5)
    assert arm.plant.sample == 0
    for topic in outputs:
        ros.listen(topic)
    ros.until(lambda: arm.plant.sample > 0)


def test_transitions_pause_and_restart_the_loop_and_impossible_ones_are_rejected(ros):
    arm, law = ros.loop()
    assert not activate(ros, law)
    assert not configure(ros, arm)
    assert not cleanup(ros, law)
    ros.run(arm, 50)
    assert deactivate(ros, arm)
    sample = arm.plant.sample
    ros.spin(0.3)
    assert arm.plant.sample == sample
    assert activate(ros, arm)
    assert_runs(ros, arm, law)
    for node in (law, arm):
        assert deactivate(ros, node)
        assert cleanup(ros, node)
        assert node.state_label == 'unconfigured'
    for node in (arm, law):
        assert configure(ros, node)
        assert activate(ros, node)
    assert_runs(ros, arm, law)


@pytest.mark.parametrize('order', ['p', 'c', 'pc', 'ccp', 'pcpc'])
def test_loop_runs_after_resets_in_any_order(ros, order):
    arm, law = ros.loop()
    ros.run(arm, 300)
    for letter in order:
        assert ros.reset(arm if letter == 'p' else law).success
        ros.spin(0.02)
    if 'p' in order:
        ros.until(lambda: arm.plant.sample > 30)
    assert_runs(ros, arm, law)


def test_reset_of_both_nodes_repeats_the_run(ros):
    commands = ros.listen(topics.COMMANDS)
    clock = FakeClock()
    arm, law = ros.loop({'sensor__position_noise': 1e-5, 'seed': 3}, clock=clock)
    ros.spin(0.3)
    assert not arm._offered  # peers need time to settle
    ros.until(lambda: clock.advance(0.01) or arm._offered)
    ros.run(arm, 100)
    begin = arm.stamp - arm.plant.elapsed_ns
    ros.reset(arm)
    # Clock and plant stand still until all torques of the first run have arrived.
    samples = (arm.stamp - SECOND - begin) // (SECOND // 1000) + 1
    ros.until(lambda: len(commands) == samples)
    assert arm.plant.sample == 0
    first = torques(commands)[:100]
    commands.clear()
    ros.until(lambda: clock.advance(0.01) or arm._offered)
    assert law.guard.controller.samples < 50  # it has been reset before
    ros.until(lambda: len(commands) >= 100)
    np.testing.assert_array_equal(torques(commands)[:100], first)


def test_restarted_plant_stops_the_controller_until_reset(ros):
    arm, law = ros.loop()
    ros.run(arm, 50)
    ros.kill(arm)
    restarted = ros.add(PlantNode, mode='lockstep')
    ros.until(lambda: law.guard.supervisor.text)
    assert 'before the last one' in law.guard.supervisor.text
    assert ros.reset(restarted).success
    ros.until(lambda: is_running(law))
    assert_runs(ros, restarted, law)


def test_restarted_controller_continues_from_where_the_arm_is(ros, monkeypatch):
    monkeypatch.setattr(blf_dsc_controller.nodes.plant_node, '_REPEAT_PERIOD', 0.1)
    arm, law = ros.loop()
    ros.run(arm, 50)
    ros.kill(law)
    ros.until(lambda: arm.stamp == law.guard.journal.stamp + SECOND // 1000)
    sample = arm.plant.sample
    ros.spin(0.3)
    assert arm.plant.sample == sample  # without torques, time stands still
    restarted = ros.add(ControllerNode)
    assert_runs(ros, arm, restarted)


def test_stale_torque_is_not_applied_in_real_time(ros):
    diagnostics, states = ros.listen(topics.DIAGNOSTICS), ros.listen(topics.JOINT_STATES)
    clock = FakeClock()
    arm = ros.add(PlantNode, clock=clock)
    law = ros.add(ControllerNode, clock=clock)
    ros.until(lambda: clock.advance(0.01) or states)
    ros.until(arm.input.torque.any)
    for sample in range(1, 21):
        clock.advance(0.001)
        ros.until(lambda k=sample: arm.plant.sample == k and arm._has_torque)
    assert arm.plant.measure()[4:].any()
    ros.kill(law)
    ros.until(lambda: clock.advance(0.001) or arm.input.stale_steps > 5)
    assert not arm.plant.measure()[4:].any()
    ros.until(
        lambda: any(
            (status.name, status.level) == ('sim_plant/torque', b'\2')
            and 'too old' in status.message
            for array in diagnostics
            for status in array.status
        )
    )
    # A restarted controller gets the arm moving once the arm is reset.
    restarted = ros.add(ControllerNode, clock=clock)
    ros.reset(arm)
    ros.until(lambda: clock.advance(0.01) or is_running(restarted))


def test_state_is_latched_and_gives_the_reason(ros):
    arm, _ = ros.loop()
    ros.run(arm, 20)
    msgs = ros.listen(topics.STATE)
    ros.until(lambda: msgs)
    assert msgs[-1].message == 'tracking'
    assert values(msgs[-1])['phase'] == 'tracking'
    arm._start_stamp -= 10**9
    ros.until(lambda: len(msgs) > 1)
    assert msgs[-1].level == b'\2'
    assert msgs[-1].message.startswith('stopped: the stamp of a joint state is 0.999 s before')
    assert values(msgs[-1]) | {'phase': 'safe stop', 'reason': 'stamp backward'} == values(msgs[-1])
    assert msgs[-1].name == 'blf_dsc_controller/state'
    assert msgs[-1].hardware_id == 'joint1 joint2'
