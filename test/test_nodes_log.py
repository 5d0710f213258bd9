# SPDX-License-Identifier: Apache-2.0
"""What the nodes log, how to continue after a stop, and how their processes end."""

from __future__ import annotations

import re
import sys
from collections import deque
from functools import partial

import numba
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import finished
from fake_clock import FakeClock
from plain_law import dynamics
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_rig import START, deactivate, shutdown, torques
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.compiled import jit
from blf_dsc_controller.compiled.jit import COMPILING
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.supervision.supervisor import Phase

KEPT = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PLAIN = {'disturbance.constant': [0.0, 0.0], 'disturbance.amplitude': [0.0, 0.0]}
ZERO = (0.0, 0.0)
FATAL = int.from_bytes(Log.FATAL, 'little') if isinstance(Log.FATAL, bytes) else Log.FATAL


@pytest.fixture
def log(ros):
    """Return what the nodes of a namespace logged; each test uses its own (see KEPT)."""
    received = []
    ros.tester.create_subscription(Log, '/rosout', received.append, KEPT)

    def logged(namespace, words, level=0):
        return [
            entry.msg
            for entry in received
            if entry.name.startswith(namespace) and words in entry.msg and entry.level >= level
        ]

    return logged


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
    assert stop.endswith('/phases/sim_plant/reset returns the arm to its start and starts again')
    ros.reset(arm)
    ros.until(lambda: len(logged('tracking the reference')) == 2)
    deactivate(ros, law)
    ros.until(lambda: logged('deactivated: zero torque'))


def test_log_suggests_resetting_the_controller_without_a_simulated_arm(ros, log):
    ros.add(ControllerNode, namespace='real')
    driver = (Float64MultiArray, '/real/blf_dsc_controller/commands', lambda _: None, 1)
    ros.tester.create_subscription(*driver)
    states = ros.tester.create_publisher(JointState, '/real/joint_states', 1)
    ros.until(states.get_subscription_count)
    states.publish(b'')
    ros.until(lambda: log('real', 'not started, waiting for a usable joint state: '))
    states.publish(JointStateEncoder(('joint1', 'joint2')).encode(10**9, START, ZERO, ZERO))
    ros.until(lambda: log('real', 'tracking'))
    states.publish(b'')
    ros.until(lambda: log('real', '', FATAL))
    (stop,) = log('real', '', FATAL)
    assert stop.endswith('/real/blf_dsc_controller/reset starts again from where the arm is')


def test_a_stop_is_logged_once(ros, log):
    node = ros.add(ControllerNode, {'safety.torque': 'hold_gravity'}, namespace='once')
    driver = (Float64MultiArray, '/once/blf_dsc_controller/commands', lambda _: None, 1)
    ros.tester.create_subscription(*driver)
    states = ros.tester.create_publisher(JointState, '/once/joint_states', 50)
    ros.until(states.get_subscription_count)
    encoder = JointStateEncoder(('joint1', 'joint2'))
    for k in (0, 1, 2, 60, 61, 62):
        states.publish(encoder.encode(10**9 + k * 10**6, START, ZERO, ZERO))
        ros.until(lambda k=k: node.guard.journal.stamp == 10**9 + k * 10**6)
        node._report_if_changed(node.guard)
    node.guard._note(EventType.SILENCE, torques=1)
    node._report_if_changed(node.guard)
    ros.until(lambda: log('once', '', FATAL))
    ros.spin(0.2)
    assert len(log('once', '', FATAL)) == 1


def test_leaving_node_commands_the_safe_torque_last(ros):
    """A driver holds it: zero would drop the arm. In motion, the arm is brought to rest first."""
    commands = ros.listen(topics.COMMANDS)
    given = {'safety.torque': 'hold_gravity', 'learning.initial_estimate': [1.0, 0.32, 0.4]}
    arm, law = ros.loop(PLAIN, given)
    ros.run(arm, 500)
    assert np.abs(arm.plant.measure()[2:4]).min() > 0.1
    ros.until(law.ready_to_end)
    assert np.abs(arm.plant.measure()[2:4]).max() < 0.05
    law.close()
    ros.until(lambda: not ros.spin(0.1))
    gravity = dynamics((1.0, 0.32, 0.4), 9.8, arm.plant.measure()[:2], ZERO)[2]
    np.testing.assert_allclose(torques(commands)[-1], gravity, atol=0.1)
    assert law.guard.journal.pending == deque()


@pytest.mark.parametrize('way', [deactivate, shutdown])
def test_every_lifecycle_way_out_leaves_the_safe_torque(ros, way):
    commands = ros.listen(topics.COMMANDS)
    arm, law = ros.loop(controller={'safety.torque': 'hold_gravity'})
    ros.run(arm, 50)
    assert way(ros, law)
    ros.spin(0.3)
    assert (np.abs(torques(commands)[-1]) > 1.0).all()


def test_end_of_a_real_time_run_is_not_a_fault(ros, log):
    clock = FakeClock()
    arm = ros.add(PlantNode, {'duration': 0.02}, clock=clock)
    law = ros.add(ControllerNode, clock=clock)
    ros.until(lambda: clock.advance(0.001) or arm.finished)
    ros.until(lambda: law.guard.supervisor.phase is Phase.STARTING)
    for _ in range(20):
        clock.advance(0.1)
        ros.spin(0.02)
    assert law.guard.supervisor.stops == 0
    assert not log('blf_dsc_controller', '', FATAL)


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
def test_each_compiled_kernel_is_announced_by_the_node_that_waits(ros, log, monkeypatch, tmp_path):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))  # an empty cache

    @jit.kernel
    def first(x):
        return x + 1.0

    @jit.kernel
    def second(x):
        return x + 2.0

    class Compiling(PlantNode):
        def configure(self):
            super().configure()
            first(1.0)
            second(1.0)
            numba.njit(lambda x: x + 1)(1)

    ros.add(Compiling, namespace='compiles')
    ros.until(lambda: log('compiles', 'realtime, waiting for a controller'))
    parts = [re.split(r'\W+', line) for line in log('compiles', COMPILING)]
    numbers = {part[-1]: int(part[2]) for part in parts}  # the plant's kernels come before
    assert list(numbers)[-2:] == ['first', 'second']
    assert sorted(numbers.values()) == list(range(1, len(parts) + 1))


INTERRUPTED = """
import os, signal, sys

class Interrupting:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name == 'numba':
            os.kill(os.getpid(), signal.{})

sys.meta_path.insert(0, Interrupting)
from blf_dsc_controller.cli.main import {}
sys.exit({}())
"""
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


@pytest.mark.parametrize('number', ['SIGINT', 'SIGTERM'])
@pytest.mark.parametrize('node', ['sim_plant', 'blf_dsc_controller'])
def test_signal_during_imports_ends_a_node_silently(node, number):
    run = finished(sys.executable, '-c', INTERRUPTED.format(number, node, node))
    assert (run.returncode, run.stdout, run.stderr) == (0, '', '')


@pytest.mark.parametrize('number', ['SIGINT', 'SIGTERM'])
def test_second_signal_does_not_kill_a_node_that_is_shutting_down(number):
    run = finished(sys.executable, '-c', SECOND.format(number, 'sim_plant', 'sim_plant'))
    assert run.returncode == 1
    assert run.stderr.startswith('unknown arguments --unknown')
