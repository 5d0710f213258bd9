# SPDX-License-Identifier: Apache-2.0
"""The second line as a process: the controller killed, stopped and crashed beside a held torque."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')


from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.watchdog_node import WatchdogNode

HELD_FOR_EVER = {'actuator.without_command': 'hold'}
CONTROLLER = {
    'safety.torque': 'hold_gravity',
    'reference.type': 'hold',
    'safety.velocity_limit': 9.0,
}
CRASH = """
import ctypes, sys
from blf_dsc_controller.nodes import controller_node

class Crashing(controller_node.ControllerNode):
    def _on_second(self):
        super()._on_second()
        if self.guard.controller.samples > 1500:
            ctypes.string_at(0)

controller_node.process.run(Crashing)
"""
ENDS = {
    'killed': lambda process: process.kill(),
    'stopped': lambda process: process.send_signal(signal.SIGSTOP),
    'crashed': lambda process: process.wait(60),
}


@pytest.fixture
def controller(ros):
    """Return a function that starts a controller as a process in the domain of `ros`."""
    started = []

    def start(*code):
        domain = str(ros.context.get_domain_id())
        parameters = [f'{name}:={value}' for name, value in CONTROLLER.items()]
        arguments = [word for one in parameters for word in ('-p', one)]
        code = code or ('-m', 'blf_dsc_controller.nodes.controller_node')
        command = [sys.executable, *code, '--ros-args', *arguments]
        started.append(subprocess.Popen(command, env=os.environ | {'ROS_DOMAIN_ID': domain}))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.parametrize('end', ENDS)
def test_second_line_holds_the_arm_until_the_controller_is_back(ros, controller, end):
    arm = ros.add(PlantNode, HELD_FOR_EVER)
    watchdog = ros.add(WatchdogNode, {'timeout': 0.5})
    process = controller(*(('-c', CRASH) if end == 'crashed' else ()))
    ros.until(lambda: watchdog.line is not None and arm.plant.sample > 500)
    if end != 'crashed':
        ENDS[end](process)
    ros.until(lambda: watchdog.line.active)
    ros.spin(3.0)
    assert watchdog.line.active
    _, dq, effort = arm.plant.measure().reshape(3, -1)
    assert np.abs(dq).max() < 0.05
    assert (np.abs(effort) > 1.0).all()
    if end == 'stopped':
        process.send_signal(signal.SIGCONT)
    else:
        controller()
    ros.until(lambda: not watchdog.line.active)
