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

from blf_dsc_controller import load_loop
from blf_dsc_controller.configuration.schema import change, flatten
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.watchdog_node import WatchdogNode
from sim_plant.plant import plant_of

FR3, UR5E = CONFIG / 'fr3.yaml', CONFIG / 'ur5e_driver.yaml'
SLOWER = 3  # times slower than real time: any computer keeps up
CRASH = """
import ctypes, sys
from blf_dsc_controller.nodes import controller_node

class Crashing(controller_node.ControllerNode):
    def _on_joint_state(self, raw):
        super()._on_joint_state(raw)
        if self.guard.controller.samples > 425:
            ctypes.string_at(0)

controller_node.process.run(Crashing)
"""
ENDS = {'killed': signal.SIGKILL, 'stopped': signal.SIGSTOP, 'crashed': None}


def given(config):
    """Return the parameters of a configuration that are not empty."""
    return {name: value for name, value in flatten(config).items() if value != ()}


@pytest.fixture
def controller(ros):
    """Return a function that starts a UR5e's controller as a process in the domain of `ros`."""
    started = []

    def start(*code, **parameters):
        """Start it with patience for a slow arm."""
        patient = {'safety.state_timeout': 10.0, 'safety.overrun_fraction': 1.0} | parameters
        words = [word for name, value in patient.items() for word in ('-p', f'{name}:={value}')]
        code = code or ('-m', 'blf_dsc_controller.nodes.controller_node')
        command = [sys.executable, *code, '--ros-args', '--params-file', str(UR5E), *words]
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

    arm = ros.add(PlantNode, given(load_loop(UR5E).plant), clock=steady)
    watchdog = ros.add(partial(WatchdogNode, steady=steady))
    process = controller(*(('-c', CRASH) if end == 'crashed' else ()))
    ros.until(lambda: watchdog.line is not None and arm.plant.sample > 425)
    if end != 'crashed':
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


class Driver:
    """A driver that holds the last command for ever, in the time of a clock that it advances."""

    def __init__(self, ros, config):
        self.ros, self.plant, self.period = ros, plant_of(config), config.sample_time_ns
        self.now, self.torque = 0, np.zeros(len(config.joints))
        self.received, self.states = ros.listen(topics.COMMANDS), ros.publisher(topics.JOINT_STATES)
        self.encoder = JointStateEncoder(config.joints)

    def send(self):
        """Publish the state of the next sample; return its stamp."""
        stamp = 1_000_000_000 + self.plant.elapsed_ns
        self.states.publish(self.encoder.encode(stamp, *self.plant.measure().reshape(3, -1)))
        self.now += self.period
        return stamp

    def move(self):
        """Advance by a sample, with the last command."""
        self.torque = np.array(self.received[-1].data)
        self.plant.step(self.torque)


@pytest.mark.parametrize(('preset', 'angle'), [('fr3', 0.25), ('ur5e_driver', 0.2)])
def test_named_arm_in_motion_comes_to_rest_once_its_controller_is_dead(ros, preset, angle):
    """Over ROS, in the time of the states: a busy computer changes nothing."""
    loop = load_loop(CONFIG / f'{preset}.yaml')
    driver = Driver(ros, change(loop.plant, {'actuator.rate_limit': 0.0}))
    n, steady = len(loop.controller.joints), lambda: driver.now
    controller = ros.add(ControllerNode, given(loop.controller), clock=steady)
    watchdog = ros.add(partial(WatchdogNode, steady=steady))
    ros.until(lambda: watchdog.line is not None and driver.states.get_subscription_count() > 1)
    for _ in range(round(1.1 / loop.controller.sample_time)):
        count = len(driver.received)
        driver.send()
        ros.until(lambda count=count: len(driver.received) > count)
        driver.move()
    start = driver.plant.measure().copy()
    assert np.abs(start[n : 2 * n]).max() > 0.3
    ros.kill(controller)
    for _ in range(round(2.0 / loop.controller.sample_time)):
        count, stamp = len(driver.received), driver.send()
        ros.until(lambda stamp=stamp: watchdog.line.stamp == stamp)
        if watchdog.line.active:
            ros.until(lambda count=count: len(driver.received) > count)
        driver.move()
    assert watchdog.line.takeovers == 1
    assert not driver.plant.is_stopped
    assert np.abs(driver.plant.measure()[n : 2 * n]).max() < 0.02
    assert np.abs(driver.plant.measure()[:n] - start[:n]).max() < angle


def test_restarted_watchdog_holds_the_arm_of_a_controller_that_died_before(ros, monkeypatch):
    """Which torque it held before, it cannot know: that of the model is sent at once."""
    monkeypatch.setattr(sys, 'argv', ['node', '--ros-args', '--params-file', str(FR3)])
    config = load_loop(FR3).plant
    driver = Driver(ros, config)
    watchdog = ros.add(partial(WatchdogNode, steady=lambda: driver.now), {'armed': True})
    ros.until(lambda: driver.states.get_subscription_count() > 0)
    for _ in range(100):
        stamp = driver.send()
        ros.until(lambda stamp=stamp: watchdog.line.stamp == stamp)
        driver.plant.step(driver.torque)
    ros.until(lambda: driver.received)
    assert watchdog.line.active
    assert watchdog.line.silence == pytest.approx(0.05, abs=0.01)
    np.testing.assert_allclose(driver.received[0].data, np.zeros(7), atol=0.1)
    ros.executor.remove_node(watchdog)
    ros.spin(0.1)
    count = len(driver.received)
    watchdog.close()  # the driver holds the last torque
    ros.until(lambda: len(driver.received) > count)
