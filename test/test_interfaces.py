# SPDX-License-Identifier: Apache-2.0
"""What others see of the nodes: namespaces, qualities of service, description, markers, policy."""

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
from blf_dsc_controller.simulation.loop import simulate
from sim_plant.node import PlantNode

CONFIG = Path(__file__).parents[1] / 'config'


def alone(**given):
    """Torques of a loop that nobody else is near."""
    plant = build(PlantConfig, {'mode': 'lockstep', 'duration': 0.2, **given})
    record = simulate(ControllerConfig(), plant)
    rows = record.samples
    return np.array([sample_of(row, record.controller.settings).torque for row in rows])


def test_two_arms_in_one_domain_do_not_hear_each_other(ros):
    """Each runs as if it were alone, bit for bit; their noise tells them apart."""
    noise = {'sensor__position_noise': 1e-5}
    law = {'wait_for_subscribers': 1, 'telemetry__enabled': False}
    arms, heard = {}, {}
    for seed, side in enumerate(('left', 'right')):
        name = f'/{side}/blf_dsc_controller/commands'
        heard[side] = []
        ros.tester.create_subscription(
            message_class(topics.COMMANDS.type), name, heard[side].append, QoSProfile(depth=1000)
        )
        plant = {'seed': seed, 'duration': 0.2, **noise}
        arms[side], _ = ros.loop(plant, law, namespace=side)
    ros.until(lambda: all(len(one) == 201 for one in heard.values()))
    for seed, side in enumerate(heard):
        torques = np.array([message.data for message in heard[side]])
        expected = alone(seed=seed, **{'sensor.position_noise': 1e-5})
        np.testing.assert_array_equal(torques, expected)
    assert not np.array_equal(heard['left'][-1].data, heard['right'][-1].data)


def test_qualities_of_service_are_overridden_in_the_standard_way(ros):
    ros.add(PlantNode, **{'qos_overrides./joint_states.publisher.reliability': 'best_effort'})
    ros.add(
        ControllerNode, **{'qos_overrides./joint_states.subscription.reliability': 'best_effort'}
    )
    ros.until(lambda: ros.tester.count_publishers('/joint_states'))
    ros.until(lambda: ros.tester.count_subscribers('/joint_states'))
    (publisher,) = ros.tester.get_publishers_info_by_topic('/joint_states')
    (subscriber,) = ros.tester.get_subscriptions_info_by_topic('/joint_states')
    for end in (publisher, subscriber):
        assert end.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT


def test_the_description_waits_for_whoever_comes_late(ros):
    ros.add(PlantNode, arm__l2=0.6)
    ros.spin(0.1)
    heard = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    ros.tester.create_subscription(String, 'robot_description', heard.append, latched)
    ros.until(lambda: heard)
    assert heard[0].data.startswith('<robot name="sim_plant">')
    assert 'length="0.6"' in heard[0].data


def test_markers_show_reference_bound_and_torque(ros):
    heard = []
    ros.tester.create_subscription(MarkerArray, 'arm_markers/markers', heard.append, 10)
    ros.add(MarkersNode, period=0.02)
    arm, law = ros.loop()
    ros.run(arm, 300)
    assert deactivate(ros, arm)  # time stands still
    ros.until(lambda: law.guard.journal.stamp == arm.stamp)
    q = law.guard.controller.signals.qr
    tip_x = np.cos(q[0]) + 0.8 * np.cos(q.sum())

    def drawn():
        """Whether the last markers are of the last state."""
        found = {one.ns: one for one in heard[-1].markers} if heard else {}
        return len(found) == 3 and abs(found['reference'].points[-1].x - tip_x) < 1e-12

    ros.until(drawn)
    count = len(heard)
    ros.until(lambda: len(heard) > count + 1)
    by_kind = {marker.ns: marker for marker in heard[-1].markers}
    # The arm leans back: both joints pull it forward with a negative torque, about -y, hence to +y.
    arrows = [marker.points[1].y for marker in heard[-1].markers if marker.ns == 'torque']
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
    assert {marker.header.frame_id for marker in heard[-1].markers} == {'base_link'}


def test_markers_of_a_urdf_are_in_its_frames(ros):
    heard = []
    ros.tester.create_subscription(MarkerArray, 'arm_markers/markers', heard.append, 10)
    given = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}
    ros.add(MarkersNode, given, period=0.02)
    ros.add(PlantNode, given, mode='lockstep')
    ros.until(lambda: heard)
    arrows = [marker for marker in heard[-1].markers if marker.ns == 'torque']
    assert len(arrows) == 7
    assert {arrow.header.frame_id for arrow in arrows} == {'panda_link0'}
    shoulder = arrows[1].points[0]
    np.testing.assert_allclose((shoulder.x, shoulder.y, shoulder.z), (0.0, 0.0, 0.333), atol=1e-9)


def test_the_policy_grants_each_node_what_it_has_and_nothing_else(tmp_path):
    """In a process of its own: rcl publishes /rosout once for all nodes of a name in a process."""
    live = tmp_path / 'policy.xml'
    subprocess.run([sys.executable, sros2_graph.__file__, live], check=True, capture_output=True)
    hint = 'run: python test/sros2_graph.py config/sros2_policy.xml'
    assert sros2_graph.read(CONFIG / 'sros2_policy.xml') == sros2_graph.read(live), hint


def test_the_configurations_of_viewers_name_topics_there_are():
    rviz = yaml.safe_load((CONFIG / 'arm.rviz').read_text())
    shown = rviz['Visualization Manager']['Displays']
    assert {one['Topic']['Value'] for one in shown if 'Topic' in one} == {'arm_markers/markers'}
    layout = json.loads((CONFIG / 'foxglove.json').read_text())
    known = {one.resolved for one in topics.TOPICS} | {'/robot_description', '/arm_markers/markers'}
    used = [
        path['value'].split('.')[0]
        for panel in layout['configById'].values()
        for path in panel.get('paths', [])
    ]
    used += [layout['configById']['RawMessages!state']['topicPath']]
    used += list(layout['configById']['3D!arm']['topics'])
    assert set(used) <= known
