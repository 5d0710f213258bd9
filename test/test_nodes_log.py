# SPDX-License-Identifier: Apache-2.0
"""What the nodes log and warn of, how to continue after a stop, and how their processes end."""

from __future__ import annotations

import json
import sys
from collections import deque
from functools import partial

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import rclpy
from command import finished
from plain_law import dynamics
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_rig import JOINTS, START, FakeClock, deactivate, shutdown, torques, values
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode

# Transient local, to get from /rosout what was logged before discovery. rcl keeps one
# publisher for each logger name, so the nodes of each test are in a namespace of their
# own.
KEPT = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PLAIN = {'disturbance.constant': [0.0, 0.0], 'disturbance.amplitude': [0.0, 0.0]}
ZERO = (0.0, 0.0)
FATAL = (
    int.from_bytes(Log.FATAL, 'little') if isinstance(Log.FATAL, bytes) else Log.FATAL
)


@pytest.fixture
def log(ros):
    """Return what the nodes of a namespace logged.

    Each test uses its own (see KEPT).
    """
    received = []
    ros.tester.create_subscription(Log, '/rosout', received.append, KEPT)

    def logged(namespace, words, level=0):
        return [
            entry.msg
            for entry in received
            if entry.name.startswith(namespace)
            and words in entry.msg
            and entry.level >= level
        ]

    return logged


def statuses(diagnostics, begin):
    """Return the statuses whose messages begin like this."""
    found = [status for array in diagnostics for status in array.status]
    return [status for status in found if status.message.startswith(begin)]


def driver(ros, space):
    """Stand in for an arm: subscribe to commands.

    Return the publisher of joint states.
    """
    space = space and f'/{space}'
    commands = f'{space}/blf_dsc_controller/commands'
    ros.tester.create_subscription(Float64MultiArray, commands, lambda _: None, 1)
    states = ros.tester.create_publisher(JointState, f'{space}/joint_states', 50)
    ros.until(states.get_subscription_count)
    return states


def test_each_phase_is_logged_and_after_a_stop_how_to_continue(ros, log):
    outside = {'initial.position': [START[0] - 0.01, START[1]]}
    arm, law = ros.loop(plant=outside, namespace='phases')
    logged = partial(log, 'phases')
    ros.until(lambda: logged('tracking the reference'))
    assert len(logged('approaching the reference, for ')) == 1

    states = ros.tester.create_publisher(JointState, '/phases/joint_states', 1)
    ros.until(states.get_subscription_count)
    states.publish(b'')
    ros.until(lambda: logged('zero torque: ', FATAL))
    (stop,) = logged('zero torque: ', FATAL)
    assert stop.endswith('/phases/blf_dsc_controller/reset starts again')
    ros.reset(arm)
    ros.until(lambda: len(logged('tracking the reference')) == 2)
    deactivate(ros, law)
    ros.until(lambda: logged('deactivated: zero torque'))


def test_stop_by_the_stamps_of_two_publishers_names_them(ros, log):
    """As of an arm, and a simulated one that somebody else has started."""
    space = 'pair'
    node = ros.add(ControllerNode, namespace=space)
    states = driver(ros, space)
    second = ros.keep(rclpy.create_node('twin', context=ros.context, namespace=space))
    second.create_publisher(JointState, 'joint_states', 1)
    ros.until(lambda: ros.tester.count_publishers(f'/{space}/joint_states') > 1)
    encoder = JointStateEncoder(JOINTS)
    for k in (10, 11, 5):
        stamp = 10**9 + k * 10**6
        states.publish(encoder.encode(stamp, START, ZERO, ZERO))
        ros.until(lambda: node.guard.journal.messages > 0)
        ros.spin(0.05)
    ros.until(lambda: log(space, 'before the last one', FATAL))
    (stop,) = log(space, 'before the last one', FATAL)
    told = 'publishers send joint states: /record_tester, /pair/twin: stop all but one'
    assert told in stop


def test_leaving_node_commands_the_safe_torque_last(ros):
    """A driver holds it: zero would drop the arm.

    In motion, the arm is brought to rest first.
    """
    commands = ros.listen(topics.COMMANDS)
    given = {
        'safety.torque': 'hold_gravity',
        'two_link.initial_estimate': [1.0, 0.32, 0.4],
    }
    clock = FakeClock()
    arm, law = ros.loop(PLAIN, given, clock=clock)
    ros.until(lambda: clock.advance(0.01) or arm.plant.sample > 0)
    ros.run(arm, 500)
    assert np.abs(arm.plant.measure()[2:4]).min() > 0.1
    ros.until(law.prepare_to_end)
    assert np.abs(arm.plant.measure()[2:4]).max() < 0.05
    ros.run(arm, 500)
    law.close()
    ros.until(lambda: len(commands) == law.guard.journal.commands)
    gravity = dynamics((1.0, 0.32, 0.4), 9.8, arm.plant.measure()[:2], ZERO)[2]
    load = law.guard.hold.load  # what it met on the way
    np.testing.assert_allclose(torques(commands)[-1], gravity + load, atol=0.05)
    assert np.abs(load).max() < 0.3
    assert law.guard.journal.pending == deque()


