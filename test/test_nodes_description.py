# SPDX-License-Identifier: Apache-2.0
"""The URDF on a latched topic: the node waits for it and uses it as if given as a file."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from random_arm import random_urdf
from std_msgs.msg import String

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.nodes import parameters
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.nodes.plant_node import PlantNode

TEXT = random_urdf(3, seed=5)[0]
ON_TOPIC = {'robot.urdf': 'topic://robot_description', 'robot.tip': 'tip', 'autostart': False}


def publish(ros, topic, quality=topics.ROBOT_DESCRIPTION.offered):
    publisher = ros.tester.create_publisher(String, topic, qos_profile(quality))
    publisher.publish(String(data=TEXT))


def test_controller_uses_the_published_urdf(ros):
    ros.add(PlantNode, {'robot.urdf': TEXT, 'robot.tip': 'tip'})
    node = ros.add(ControllerNode, ON_TOPIC)
    assert node.config == build(ControllerConfig, ON_TOPIC | {'robot.urdf': TEXT})
    assert node.get_parameter('robot.urdf').value == TEXT  # the recorder reads it


def test_topic_is_in_the_namespace_of_the_node_unless_it_begins_with_a_slash(ros):
    publish(ros, '/left/robot_description')
    publish(ros, '/elsewhere')
    for urdf in ('topic://robot_description', 'topic:///elsewhere'):
        node = ros.add(PlantNode, ON_TOPIC | {'robot.urdf': urdf}, namespace='left')
        assert node.config.robot.urdf == TEXT
        ros.kill(node)


@pytest.mark.parametrize(
    ('publishers', 'hint'), [(0, 'nobody publishes there'), (1, 'may not be latched')]
)
def test_missing_urdf_is_reported_with_a_hint(ros, monkeypatch, publishers, hint):
    monkeypatch.setattr(parameters, 'TIMEOUT', 1)
    if publishers:
        publish(ros, 'robot_description', Quality(1, 'reliable', 'volatile'))
        ros.until(lambda: ros.tester.count_publishers('/robot_description') == 1)
    with pytest.raises(ConfigurationError, match=f'/robot_description within 1 s, and .*{hint}'):
        ros.add(ControllerNode, ON_TOPIC)


def test_topic_is_rejected_outside_a_node():
    with pytest.raises(ConfigurationError, match=r'robot.urdf: .* is a topic, which only a node'):
        build(ControllerConfig, ON_TOPIC)
