# SPDX-License-Identifier: Apache-2.0
"""External interfaces of the nodes: namespaces, QoS, policy."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import sros2_graph
import yaml
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_rig import simulated

from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.endpoints import message_class
from blf_dsc_controller.nodes.plant_node import PlantNode

CONFIG = Path(__file__).parents[1] / 'config'


def test_two_arms_in_one_domain_do_not_interfere(ros):
    """Each runs as if it were alone, bit for bit; they differ in their noise."""
    noise = {'sensor__position_noise': 1e-5}
    law = {'wait_for_subscribers': 1, 'telemetry__enabled': False}
    arms, received = {}, {}
    for seed, side in enumerate(('left', 'right')):
        name = f'/{side}/blf_dsc_controller/commands'
        received[side] = []
        ros.tester.create_subscription(
            message_class(topics.COMMANDS.type), name, received[side].append, QoSProfile(depth=1000)
        )
        plant = {'seed': seed, 'duration': 0.2, **noise}
        arms[side], _ = ros.loop(plant, law, namespace=side)
    ros.until(lambda: all(len(messages) == 201 for messages in received.values()))
    for seed, side in enumerate(received):
        torques = np.array([message.data for message in received[side]])
        alone = simulated({'seed': seed, 'duration': 0.2, 'sensor.position_noise': 1e-5})
        np.testing.assert_array_equal(torques, alone.torque)
    assert not np.array_equal(received['left'][-1].data, received['right'][-1].data)


def test_standard_parameters_override_qos(ros):
    for node, end in ((PlantNode, 'publisher'), (ControllerNode, 'subscription')):
        ros.add(node, {f'qos_overrides./joint_states.{end}.reliability': 'best_effort'})
    ros.until(lambda: ros.tester.count_publishers('/joint_states'))
    ros.until(lambda: ros.tester.count_subscribers('/joint_states'))
    (publisher,) = ros.tester.get_publishers_info_by_topic('/joint_states')
    (subscriber,) = ros.tester.get_subscriptions_info_by_topic('/joint_states')
    for endpoint in (publisher, subscriber):
        assert endpoint.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT


def test_sros2_policy_grants_each_node_exactly_what_it_uses(tmp_path):
    """In a separate process: rcl publishes /rosout once per node name and process."""
    live = tmp_path / 'policy.xml'
    subprocess.run([sys.executable, sros2_graph.__file__, live], check=True, capture_output=True)
    hint = 'run: python test/sros2_graph.py config/sros2_policy.xml'
    assert (CONFIG / 'sros2_policy.xml').read_text() == live.read_text(), hint


def test_viewer_configurations_name_existing_topics():
    rviz = yaml.safe_load((CONFIG / 'arm.rviz').read_text())
    displays = rviz['Visualization Manager']['Displays']
    assert {d['Description Topic']['Value'] for d in displays if 'Description Topic' in d} == {
        'robot_description'
    }
    layout = json.loads((CONFIG / 'foxglove.json').read_text())
    known = {t.resolved for t in topics.TOPICS} | {'/robot_description'}
    used = [
        path['value'].split('.')[0]
        for panel in layout['configById'].values()
        for path in panel.get('paths', [])
    ]
    used += [layout['configById']['RawMessages!state']['topicPath']]
    scene = layout['configById']['3D!arm']
    used += [*scene['topics'], scene['layers']['urdf']['jointStatesTopic']]
    assert set(used) <= known
