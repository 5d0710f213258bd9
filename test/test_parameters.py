# SPDX-License-Identifier: Apache-2.0
"""Interfaces of real nodes: parameters declared, described and changed; QoS.

Policy; viewers.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

import sros2_graph
import yaml
from random_arm import random_urdf
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from std_msgs.msg import String

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import NODES
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change, flatten, parameters
from blf_dsc_controller.configuration.side_nodes import RecorderConfig
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.nodes import parameters as node_parameters
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.nodes.parameters import declare, on_change, read
from blf_dsc_controller.nodes.plant_node import PlantNode


@pytest.mark.parametrize('name', NODES)
def test_node_without_overrides_has_the_defaults(bare_node, name):
    node, cls = bare_node(name), NODES[name]
    config = declare(node, cls)
    assert config == build(cls, {})
    assert read(node, type(config)) == config
    for parameter in parameters(type(config)):
        assert node.get_parameter(parameter.name).type_.name == parameter.ros_type


def test_parameters_have_descriptors(bare_node):
    node = bare_node('blf_dsc_controller')
    declare(node, ControllerConfig)
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


def test_empty_lists_that_only_some_laws_have_stay_empty(bare_node, tmp_path):
    path = tmp_path / 'config.yaml'
    path.write_text(
        'blf_dsc_controller:\n  ros__parameters:\n    law: slotine_li\n'
        '    gains: {integral_gain: []}\n    truth: {parameters: []}\n'
    )
    node = bare_node('blf_dsc_controller', path)
    config = declare(node, ControllerConfig)
    for name in ('gains.integral_gain', 'truth.parameters'):
        assert not flatten(config)[name]
        assert node.get_parameter(name).type_.name == 'DOUBLE_ARRAY'
    assert read(node, type(config)) == config


def test_empty_list_stays_empty_and_keeps_its_type_and_description(bare_node, tmp_path):
    path = tmp_path / 'arm.yaml'
    path.write_text('bag_recorder:\n  ros__parameters: {topics: [], output: here}\n')
    node = bare_node('bag_recorder', path)
    assert declare(node, RecorderConfig) == RecorderConfig(output='here')
    assert read(node, RecorderConfig).topics == ()
    descriptor = node.describe_parameter('topics')
    assert descriptor.type == ParameterType.PARAMETER_STRING_ARRAY
    assert descriptor.description == 'topics to record; empty: all'
    (result,) = node.set_parameters([Parameter('topics', value=['/clock'])])
    assert result.reason.startswith(
        'topics is fixed at the start: a bag is opened once'
    )
    node = bare_node('bag_recorder', overrides={'topics': ['/clock']})
    assert declare(node, RecorderConfig).topics == ('/clock',)


def test_all_problems_are_reported_at_once_and_nothing_is_declared(bare_node, tmp_path):
    content = (
        'arm: {l1: 1}, seed: -1, mode: offline, sensr.resolution: 1.0, initial: {v: x}'
    )
    path = tmp_path / 'arm.yaml'
    path.write_text(f'sim_plant:\n  ros__parameters: {{{content}}}\n')
    node = bare_node('sim_plant', path)
    with pytest.raises(ConfigurationError, match='/sim_plant') as caught:
        declare(node, PlantConfig)
    assert caught.value.problems == [
        'sensr.resolution: unknown parameter, did you mean sensor.resolution?',
        'initial.v: unknown parameter, did you mean initial.velocity?',
        'mode: got "offline", but it must be one of realtime, lockstep',
        'seed: got -1, but it must be at least 0 and at most 9223372036854775807',
        'arm.l1: got 1, but a double is expected, with a decimal point',
    ]
    assert not node.has_parameter('seed')


def test_parameters_of_other_nodes_and_of_ros_are_ignored(bare_node):
    overrides = {
        'barrier.bound': [1.0, 1.0],
        'use_sim_time': True,
        'start_type_description_service': False,
        'qos_overrides./clock.subscription.depth': 1,
        'seed': 5,
    }
    node = bare_node('sim_plant', overrides=overrides)
    assert declare(node, PlantConfig) == change(PlantConfig(), {'seed': 5})
    assert node.get_parameter('use_sim_time').value is True


class Tuned:
    """A node that accepts changes, and the configurations it applied."""

    def __init__(self, bare_node):
        self.node = bare_node('blf_dsc_controller')
        self.applied = []
        self.problems = []
        self.begun = declare(self.node, ControllerConfig)
        cls = type(self.begun)
        on_change(self.node, cls, self.applied.append, lambda _: self.problems)

    def request(self, **given):
        """Send one atomic request; `__` stands for the dot."""
        changes = [Parameter(k.replace('__', '.'), value=v) for k, v in given.items()]
        return self.node.set_parameters_atomically(changes)

    @property
    def config(self):
        """The configuration that ROS holds now."""
        return read(self.node, type(self.begun))


@pytest.fixture
def tuned(bare_node):
    return Tuned(bare_node)


def test_valid_changes_are_passed_on_once_each_as_a_whole_configuration(tuned):
    assert tuned.request(
        two_link__feedback_gain=[70.0, 30.0], two_link__learning_weight=2.0
    ).successful
    expected = change(
        tuned.begun,
        {'two_link.feedback_gain': (70.0, 30.0), 'two_link.learning_weight': 2.0},
    )
    assert tuned.applied == [expected]
    assert tuned.config == expected
    tuned.request(two_link__leakage=0.5)
    assert tuned.applied == [expected, change(expected, {'two_link.leakage': 0.5})]


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
    tuned, given, message
):
    result = tuned.request(disturbance__gain=[3.0, 3.0], **given)
    assert not result.successful
    assert result.reason.startswith(message)
    assert tuned.applied == []
    assert tuned.config == tuned.begun


def test_changes_that_are_valid_only_together_are_applied_together(tuned):
    lower = [2.0 * math.pi + 0.1] * 2
    assert not tuned.request(limits__position_lower=lower).successful
    upper = [8.0, 8.0]
    assert tuned.request(
        limits__position_lower=lower, limits__position_upper=upper
    ).successful
    assert tuned.applied[-1].limits.position_upper == (8.0, 8.0)
    # Now it is validated against the current limit, not against the first one.
    assert not tuned.request(limits__position_upper=[6.0, 6.0]).successful


def test_node_can_reject_a_valid_configuration_of_its_own_parameters_only(tuned):
    tuned.problems = ['barrier.bound: joint1 is 0.0015 rad off now']
    result = tuned.request(barrier__bound=[0.001, 0.001])
    assert (result.successful, result.reason) == (False, tuned.problems[0])
    tuned.node.declare_parameter('lamp.on', value=False)
    assert tuned.request(lamp__on=True).successful
    assert tuned.applied == []
    tuned.problems = []
    assert tuned.request(barrier__bound=[0.001, 0.001]).successful


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
    assert node.config == build(ControllerConfig, ON_TOPIC | {'robot.urdf': TEXT})
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
        publish(ros, 'robot_description', Quality(1, 'reliable', 'volatile'))
        ros.until(lambda: ros.tester.count_publishers('/robot_description') == 1)
    expected = f'within 1 s on /robot_description, which has {publishers} publishers'
    with pytest.raises(ConfigurationError, match=expected):
        ros.add(ControllerNode, ON_TOPIC)


@pytest.mark.parametrize(
    'text', ['{file}', '<mujoco><include file="{file}"/></mujoco>', ' ']
)
def test_text_on_the_topic_that_is_no_urdf_is_refused(ros, tmp_path, text):
    """Anybody can send it: no file that it names is read, by MuJoCo neither."""
    file = tmp_path / 'arm.urdf'
    file.write_text(TEXT)
    publish(ros, 'robot_description', text=text.format(file=file))
    with pytest.raises(ConfigurationError, match=r'robot\.urdf: .*/robot_description'):
        ros.add(ControllerNode, ON_TOPIC)


def test_topic_is_rejected_outside_a_node():
    with pytest.raises(
        ConfigurationError,
        match=r'robot.urdf: .* only a node can read: .* data robot_description > arm',
    ):
        build(ControllerConfig, ON_TOPIC)


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


def test_viewer_configurations_name_existing_topics():
    rviz = yaml.safe_load((CONFIG / 'arm.rviz').read_text())
    displays = rviz['Visualization Manager']['Displays']
    assert {
        d['Description Topic']['Value'] for d in displays if 'Description Topic' in d
    } == {'robot_description'}
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
