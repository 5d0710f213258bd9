# SPDX-License-Identifier: Apache-2.0
"""The second line as a process: the controller killed, stopped and crashed beside a held torque."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from random_arm import CONFIG
from rclpy.parameter import Parameter
from ros_rig import JOINTS, START

from blf_dsc_controller import load_loop
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder, JointStateEncoder
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.watchdog_node import WatchdogNode
from sim_plant.plant import plant_of

FR3, UR5E = CONFIG / 'fr3.yaml', CONFIG / 'ur5e_driver.yaml'
SLOWER = 3  # times slower than real time: any computer keeps up
ENDS = {'killed': signal.SIGKILL, 'stopped': signal.SIGSTOP, 'crashed': signal.SIGSEGV}


@pytest.fixture
def controller(ros):
    """Return a function that starts a UR5e's controller as a process in the domain of `ros`."""
    started = []

    def start(**parameters):
        """Start it with patience for a slow arm."""
        patient = {'safety.state_timeout': 10.0, 'safety.overrun_fraction': 1.0} | parameters
        words = [word for name, value in patient.items() for word in ('-p', f'{name}:={value}')]
        module = ('-m', 'blf_dsc_controller.nodes.controller_node')
        command = [sys.executable, *module, '--ros-args', '--params-file', str(UR5E), *words]
        domain = str(ros.context.get_domain_id())
        started.append(subprocess.Popen(command, env=os.environ | {'ROS_DOMAIN_ID': domain}))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.parametrize('end', ENDS)
def test_arm_in_motion_comes_to_rest_beside_a_dead_process(ros, controller, end):
    """A UR5e whose driver holds the last torque for ever: 1.4 rad in a second without a watchdog.

    With it 0.1 rad; the limit leaves room for computers that are far too slow.
    """

    def steady():
        return time.monotonic_ns() // SLOWER

    arm = ros.add(PlantNode, flatten(load_loop(UR5E).plant), clock=steady)
    watchdog = ros.add(partial(WatchdogNode, steady=steady))
    process = controller()
    ros.until(lambda: watchdog.line is not None and arm.plant.sample > 425)
    process.send_signal(ENDS[end])
    ros.until(lambda: end == 'stopped' or process.poll() is not None)
    start = arm.plant.measure()[:6].copy()
    ros.run(arm, 500)
    assert watchdog.line.takeovers == 1
    assert watchdog.line.active
    assert np.abs(arm.plant.measure()[:6] - start).max() < 0.5
    if end == 'stopped':
        process.send_signal(signal.SIGCONT)
    elif end == 'killed':
        controller(**{'safety.first_torque': 'send'})
    ros.until(lambda: end == 'crashed' or not watchdog.line.active)


@pytest.mark.parametrize('held', [0.0, 5.0], ids=['restarted afterwards', 'watching'])
def test_watchdog_continues_from_the_torque_that_the_drive_holds(ros, monkeypatch, held):
    """At most 1 N m away, as an FR3 demands.

    If it was restarted after the controller had died, it cannot know it: that of the model is sent
    at once.
    """
    monkeypatch.setattr(sys, 'argv', ['node', '--ros-args', '--params-file', str(FR3)])
    config = load_loop(FR3).plant
    plant, torque = plant_of(config), np.append(held, np.zeros(6))
    commands, states = ros.listen(topics.COMMANDS), ros.publisher(topics.JOINT_STATES)
    controller = ros.publisher(topics.COMMANDS)
    watchdog = ros.add(partial(WatchdogNode, steady=lambda: plant.elapsed_ns), {'armed': True})
    ros.until(lambda: states.get_subscription_count() and controller.get_subscription_count() == 2)
    encoder = JointStateEncoder(config.joints)
    for k in range(100):
        stamp = 10**9 + plant.elapsed_ns
        if held and k < 30:
            controller.publish(Float64MultiArrayEncoder(7).encode(torque))
            ros.until(lambda k=k: len(commands) > k)
        states.publish(encoder.encode(stamp, *plant.measure().reshape(3, -1)))
        ros.until(lambda stamp=stamp: watchdog.line.stamp == stamp)
        plant.step(torque)
    own = 30 if held else 0
    ros.until(lambda: len(commands) > own)
    assert watchdog.line.active
    assert watchdog._timer.timer_period_ns == 10**6  # not 4 ms, at the limit of the torque's rate
    assert watchdog.line.silence == pytest.approx(0.05, abs=0.01)
    np.testing.assert_allclose(commands[own].data, torque, atol=1.01 if held else 0.1)
    ros.executor.remove_node(watchdog)
    ros.spin(0.1)
    count = len(commands)
    watchdog.close()  # the driver holds the last torque
    ros.until(lambda: len(commands) > count)


def test_controller_does_not_take_the_watchdog_for_an_arm(ros):
    """Nothing listens to its commands but the second line: it waits with its first torque."""
    law = ros.add(ControllerNode)
    assert law.set_parameters([Parameter('torque.limit', value=[15.0, 9.0])])[0].successful
    watchdog = ros.add(WatchdogNode)
    states = ros.publisher(topics.JOINT_STATES)
    ros.until(lambda: watchdog.line is not None and states.get_subscription_count() == 2)
    states.publish(JointStateEncoder(JOINTS).encode(10**9, START, np.zeros(2), np.zeros(2)))
    ros.until(lambda: watchdog.line.stamp == 10**9)
    ros.spin(0.2)
    assert watchdog.line.config.torque.limit == (15.0, 9.0)  # as changed before
    assert law.guard.journal.messages == 0
    law._on_second()
    assert law.others == 0