@pytest.mark.parametrize('had_states', [False, True])
def test_node_without_states_ends_at_once(ros, had_states):
    """There is no arm that could be brought to rest, or none that would say so."""
    clock = FakeClock()
    law = ros.add(ControllerNode, {'safety.torque': 'hold_gravity'}, clock=clock)
    if had_states:
        encoder = JointStateEncoder(JOINTS)
        driver(ros, '').publish(encoder.encode(10**9, START, ZERO, ZERO))
        ros.until(lambda: law.guard.supervisor.running)
        assert not law.prepare_to_end()
        clock.advance(1.0)
    assert law.prepare_to_end()


def fail(ros, law):
    """End by an unforeseen error in a transition."""
    law.deactivate = lambda: 1 / 0
    deactivate(ros, law)
    return law.state_label == 'unconfigured'


@pytest.mark.parametrize(
    ('way', 'event'),
    [(deactivate, 'deactivate'), (shutdown, 'release'), (fail, 'release')],
)
def test_every_lifecycle_way_out_leaves_the_safe_torque(ros, way, event):
    commands = ros.listen(topics.COMMANDS)
    journal = ros.listen(topics.JOURNAL)
    arm, law = ros.loop(controller={'safety.torque': 'hold_gravity'})
    ros.run(arm, 50)
    assert way(ros, law)
    ros.until(lambda: f'"{event}"' in journal[-1].data)
    # before the event
    ros.until(lambda: len(commands) > json.loads(journal[-1].data)['commands'])
    ros.spin(0.3)
    assert (np.abs(torques(commands)[-1]) > 1.0).all()
    assert law.finished == (way is shutdown)


def test_rejected_columns_are_logged_and_diagnosed_with_the_reason(ros, log):
    """On the paper's reference, cos t on both joints is indistinguishable from m2 l2^2."""
    diagnostics = ros.listen(topics.DIAGNOSTICS)
    cosine = {'two_link.frequencies': [1.0], 'two_link.bias': False}
    ros.add(ControllerNode, cosine, namespace='rejected')
    arm = ros.add(
        PlantNode, {'mode': 'lockstep', 'duration': 7.0}, namespace='rejected'
    )

    ros.until(
        lambda: arm.finished and statuses(diagnostics, 'not estimated: cos 1 rad/s')
    )
    status = statuses(diagnostics, 'not estimated: cos 1 rad/s')[-1]
    assert 'cannot distinguish it from m2*l2^2' in str(values(status))
    (warning,) = log('rejected', 'is not estimated')  # once, not in every sample
    assert 'cannot distinguish it from m2*l2^2 + cos 1 rad/s joint2 (' in warning


@pytest.mark.parametrize(
    ('kind', 'name', 'does'),
    [
        (ControllerNode, 'blf_dsc_controller/commands', 'commands torques'),
        (PlantNode, 'joint_states', 'publishes joint states'),
    ],
)
def test_second_publisher_on_the_same_topic_is_reported(ros, log, kind, name, does):
    space = f'others_{kind.__name__}'
    diagnostics = ros.listen(topics.DIAGNOSTICS)
    first = ros.add(kind, namespace=space)
    second = ros.add(kind, namespace=space)
    ros.until(lambda: first.others == second.others == 1)
    warnings = partial(log, space, f'another node publishes on /{space}/{name}, too')
    ros.until(lambda: len(warnings()) == 2)
    first.on_second()
    ros.spin(0.2)
    assert len(warnings()) == 2  # one of each
    ros.until(lambda: statuses(diagnostics, f'another node {does}, too'))
    ros.kill(second)
    ros.until(lambda: first.others == 0)


SECOND = """
import os, signal, sys

class Last:
    def __del__(self, kill=os.kill, pid=os.getpid(), number=signal.{}):
        kill(pid, number)

last = Last()  # deleted after Python has restored the signal handlers
from blf_dsc_controller.cli.main import {}
sys.argv.append('--unknown')
sys.exit({}())
"""


def test_second_signal_does_not_kill_a_node_that_is_shutting_down():
    code = SECOND.format('SIGINT', 'sim_plant', 'sim_plant')
    run = finished(sys.executable, '-c', code)
    assert run.returncode == 1
    assert run.stderr.startswith('unknown arguments --unknown')
