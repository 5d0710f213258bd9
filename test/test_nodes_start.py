# SPDX-License-Identifier: Apache-2.0
"""What the node waits for before its first torque: its watchdog, and that nobody else commands."""

from __future__ import annotations

import random

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from ros_rig import JOINTS, START, FakeClock, PatientClock

import blf_dsc_controller as blf
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
)
from blf_dsc_controller.messages.journal import decode
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.other_commander import Finding, OtherCommander
from blf_dsc_controller.nodes.watchdog_node import WatchdogNode

EXPECTING = {'safety.expect_watchdog': True}
LOG = topics.Topic(
    '', '/rosout', 'rcl_interfaces/msg/Log', topics.STREAM, topics.STREAM
)


def test_controller_commands_once_its_watchdog_is_ready(ros):
    log = ros.listen(LOG)
    arm, law = ros.loop(controller=EXPECTING)
    ros.until(
        lambda: any(
            'waiting until torque_watchdog is ready' in line.msg for line in log
        )
    )
    assert not law.guard.commanding
    watchdog = ros.add(WatchdogNode)
    ros.until(lambda: law.guard.commanding)
    assert watchdog.watchdog.has_state
    ros.run(arm, 20)
    ros.until(lambda: watchdog.watchdog.watches)


def test_controller_refuses_to_start_without_the_watchdog_that_it_expects(ros):
    """After a minute of its clock."""
    clock = FakeClock()
    law = ros.add(ControllerNode, EXPECTING, clock=clock)
    states = ros.publisher(topics.JOINT_STATES)
    state = JointStateEncoder(JOINTS).encode(10**9, START, np.zeros(2), np.zeros(2))
    ros.driver()
    ros.until(states.get_subscription_count)
    ros.until(lambda: states.publish(state) or law.starting.held)
    clock.advance(59.0)
    ros.spin(0.2)  # it looks every 8 ms
    assert not law.finished
    clock.advance(2.0)
    ros.until(lambda: law.finished)
    assert 'torque_watchdog is expected' in str(law.failure)
    assert not law.guard.commanding


@pytest.mark.parametrize('word', ['refuse', 'allow'])
def test_second_controller_does_not_start_unless_it_is_told_to(ros, word):
    arm, law = ros.loop()
    ros.run(arm, 200)
    other = {'safety.other_commands': word}
    logged = ros.listen(LOG)
    second = ros.add(ControllerNode, other, clock=PatientClock())
    if word == 'allow':
        ros.until(lambda: second.guard.supervisor.running)
        return
    ros.until(lambda: second.finished)
    assert 'another node commands torques' in str(second.failure)
    assert not second.guard.commanding
    ros.until(lambda: any('another node commands' in each.msg for each in logged))
    (refused,) = [each.msg for each in logged if 'another node commands' in each.msg]
    assert refused.endswith('; this node ends')  # and has no ~/reset then
    ros.kill(second)
    ros.run(arm, 500)
    assert law.guard.supervisor.phase is blf.Phase.TRACKING


def test_controllers_that_start_together_do_not_command_at_the_same_moment(
    ros, monkeypatch
):
    """Each waits for a time of its own, so that the later one hears the first."""
    waits = iter([0.110, 0.112])  # s, beyond the second in which others are heard
    monkeypatch.setattr(random, 'uniform', lambda *_: next(waits))
    clock = FakeClock()
    topic = ros.publisher(topics.COMMANDS).topic_name
    ros.publisher(topics.COMMANDS)
    both = [OtherCommander(ros.tester, topic, 2, clock) for _ in range(2)]
    ros.until(lambda: ros.tester.count_publishers(topic) == 2)
    for _ in range(2200):
        found = [other.find() for other in both]
        if Finding.NOBODY in found:
            break
        clock.advance(0.001)
    assert sorted(each.name for each in found) == ['NOBODY', 'UNKNOWN']
    assert 1.0 <= clock() * 1e-9 - 1.0 <= 2.1


def test_torques_of_the_watchdog_do_not_count_as_those_of_another_controller(ros):
    """It holds the arm until the controller is back, which goes on from its torque."""
    commands = ros.publisher(topics.COMMANDS)
    journal = ros.listen(topics.JOURNAL, raw=True)
    law = ros.add(ControllerNode)
    states = ros.publisher(topics.JOINT_STATES)
    ros.driver()
    ros.until(
        lambda: (
            states.get_subscription_count() and commands.get_subscription_count() > 1
        )
    )
    torque = Float64MultiArrayEncoder(2, 'torque_watchdog').encode(np.ones(2))
    encoder = JointStateEncoder(JOINTS)
    stamps = iter(range(10**9, 10**12, 10**6))

    def go_on():
        commands.publish(torque)
        states.publish(encoder.encode(next(stamps), START, np.zeros(2), np.zeros(2)))
        ros.spin(0.005)  # it takes each state
        return law.guard.supervisor.running or law.finished

    ros.until(go_on)
    assert not law.finished

    def starts():
        return [k for k, raw in enumerate(journal) if decode(raw).type == 'start']

    ros.until(starts)
    before = decode(journal[starts()[0] - 1])
    assert before.type == 'takeover'
    assert before.content['torque'] == [1.0, 1.0]
