# SPDX-License-Identifier: Apache-2.0
"""Our serialisation and that of rclpy are interchangeable, in both directions."""

from __future__ import annotations

import time

import numpy as np
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
ALL = ('position', 'velocity', 'effort')
CASES = [
    *((names, ALL) for names in (['j'], ['joint1', 'joint2'], ['a', 'bc', 'def', 'ghij', ''])),
    *((['a', 'bcd'], fields) for fields in ((), ALL[:1], ALL[:2], ALL[2:])),
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


def without_padding(raw):
    """The meaningful pieces of a JointState: rclpy leaves its padding bytes uninitialised."""
    layout = joint_state_layout(raw)
    return [raw[:2], raw[4:12], layout.names] + [
        raw[array.offset : array.offset + 8 * array.size] for array in layout.arrays
    ]


@pytest.mark.parametrize(('names', 'fields'), CASES)
def test_each_reads_what_the_other_serialises(names, fields):
    sizes = dict(zip(fields, (0.1, -0.2, 1e300), strict=False))
    values = {field: [size / (j + 1) for j in range(len(names))] for field, size in sizes.items()}
    message = JointState(name=names, **values)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(STAMP, 10**9)
    raw = JointStateEncoder(names, fields).encode(STAMP, **values)
    assert deserialize_message(raw, JointState) == message
    expected = serialize_message(message)
    assert len(raw) == len(expected) or fields != ALL  # rclpy may append some bytes then
    assert without_padding(raw) == without_padding(expected)
    for message.header.frame_id in ('', 'b', 'world'):
        decoder = JointStateDecoder(names[::-1], ())
        assert decoder.decode(serialize_message(message)) == STAMP
        for field in ALL:
            unknown = [np.nan] * len(names)
            np.testing.assert_array_equal(getattr(decoder, field)[::-1], values.get(field, unknown))
    data = values.get('position', [])
    raw = Float64MultiArrayEncoder(len(data)).encode(data)
    assert list(deserialize_message(raw, Float64MultiArray).data) == data
    decoder = Float64MultiArrayDecoder(len(data))
    assert decoder.decode(serialize_message(Float64MultiArray(data=data))) == len(data)
    assert decoder.values.tolist() == data
