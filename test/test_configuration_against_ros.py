# SPDX-License-Identifier: Apache-2.0
"""The reader without ROS against ROS's own: a file must give a node the same parameters."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy')

from rclpy.context import Context
from rclpy.node import Node

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import dump, locate, read
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.errors import ConfigurationError


@pytest.fixture(scope='module')
def context():
    context = Context()
    context.init()
    yield context
    context.shutdown()


def with_ros(context, path, name):
    """Parameters that rcl reads for the node, or None if it rejects the file."""
    space, _, base = name.rpartition('/')
    try:
        node = Node(
            base,
            namespace=space,
            context=context,
            cli_args=['--ros-args', '--params-file', str(path)],
            enable_rosout=False,
            start_parameter_services=False,
        )
    except RuntimeError:
        return None
    values = {key: parameter.value for key, parameter in node._parameter_overrides.items()}
    node.destroy_node()
    return values


def without_ros(path, name):
    try:
        sections = read(path)
    except ConfigurationError:
        return None
    matching = [section for section in sections if section.matches(name)]
    return {key: entry.value for section in matching for key, entry in section.entries.items()}


PATTERNS = ('/**', '/*', 'n', '/s/n', '/s/*', '/s/**', '/**/n', '/*/n', '/*/*', 's/t/n', '/**/t/*')


@pytest.mark.parametrize('name', ['/n', '/s/n', '/s/t/n', '/m'])
def test_same_sections_apply(context, tmp_path, name):
    path = tmp_path / 'a.yaml'
    path.write_text(
        ''.join(
            f'{pattern}:\n  ros__parameters: {{own{index}: {index}, last: {index}}}\n'
            for index, pattern in enumerate(PATTERNS)
        )
    )
    values = without_ros(path, name)
    assert values
    assert values == with_ros(context, path, name)


WORDS = """
1e-5 1E3 .5 5. +5 0x1F -0x10 017 08 0x1p3 1e400 1e-400 1e-310 0e5 1.2.3 1e 0x 1d3 12abc 0b11 0o17
9223372036854775807 9223372036854775808 yes No y N on OFF true TRUE tRue 1_000 1:30 2020-01-01 null
.inf -.inf +.Inf inf -inf INF infinity nan .NaN -nan NAN 5. 1_000.5 e5 . -7 12 "1.0" 'yes' ~ '' ""
"""


def test_scalars_have_the_same_values(context, tmp_path):
    path = tmp_path / 'a.yaml'
    words = [*WORDS.split(), '!!str 1', '1 2', '>-\n      yes', '|\n      12']
    lines = [f'    a{index}: {word}\n' for index, word in enumerate(words)]
    path.write_text('n:\n  ros__parameters:\n' + ''.join(lines))
    ours, expected = without_ros(path, '/n'), with_ros(context, path, '/n')
    assert expected
    assert {key: repr(value) for key, value in ours.items()} == {
        key: repr(value) for key, value in expected.items()
    }


@pytest.mark.parametrize(
    'text',
    [
        'n:\n  a: 1\n',
        'n:\n',
        'n:\n  ros__parameters:\n',
        'n:\n  ros__parameters: {a: }\n',
        'n:\n  ros__parameters: {a: [1, 2.0]}\n',
        'n:\n  ros__parameters: {a: [[1], [2]]}\n',
        'n:\n  ros__parameters: {a: &x 1, b: *x}\n',
        'n:\n  ros__parameters: {a: 1}\n  m:\n    ros__parameters: {a: 1}\n',
        'n-1:\n  ros__parameters: {a: 1}\n',
        's:\n  /n:\n    ros__parameters: {a: 1}\n',
        '- 1\n',
        'n: [\n',
    ],
)
def test_files_rejected_by_ros_are_rejected(context, tmp_path, text):
    path = tmp_path / 'a.yaml'
    path.write_text(text)
    assert with_ros(context, path, '/n') is None
    assert without_ros(path, '/n') is None


@pytest.mark.parametrize('node', ['sim_plant', 'blf_dsc_controller', 'bag_recorder'])
@pytest.mark.parametrize('preset', ['panda', 'noisy'])
def test_presets_have_the_same_values(context, preset, node):
    ours = without_ros(locate(preset), f'/{node}')
    expected = with_ros(context, locate(preset), f'/{node}')
    # rclpy has no type for an empty list and leaves it unset.
    assert {key: value or None if value == [] else value for key, value in ours.items()} == expected


def test_ros_reads_a_dumped_configuration_exactly(context, tmp_path):
    path = tmp_path / 'run.yaml'
    config = ControllerConfig()
    dump(path, {'blf_dsc_controller': config})
    values = with_ros(context, path, '/blf_dsc_controller')
    # ROS has no type for an empty list, and returns no value.
    values = {name: [] if value is None else value for name, value in values.items()}
    found = {
        key: tuple(value) if isinstance(value, list) else value for key, value in values.items()
    }
    assert found == flatten(config)
