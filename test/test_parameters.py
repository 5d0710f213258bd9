# SPDX-License-Identifier: Apache-2.0
"""Interfaces of real nodes: parameters declared, described and changed; QoS.

Policy; viewers.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

import sros2_graph
from random_arm import random_urdf
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from std_msgs.msg import String

import blf_dsc_controller as blf
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes import parameters as node_parameters
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.recorder_node import BagRecorderNode


@pytest.fixture
def node(ros):
    """Return a controller that is not configured yet."""
    return ros.add(ControllerNode, autostart=False)


def change(node, **given):
    """Send one atomic request; `__` stands for the dot."""
    changes = [Parameter(k.replace('__', '.'), value=v) for k, v in given.items()]
    return node.set_parameters_atomically(changes)


def test_parameters_have_descriptors(node):
    bound = node.describe_parameter('barrier.bound')
    assert bound.description == 'k_c: bound on the tracking error [rad]'
    assert bound.type == ParameterType.PARAMETER_DOUBLE_ARRAY
    assert bound.additional_constraints == 'above 0; entries: joints'
    window = node.describe_parameter('learning.window')
    assert 'fixed at the start: it sets the size' in window.additional_constraints
    sample_time = node.describe_parameter('sample_time')
    assert sample_time.additional_constraints.startswith(
        'at least 1e-05 and at most 1; fixed at'
    )


def test_node_may_be_based_on_a_preset(ros):
    node = ros.add(ControllerNode, autostart=False, base='ur5e', robot__payload=1.0)
    given = {'robot.payload': 1.0, 'autostart': False}
    wanted = blf.load_loop('ur5e', {'blf_dsc_controller': given}).controller
    assert node.config == wanted


def test_empty_list_keeps_its_type_and_description(ros, tmp_path):
    recorder = ros.add(BagRecorderNode, output=str(tmp_path / 'bag'))
    assert recorder.get_parameter('topics').value == []
    descriptor = recorder.describe_parameter('topics')
    assert descriptor.type == ParameterType.PARAMETER_STRING_ARRAY
    assert descriptor.description == 'topics to record; empty: all'
    result = change(recorder, topics=['/clock'])
    assert result.reason.startswith(
        'topics is fixed at the start: a bag is opened once'
    )


def test_all_problems_of_a_node_are_reported_at_once(ros):
    given = {'arm.l1': 1, 'seed': -1, 'mode': 'offline', 'sensr.resolution': 1.0}
    with pytest.raises(blf.ConfigurationError, match='/sim_plant') as caught:
        ros.add(PlantNode, given)
    assert caught.value.problems == [
        'sensr.resolution: unknown parameter, did you mean sensor.resolution?',
        'mode: got "offline", but it must be one of realtime, lockstep',
        'seed: got -1, but it must be at least 0 and at most 9223372036854775807',
        'arm.l1: got 1, but a double is expected, with a decimal point',
    ]


def test_valid_changes_are_adopted_together(node):
    begun = node.config
    given = {'limits.position_lower': [6.4] * 2, 'limits.position_upper': [8.0] * 2}
    assert not change(node, limits__position_lower=[6.4] * 2).successful
    assert change(
        node, limits__position_lower=[6.4] * 2, limits__position_upper=[8.0] * 2
    ).successful
    assert node.config == blf.change(begun, given)
    # Now it is validated against the current limit, not against the first one.
    assert not change(node, limits__position_upper=[6.0] * 2).successful


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        (
            {'two_link__feedback_gain': [1.0]},
            'two_link.feedback_gain: got 1, but 2 entries are needed (2 of joints)',
        ),
        # ROS itself rejects this, by the descriptor of the parameter.
        ({'two_link__learning_weight': 1}, 'Wrong parameter type, expected'),
    ],
)
def test_invalid_change_is_rejected_with_the_reason_and_none_of_it_applied(
    node, given, message
):
    begun = node.config
    result = change(node, disturbance__gain=[3.0, 3.0], **given)
    assert not result.successful
    assert result.reason.startswith(message)
    assert node.config == begun
    held = node.get_parameter('disturbance.gain').value
    assert list(held) == list(begun.disturbance.gain)


# The URDF on a latched topic: the node waits for it and uses it as if given as a file.

TEXT = random_urdf(3, seed=5)[0]
ON_TOPIC = {
    'robot.urdf': 'topic://robot_description',
    'robot.tip': 'tip',
    'autostart': False,
}


def publish(ros, topic, quality=topics.ROBOT_DESCRIPTION.offered, text=TEXT):
    publisher = ros.tester.create_publisher(String, topic, qos_profile(quality))
    publisher.publish(String(data=text))


def test_controller_uses_the_published_urdf(ros):
    ros.add(PlantNode, {'robot.urdf': TEXT, 'robot.tip': 'tip'})
    node = ros.add(ControllerNode, ON_TOPIC)
    assert node.config == build(blf.ControllerConfig, ON_TOPIC | {'robot.urdf': TEXT})
    assert node.get_parameter('robot.urdf').value == TEXT  # the recorder reads it


def test_topic_is_in_the_namespace_of_the_node_unless_it_begins_with_a_slash(ros):
    publish(ros, '/left/robot_description')
    publish(ros, '/elsewhere')
    for urdf in ('topic://robot_description', 'topic:///elsewhere'):
        node = ros.add(PlantNode, ON_TOPIC | {'robot.urdf': urdf}, namespace='left')
        assert node.config.robot.urdf == TEXT
        ros.kill(node)


@pytest.mark.parametrize('publishers', [0, 1])
def test_urdf_that_is_missing_or_not_latched_is_reported(ros, monkeypatch, publishers):
    monkeypatch.setattr(node_parameters, 'TIMEOUT', 1)
    if publishers:
        publish(ros, 'robot_description', topics.Quality(1, 'reliable', 'volatile'))
        ros.until(lambda: ros.tester.count_publishers('/robot_description') == 1)
    expected = f'within 1 s on /robot_description, which has {publishers} publishers'
    with pytest.raises(blf.ConfigurationError, match=expected):
        ros.add(ControllerNode, ON_TOPIC)


@pytest.mark.parametrize(
    'text', ['{file}', '<mujoco><include file="{file}"/></mujoco>', ' ']
)
def test_text_on_the_topic_that_is_no_urdf_is_refused(ros, tmp_path, text):
    """Anybody can send it: no file that it names is read, by MuJoCo neither."""
    file = tmp_path / 'arm.urdf'
    file.write_text(TEXT)
    publish(ros, 'robot_description', text=text.format(file=file))
    with pytest.raises(
        blf.ConfigurationError, match=r'robot\.urdf: .*/robot_description'
    ):
        ros.add(ControllerNode, ON_TOPIC)


def test_standard_parameters_override_qos(ros):
    for node, end in ((PlantNode, 'publisher'), (ControllerNode, 'subscription')):
        ros.add(node, {f'qos_overrides./joint_states.{end}.reliability': 'best_effort'})
    ros.until(lambda: ros.tester.count_publishers('/joint_states'))
    ros.until(lambda: ros.tester.count_subscribers('/joint_states'))
    (publisher,) = ros.tester.get_publishers_info_by_topic('/joint_states')
    (subscriber,) = ros.tester.get_subscriptions_info_by_topic('/joint_states')
    for endpoint in (publisher, subscriber):
        assert endpoint.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT


# Files for other programs, which name the interfaces of the nodes.

CONFIG = Path(__file__).parents[1] / 'config'


def test_sros2_policy_grants_each_node_exactly_what_it_uses(tmp_path):
    """In a separate process: rcl publishes /rosout once per node name and process."""
    live = tmp_path / 'policy.xml'
    subprocess.run(
        [sys.executable, sros2_graph.__file__, live], check=True, capture_output=True
    )
    hint = 'run: python test/sros2_graph.py config/sros2_policy.xml'
    assert (CONFIG / 'sros2_policy.xml').read_text() == live.read_text(), hint
