# SPDX-License-Identifier: Apache-2.0
"""External interfaces of the nodes: namespaces, QoS, robot description, markers, policy."""

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
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_rig import deactivate
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.law.state import sample_of
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.endpoints import message_class
from blf_dsc_controller.nodes.markers_node import MarkersNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.simulation.loop import simulate

CONFIG = Path(__file__).parents[1] / 'config'


def alone(**parameters):
    """Torques of a loop that runs alone."""
    plant = build(PlantConfig, {'mode': 'lockstep', 'duration': 0.2, **parameters})
    record = simulate(ControllerConfig(), plant)
    rows = record.samples
    return np.array([sample_of(row, record.controller.settings).torque for row in rows])


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
        expected = alone(seed=seed, **{'sensor.position_noise': 1e-5})
        np.testing.assert_array_equal(torques, expected)
    assert not np.array_equal(received['left'][-1].data, received['right'][-1].data)


def test_standard_parameters_override_qos(ros):
    ros.add(PlantNode, **{'qos_overrides./joint_states.publisher.reliability': 'best_effort'})
    ros.add(
        ControllerNode, **{'qos_overrides./joint_states.subscription.reliability': 'best_effort'}
    )
    ros.until(lambda: ros.tester.count_publishers('/joint_states'))
    ros.until(lambda: ros.tester.count_subscribers('/joint_states'))
    (publisher,) = ros.tester.get_publishers_info_by_topic('/joint_states')
    (subscriber,) = ros.tester.get_subscriptions_info_by_topic('/joint_states')
    for endpoint in (publisher, subscriber):
        assert endpoint.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT


def test_late_subscribers_receive_the_robot_description(ros):
    ros.add(PlantNode, arm__l2=0.6)
    ros.spin(0.1)
    received = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    ros.tester.create_subscription(String, 'robot_description', received.append, latched)
    ros.until(lambda: received)
    assert received[0].data.startswith('<robot name="sim_plant">')
    assert 'length="0.6"' in received[0].data


def test_markers_show_reference_bound_and_torque(ros):
    received = []
    ros.tester.create_subscription(MarkerArray, 'arm_markers/markers', received.append, 10)
    ros.add(MarkersNode, period=0.02)
    arm, law = ros.loop()
    ros.run(arm, 300)
    assert deactivate(ros, arm)  # stops the clock
    ros.until(lambda: law.guard.journal.stamp == arm.stamp)
    q = law.guard.controller.signals.qr
    tip_x = np.cos(q[0]) + 0.8 * np.cos(q.sum())

    def drawn():
        """Whether the last markers show the last state."""
        found = {marker.ns: marker for marker in received[-1].markers} if received else {}
        return len(found) == 3 and abs(found['reference'].points[-1].x - tip_x) < 1e-12

    ros.until(drawn)
    count = len(received)
    ros.until(lambda: len(received) > count + 1)
    by_kind = {marker.ns: marker for marker in received[-1].markers}
    # The arm leans back: negative torques about -y pull it forward, so the arrows point to +y.
    arrows = [marker.points[1].y for marker in received[-1].markers if marker.ns == 'torque']
    torque = arm.plant.measure()[4:]
    assert torque.max() < -1.0
    np.testing.assert_allclose(arrows, -0.05 * torque)
    tip = by_kind['reference'].points[-1]
    q = law.guard.controller.signals.qr
    expected = (np.cos(q[0]) + 0.8 * np.cos(q.sum()), np.sin(q[0]) + 0.8 * np.sin(q.sum()))
    np.testing.assert_allclose((tip.x, tip.z), expected)
    assert by_kind['bound'].pose.position == tip
    reach = np.sqrt(1.0 + 0.64 + 1.6 * np.cos(q[1])) + 0.8
    assert by_kind['bound'].scale.x == pytest.approx(2 * 0.002 * reach, rel=1e-9)
    assert {marker.header.frame_id for marker in received[-1].markers} == {'base_link'}


def test_markers_of_a_urdf_use_its_frames(ros):
    received = []
    ros.tester.create_subscription(MarkerArray, 'arm_markers/markers', received.append, 10)
    parameters = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}
    ros.add(MarkersNode, parameters, period=0.02)
    ros.add(PlantNode, parameters, mode='lockstep')
    ros.until(lambda: received)
    arrows = [marker for marker in received[-1].markers if marker.ns == 'torque']
    assert len(arrows) == 7
    assert {arrow.header.frame_id for arrow in arrows} == {'panda_link0'}
    shoulder = arrows[1].points[0]
    np.testing.assert_allclose((shoulder.x, shoulder.y, shoulder.z), (0.0, 0.0, 0.333), atol=1e-9)


def test_sros2_policy_grants_each_node_exactly_what_it_uses(tmp_path):
    """In a separate process: rcl publishes /rosout once per node name and process."""
    live = tmp_path / 'policy.xml'
    subprocess.run([sys.executable, sros2_graph.__file__, live], check=True, capture_output=True)
    hint = 'run: python test/sros2_graph.py config/sros2_policy.xml'
    assert sros2_graph.read(CONFIG / 'sros2_policy.xml') == sros2_graph.read(live), hint


def test_viewer_configurations_name_existing_topics():
    rviz = yaml.safe_load((CONFIG / 'arm.rviz').read_text())
    displays = rviz['Visualization Manager']['Displays']
    assert {d['Topic']['Value'] for d in displays if 'Topic' in d} == {'arm_markers/markers'}
    layout = json.loads((CONFIG / 'foxglove.json').read_text())
    known = {t.resolved for t in topics.TOPICS} | {'/robot_description', '/arm_markers/markers'}
    used = [
        path['value'].split('.')[0]
        for panel in layout['configById'].values()
        for path in panel.get('paths', [])
    ]
    used += [layout['configById']['RawMessages!state']['topicPath']]
    used += list(layout['configById']['3D!arm']['topics'])
    assert set(used) <= known
