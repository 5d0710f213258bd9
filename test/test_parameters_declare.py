# SPDX-License-Identifier: Apache-2.0
"""A configuration as the parameters of a real node: declared, described, read, rejected."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy')

from rcl_interfaces.msg import ParameterType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import NODES, RecorderConfig, load_loop, locate
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change, parameters
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.nodes.parameters import declare, read


@pytest.fixture
def start(tmp_path):
    context = Context()
    context.init()
    nodes = []

    def node(name='sim_plant', text='', overrides=None, path=None):
        if text:
            path = tmp_path / 'arm.yaml'
            path.write_text(text)
        values = [Parameter(key, value=value) for key, value in (overrides or {}).items()]
        started = Node(
            name,
            context=context,
            cli_args=['--ros-args', '--params-file', str(path)] if path else None,
            parameter_overrides=values,
            enable_rosout=False,
        )
        nodes.append(started)
        return started

    yield node
    for started in nodes:
        started.destroy_node()
    context.shutdown()


def problems_of(node, cls):
    with pytest.raises(ConfigurationError) as caught:
        declare(node, cls)
    assert f'/{node.get_name()}' in str(caught.value)
    return caught.value.problems


@pytest.mark.parametrize('name', NODES)
def test_node_without_overrides_has_the_defaults(start, name):
    node, cls = start(name), NODES[name]
    assert declare(node, cls) == cls()
    assert read(node, cls) == cls()
    for parameter in parameters(cls):
        assert node.get_parameter(parameter.name).type_.name == parameter.kind.name


@pytest.mark.parametrize('preset', ['recommended', 'noisy'])
def test_node_reads_a_preset_like_an_offline_run(start, preset):
    loop = load_loop(preset)
    for name, config in loop.by_node.items():
        node = start(name, path=locate(preset))
        assert declare(node, type(config)) == config
        assert read(node, type(config)) == config


def test_parameters_have_descriptors(start):
    node = start('blf_dsc_controller')
    declare(node, ControllerConfig)
    bound = node.describe_parameter('barrier.bound')
    assert bound.description == 'k_c: bound on the tracking error [rad]'
    assert bound.type == ParameterType.PARAMETER_DOUBLE_ARRAY
    assert not bound.read_only
    assert bound.additional_constraints == 'above 0; as many entries as joints'
    window = node.describe_parameter('learning.window')
    assert window.read_only
    assert 'fixed at the start: it sets the memory size' in window.additional_constraints
    (limits,) = node.describe_parameter('sample_time').floating_point_range
    assert (limits.from_value, limits.to_value) == (1e-5, 1.0)
    (limits,) = node.describe_parameter('realtime.priority').integer_range
    assert (limits.from_value, limits.to_value) == (0, 99)
    assert node.describe_parameter('surface.time_constant').floating_point_range[0].from_value == 0


def test_empty_list_stays_empty_and_keeps_its_type_and_description(start):
    text = 'bag_recorder:\n  ros__parameters: {topics: [], output: here}\n'
    node = start('bag_recorder', text)
    assert declare(node, RecorderConfig) == RecorderConfig(output='here')
    assert read(node, RecorderConfig).topics == ()
    descriptor = node.describe_parameter('topics')
    assert (descriptor.type, descriptor.read_only) == (ParameterType.PARAMETER_STRING_ARRAY, True)
    assert descriptor.description == 'topics to record; empty: all'
    node = start('bag_recorder', overrides={'topics': ['/clock']})
    assert declare(node, RecorderConfig).topics == ('/clock',)


def test_all_problems_are_reported_at_once_and_nothing_is_declared(start):
    content = 'arm: {l1: 1}, seed: -1, mode: offline, sensr.resolution: 1.0, initial: {v: x}'
    node = start(text=f'sim_plant:\n  ros__parameters: {{{content}}}\n')
    assert problems_of(node, PlantConfig) == [
        'sensr.resolution: unknown parameter, did you mean sensor.resolution?',
        'initial.v: unknown parameter, did you mean initial.velocity?',
        "mode: got 'offline', but it must be one of realtime, lockstep",
        'seed: got -1, but it must be at least 0',
        'arm.l1: got 1, but a double is expected: write 1.0 instead of 1',
    ]
    assert not node.has_parameter('seed')


def test_parameters_of_other_nodes_and_of_ros_are_ignored(start):
    overrides = {
        'barrier.bound': [1.0, 1.0],
        'use_sim_time': True,
        'start_type_description_service': False,
        'qos_overrides./clock.subscription.depth': 1,
        'seed': 5,
    }
    node = start(overrides=overrides)
    assert declare(node, PlantConfig) == change(PlantConfig(), {'seed': 5})
    assert node.get_parameter('use_sim_time').value is True
