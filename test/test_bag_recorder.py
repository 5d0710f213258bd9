# SPDX-License-Identifier: Apache-2.0
"""The recorder in one process with its publishers: what it records and what it reports."""

from __future__ import annotations

import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from foreign_readers import messages_on_disk, read
from nav_msgs.msg import Goals
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.analysis.report import read_bags
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.messages.codecs import JointStateEncoder, definition
from blf_dsc_controller.messages.topics import FOREVER, Quality
from blf_dsc_controller.nodes import recorder_node
from blf_dsc_controller.nodes.endpoints import quality_of
from blf_dsc_controller.nodes.recorder_node import BagRecorderNode

ENCODER = JointStateEncoder(['joint1', 'joint2'])


@pytest.fixture
def bag(tmp_path):
    return tmp_path / 'bag'


def connected(ros, type_, topic, quality=100):
    """Return a publisher of the test that the recorder has subscribed to."""
    publisher = ros.tester.create_publisher(type_, topic, quality)
    ros.until(publisher.get_subscription_count)
    return publisher


def until_recorded(ros, recorder, **counts):
    """Spin until the recorder has at least these numbers of messages by topic."""
    found = recorder._bag
    ros.until(lambda: all(found.message_counts.get(f'/{k}', 0) >= n for k, n in counts.items()))


def test_messages_are_recorded_byte_for_byte(ros, bag):
    recorder = ros.add(BagRecorderNode, output=str(bag))
    publisher = connected(ros, JointState, 'joint_states')
    sent = [ENCODER.encode(k, [k, 1], [2, 3], [4, 5]) for k in range(1000)]
    before = time.time_ns()
    for k, raw in enumerate(sent):
        publisher.publish(raw)
        if k % 50 == 49:
            until_recorded(ros, recorder, joint_states=k + 1)
    after = time.time_ns()
    for _ in range(50):
        publisher.publish(sent[0])
    assert publisher.wait_for_all_acked()
    recorder.close()
    states = [entry for entry in read(bag) if entry[0] == '/joint_states']
    # The last ones were received before it was closed, without spinning the executor once more.
    assert [raw for _, _, raw in states] == [*sent, *[sent[0]] * 50]
    stamps = [stamp for _, stamp, _ in states[: len(sent)]]
    assert [before, *stamps, after] == sorted([before, *stamps, after])


def test_publishers_of_every_quality_are_recorded(ros, bag):
    """Latched before the recorder came, best effort, and both on one topic; not those of others."""
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    create = ros.tester.create_publisher
    create(JointState, 'bound', latched).publish(JointState(name=['early']))
    other = create(JointState, 'other', 10)
    chosen = ['bound', 'sensor', '/mixed', '/never']
    recorder = ros.add(BagRecorderNode, output=str(bag), topics=chosen)
    kinds = (('sensor', best_effort), ('mixed', latched), ('mixed', best_effort))
    publishers = [create(JointState, topic, quality) for topic, quality in kinds]
    ros.until(lambda: all(each.get_subscription_count() for each in publishers))
    for publisher in publishers:
        publisher.publish(JointState())
    until_recorded(ros, recorder, bound=1, sensor=1, mixed=2)
    assert other.get_subscription_count() == 0
    recorder.close()
    found = read(bag)
    assert sorted(topic for topic, _, _ in found) == ['/bound', '/mixed', '/mixed', '/sensor']
    assert [b'early' in raw for topic, _, raw in found if topic == '/bound'] == [True]


def test_quality_and_type_are_taken_from_the_graph(ros, bag):
    """Also the type of a package that rosbags does not know."""
    recorder = ros.add(BagRecorderNode, output=str(bag))
    latched = QoSProfile(depth=7, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    connected(ros, Float64MultiArray, 'commands', latched)
    connected(ros, Goals, 'goals').publish(Goals())
    until_recorded(ros, recorder, goals=1)
    seen, goals = (
        recorder.get_publishers_info_by_topic(topic)[0] for topic in ('/commands', '/goals')
    )
    recorder.close()
    with Reader(bag) as reader:
        found = {connection.topic: connection for connection in reader.connections}
    commands = found['/commands']
    assert str(seen.topic_type_hash) == commands.digest == definition(commands.msgtype)[1]
    (offered,) = commands.ext.offered_qos_profiles
    assert offered.durability.name == 'TRANSIENT_LOCAL'
    # The graph knows neither history nor depth.
    assert quality_of(seen.qos_profile) == Quality(
        depth=0, durability='transient_local', history='unknown', deadline=FOREVER
    )
    assert found['/goals'].digest == str(goals.topic_type_hash)
    assert 'geometry_msgs/Quaternion' in found['/goals'].msgdef.data


def test_received_messages_are_on_disk_before_a_type_is_imported(ros, bag, monkeypatch):
    def import_slowly(type_name):
        on_disk.append(messages_on_disk(bag / 'bag_0.mcap'))
        return original(type_name)

    on_disk, original = [], recorder_node.message_class
    recorder = ros.add(BagRecorderNode, output=str(bag), topics=['joint_states', 'goals'])
    publisher = connected(ros, JointState, 'joint_states')
    monkeypatch.setattr(recorder_node, 'message_class', import_slowly)
    ros.tester.create_publisher(Goals, 'goals', 10)
    for _ in range(50):
        publisher.publish(JointState())
    assert publisher.wait_for_all_acked()
    while not on_disk:  # only the topic discovery runs, nothing else of the recorder
        recorder._discover()
    assert on_disk == [50]


def test_losses_are_counted_and_reported(ros, bag, capfd):
    """Messages sent before the recorder connected, and those dropped by a full queue."""
    publisher = ros.tester.create_publisher(JointState, 'joint_states', 100)
    for k in range(7):  # nobody subscribes yet, and nothing is kept
        publisher.publish(ENCODER.encode(k, [k, k], [0, 0], [0, 0]))
    recorder = ros.add(BagRecorderNode, output=str(bag), topics=['joint_states'], queue_depth=5)
    ros.until(publisher.get_subscription_count)
    publisher.publish(ENCODER.encode(8, [8, 8], [0, 0], [0, 0]))
    until_recorded(ros, recorder, joint_states=1)
    for k in range(9, 59):
        publisher.publish(ENCODER.encode(k, [k, k], [0, 0], [0, 0]))
    assert publisher.wait_for_all_acked()
    until_recorded(ros, recorder, joint_states=6)
    missed = recorder._losses['/joint_states'].missed
    recorder.close()
    assert missed > 0
    assert len(read(bag)) == 51 - missed
    lost = f'{missed} missed, 7 sent before the recorder connected'
    assert f'/joint_states: {51 - missed} messages, {lost}' in capfd.readouterr().err
    assert read_content(bag).losses == {'/joint_states': lost}
    (shown,) = read_bags([bag])
    assert ('lost', f'/joint_states: {lost}') in [event[1:] for event in shown.events]
