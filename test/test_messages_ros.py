# SPDX-License-Identifier: Apache-2.0
"""Our serialisation and that of rclpy are interchangeable, in both directions."""

from __future__ import annotations

import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayDecoder,
    Float64MultiArrayEncoder,
    JointStateDecoder,
    JointStateEncoder,
    definition,
    joint_state_layout,
)
from blf_dsc_controller.messages.topics import TOPICS
from blf_dsc_controller.nodes.endpoints import message_class

STAMP = 1_734_000_123_456_789_012
CASES = [
    ('', ['j']),
    ('b', ['joint1', 'joint2']),
    ('base', ['a', 'bc', 'def', 'ghij', 'klmno']),
    ('world', ['disturbance joint1', '(m1+m2)*l1^2', '']),
]


@pytest.fixture
def node():
    context = Context()
    rclpy.init(context=context)
    node = Node('types', context=context, start_parameter_services=False)
    yield node
    node.destroy_node()
    context.try_shutdown()


@pytest.mark.parametrize('type_name', sorted({topic.type for topic in TOPICS}))
def test_type_hashes_are_those_of_ros(node, type_name):
    topic = '/hashed/' + type_name
    node.create_publisher(message_class(type_name), topic, 1)
    deadline = time.monotonic() + 300.0
    while not (publishers := node.get_publishers_info_by_topic(topic)):
        assert time.monotonic() < deadline, 'the graph does not show the publisher'
        time.sleep(0.01)
    assert str(publishers[0].topic_type_hash) == definition(type_name)[1]


def message_of(frame_id, names):
    message = JointState()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(STAMP, 10**9)
    message.header.frame_id = frame_id
    message.name = names
    message.position = [0.1 + index for index in range(len(names))]
    message.velocity = [-0.2 * index for index in range(len(names))]
    message.effort = [1e300 / (index + 1) for index in range(len(names))]
    return message


def without_padding(raw):
    """The meaningful pieces of a JointState: rclpy leaves its padding bytes uninitialised."""
    layout = joint_state_layout(raw)
    return [raw[:2], raw[4:12], layout.names] + [
        raw[array.offset : array.offset + 8 * array.size] for array in layout.arrays
    ]


@pytest.mark.parametrize(('frame_id', 'names'), CASES)
def test_each_reads_what_the_other_serialises(frame_id, names):
    message = message_of(frame_id, names)
    raw = JointStateEncoder(names, frame_id=frame_id).encode(
        STAMP, message.position, message.velocity, message.effort
    )
    assert deserialize_message(raw, JointState) == message
    expected = serialize_message(message)
    assert len(raw) == len(expected)
    assert without_padding(raw) == without_padding(expected)
    decoder = JointStateDecoder(names[::-1])
    assert decoder.decode(expected) == STAMP
    assert decoder.position.tolist() == list(message.position)[::-1]
    assert decoder.velocity.tolist() == list(message.velocity)[::-1]
    assert decoder.effort.tolist() == list(message.effort)[::-1]


@pytest.mark.parametrize('fields', [(), ('position',), ('position', 'velocity'), ('effort',)])
def test_rclpy_reads_empty_fields(fields):
    values = {field: [1.5, 2.5] for field in fields}
    raw = JointStateEncoder(['a', 'bcd'], fields).encode(STAMP, **values)
    message = deserialize_message(raw, JointState)
    for field in ('position', 'velocity', 'effort'):
        assert list(getattr(message, field)) == values.get(field, [])


def test_multi_array_in_both_directions():
    data = [1.5, -2.5, 1e-300]
    raw = Float64MultiArrayEncoder(3).encode(data)
    assert list(deserialize_message(raw, Float64MultiArray).data) == data
    decoder = Float64MultiArrayDecoder(3)
    assert decoder.decode(serialize_message(Float64MultiArray(data=data))) == 3
    assert decoder.values.tolist() == data
