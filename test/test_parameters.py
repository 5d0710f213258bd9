# SPDX-License-Identifier: Apache-2.0
"""A configuration as the parameters of a real node: declared, described, changed, rejected."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy')

from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import NODES, RecorderConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change, parameters
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.nodes.parameters import declare, on_change, read


@pytest.mark.parametrize('name', NODES)
def test_node_without_overrides_has_the_defaults(bare_node, name):
    node, cls = bare_node(name), NODES[name]
    assert declare(node, cls) == cls()
    assert read(node, cls) == cls()
    for parameter in parameters(cls):
        assert node.get_parameter(parameter.name).type_.name == parameter.ros_type


def test_parameters_have_descriptors(bare_node):
    node = bare_node('blf_dsc_controller')
    declare(node, ControllerConfig)
    bound = node.describe_parameter('barrier.bound')
    assert bound.description == 'k_c: bound on the tracking error [rad]'
    assert bound.type == ParameterType.PARAMETER_DOUBLE_ARRAY
    assert not bound.read_only
    assert bound.additional_constraints == 'above 0; entries: joints'
    window = node.describe_parameter('learning.window')
    assert window.read_only
    assert 'fixed at the start: it sets the size' in window.additional_constraints
    (limits,) = node.describe_parameter('sample_time').floating_point_range
    assert (limits.from_value, limits.to_value) == (1e-5, 1.0)
    (limits,) = node.describe_parameter('realtime.priority').integer_range
    assert (limits.from_value, limits.to_value) == (0, 99)
    assert node.describe_parameter('surface.time_constant').floating_point_range[0].from_value == 0


def test_empty_list_stays_empty_and_keeps_its_type_and_description(bare_node, tmp_path):
    path = tmp_path / 'arm.yaml'
    path.write_text('bag_recorder:\n  ros__parameters: {topics: [], output: here}\n')
    node = bare_node('bag_recorder', path)
    assert declare(node, RecorderConfig) == RecorderConfig(output='here')
    assert read(node, RecorderConfig).topics == ()
    descriptor = node.describe_parameter('topics')
    assert (descriptor.type, descriptor.read_only) == (ParameterType.PARAMETER_STRING_ARRAY, True)
    assert descriptor.description == 'topics to record; empty: all'
    node = bare_node('bag_recorder', overrides={'topics': ['/clock']})
    assert declare(node, RecorderConfig).topics == ('/clock',)


def test_all_problems_are_reported_at_once_and_nothing_is_declared(bare_node, tmp_path):
    content = 'arm: {l1: 1}, seed: -1, mode: offline, sensr.resolution: 1.0, initial: {v: x}'
    path = tmp_path / 'arm.yaml'
    path.write_text(f'sim_plant:\n  ros__parameters: {{{content}}}\n')
    node = bare_node('sim_plant', path)
    with pytest.raises(ConfigurationError, match='/sim_plant') as caught:
        declare(node, PlantConfig)
    assert caught.value.problems == [
        'sensr.resolution: unknown parameter, did you mean sensor.resolution?',
        'initial.v: unknown parameter, did you mean initial.velocity?',
        "mode: got 'offline', but it must be one of realtime, lockstep",
        'seed: got -1, but it must be at least 0',
        'arm.l1: got 1, but a double is expected: write 1.0 instead of 1',
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

    def __init__(self, node):
        self.node, self.applied, self.problems = node, [], []
        declare(node, ControllerConfig)
        on_change(node, ControllerConfig, self.applied.append, lambda _: self.problems)

    def request(self, **given):
        """Send one atomic request; `__` stands for the dot."""
        values = {name.replace('__', '.'): value for name, value in given.items()}
        return self.node.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in values.items()]
        )

    @property
    def config(self):
        """The configuration that ROS holds now."""
        return read(self.node, ControllerConfig)


@pytest.fixture
def tuned(bare_node):
    return Tuned(bare_node('blf_dsc_controller'))


def test_valid_changes_are_passed_on_once_each_as_a_whole_configuration(tuned):
    assert tuned.request(feedback__gain=[70.0, 30.0], learning__weight=2.0).successful
    expected = change(ControllerConfig(), {'feedback.gain': (70.0, 30.0), 'learning.weight': 2.0})
    assert tuned.applied == [expected]
    assert tuned.config == expected
    tuned.request(disturbance__leakage=0.5)
    assert tuned.applied == [expected, change(expected, {'disturbance.leakage': 0.5})]


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ({'feedback__gain': [1.0]}, 'feedback.gain: got 1 entry, but 2 are needed (2 of joints)'),
        ({'barrier__bound': [0.0, 1.0]}, 'barrier.bound: got 0.0 at entry 1 of [0.0, 1.0]'),
        ({'learning__update': 'magic'}, "learning.update: got 'magic', but it must be one of"),
        ({'learning__radius': 0.1}, 'learning.radius: got 0.1 kg m^2, but learning.initial_est'),
        # ROS itself rejects these, by the descriptor of the parameter.
        ({'learning__weight': -1.0}, 'Parameter learning.weight out of range'),
        ({'learning__weight': float('inf')}, 'Parameter learning.weight out of range'),
        ({'learning__weight': 1}, 'Wrong parameter type, expected'),
    ],
)
def test_invalid_change_is_rejected_with_the_reason_and_none_of_it_applied(tuned, given, message):
    result = tuned.request(disturbance__gain=[3.0, 3.0], **given)
    assert not result.successful
    assert result.reason.startswith(message)
    assert tuned.applied == []
    assert tuned.config == ControllerConfig()


def test_changes_that_are_valid_only_together_are_applied_together(tuned):
    assert not tuned.request(barrier__weight=[3e4, 3e4]).successful
    assert tuned.request(barrier__weight=[3e4, 3e4], barrier__slope_limit=[5e4, 5e4]).successful
    assert tuned.applied[-1].barrier.weight == (3e4, 3e4)
    # Now the limit is validated against the current weight, not against the first one.
    assert not tuned.request(barrier__slope_limit=[2.5e4, 2.5e4]).successful


def test_node_can_reject_a_valid_configuration_of_its_own_parameters_only(tuned):
    tuned.problems = ['barrier.bound: joint1 is 0.0015 rad off now']
    result = tuned.request(barrier__bound=[0.001, 0.001])
    assert (result.successful, result.reason) == (False, tuned.problems[0])
    tuned.node.declare_parameter('lamp.on', value=False)
    assert tuned.request(lamp__on=True).successful
    assert tuned.applied == []
    tuned.problems = []
    assert tuned.request(barrier__bound=[0.001, 0.001]).successful
