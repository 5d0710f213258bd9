# SPDX-License-Identifier: Apache-2.0
"""Events of the plant over ROS: on schedule, and by changing a parameter at run time."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from ros_rig import simulated_torques, states, torques
from test_plant_events import ALL_KINDS

from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import LOCKSTEP_START, PlantNode

OBSERVED = {'wait_for_subscribers': 1}
QUIET = {'telemetry.enabled': False}
PUSHED = {'load.payload': 0.2, 'load.torque': [0.4, -0.3], 'sensor.offset': [1e-5, 0.0]}


def test_all_kinds_of_events_in_lockstep_match_the_offline_run_bit_for_bit(ros):
    plant = {'duration': 0.2, **ALL_KINDS}
    commands, truth = ros.listen(topics.COMMANDS), ros.listen(topics.TRUTH, raw=True)
    ros.listen(topics.JOINT_STATES)
    arm = ros.add(PlantNode, {'mode': 'lockstep', **OBSERVED, **plant})
    ros.add(ControllerNode, OBSERVED | QUIET)
    ros.until(lambda: arm.finished and len(commands) > 200 and len(truth) > 20)
    expected = simulated_torques(plant)
    np.testing.assert_array_equal(torques(commands), expected)
    assert np.any(expected != simulated_torques({'duration': 0.2}))
    P = states(truth, ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2'))[1][:, 0]
    np.testing.assert_allclose(P[[0, 2, 4], 1], 0.64 * np.array([0.5, 0.5 + 0.3 + 0.2, 0.7]))


def test_parameter_change_takes_effect_at_the_published_sample(ros):
    changes = ros.listen(topics.CHANGES)
    commands = ros.listen(topics.COMMANDS)
    ros.listen(topics.JOINT_STATES)
    ros.listen(topics.TRUTH)
    arm = ros.add(PlantNode, {'mode': 'lockstep', 'duration': 1.0, **OBSERVED})
    ros.add(ControllerNode, OBSERVED | QUIET)
    ros.until(lambda: arm.plant.sample > 50)
    request = SetParametersAtomically.Request()
    request.parameters = [Parameter(k, value=v).to_parameter_msg() for k, v in PUSHED.items()]
    response = ros.call(SetParametersAtomically, '/sim_plant/set_parameters_atomically', request)
    assert response.result.successful, response.result.reason
    ros.until(lambda: arm.finished and len(commands) == 1001)

    configured, change = [json.loads(message.data) for message in changes]
    assert configured['configured']
    assert change['parameters'] == PUSHED
    at = (change['stamp'] - LOCKSTEP_START) * 1e-9
    assert 0.05 < at < 1.0
    load = {f'events.{name.partition(".")[2]}': np.ravel(v).tolist() for name, v in PUSHED.items()}
    expected = simulated_torques({'duration': 1.0, 'events.begin': [at], **load})
    np.testing.assert_array_equal(torques(commands), expected)
