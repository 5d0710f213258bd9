# SPDX-License-Identifier: Apache-2.0
"""The recorder in one process with its publishers: what it records and what it reports."""

from __future__ import annotations

import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import rclpy
from foreign_readers import messages_on_disk, read
from nav_msgs.msg import Goals
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.analysis.report import read_bags
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import FOREVER, Quality
from blf_dsc_controller.messages.types import definition
from blf_dsc_controller.nodes import recorder_node
from blf_dsc_controller.nodes.endpoints import quality_of
from blf_dsc_controller.nodes.recorder_node import BagRecorderNode

PATIENCE = 300.0  # s, timeout of waits that normally take a moment


class Loop:
    """A recorder and a publishing node on one executor."""

    def __init__(self, bag, **values):
        self.context = Context()
        rclpy.init(context=self.context)
        self.source = Node('source', context=self.context, start_parameter_services=False)
        self.executor = EventsExecutor(context=self.context)
        self.executor.add_node(self.source)
        self.recorder = None
        self.bag = bag
        overrides = {'output': str(bag), **values}
        self.recorder = BagRecorderNode(
            context=self.context,
            parameter_overrides=[Parameter(name, value=v) for name, v in overrides.items()],
        )
        self.executor.add_node(self.recorder)

    def spin_until(self, condition):
        """Spin both nodes until the condition holds."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, 'still waiting'
            self.executor.spin_once(timeout_sec=0.05)

    def spin_until_recorded(self, **counts):
        """Spin both nodes until the recorder has at least these numbers of messages by topic."""
        self.spin_until(
            lambda: all(
                self.recorder._bag.message_counts.get(f'/{topic}', 0) >= count
                for topic, count in counts.items()
            )
        )

    def close(self):
        """End the recording."""
        if self.recorder is not None:
            self.recorder.close()
            self.executor.remove_node(self.recorder)
            self.recorder.destroy_node()
            self.recorder = None

    def messages(self):
        """End the recording and read it."""
        self.close()
        return read(self.bag)


@pytest.fixture
def loop(tmp_path):
    loops = []

    def make(**values):
        loops.append(Loop(tmp_path / 'bag', **values))
        return loops[-1]

    yield make
    for each in loops:
        each.close()
        each.executor.remove_node(each.source)
        each.source.destroy_node()
        each.context.try_shutdown()


def test_messages_are_recorded_byte_for_byte(loop):
    run = loop()
    publisher = run.source.create_publisher(JointState, 'joint_states', 100)
    encoder = JointStateEncoder(['joint1', 'joint2'])
    sent = [encoder.encode(k, [k, 1], [2, 3], [4, 5]) for k in range(1000)]
    run.spin_until(lambda: publisher.get_subscription_count() > 0)
    before = time.time_ns()
    for k, raw in enumerate(sent):
        publisher.publish(raw)
        if k % 50 == 49:
            run.spin_until_recorded(joint_states=k + 1)
    after = time.time_ns()

    for _ in range(50):
        publisher.publish(sent[0])
    assert publisher.wait_for_all_acked()

    states = [entry for entry in run.messages() if entry[0] == '/joint_states']
    # The last ones were received before it was closed, without spinning the executor once more.
    assert [raw for _, _, raw in states] == [*sent, *[sent[0]] * 50]
    stamps = [stamp for _, stamp, _ in states[: len(sent)]]
    assert stamps == sorted(stamps)
    assert before <= stamps[0] <= stamps[-1] <= after


def test_publishers_of_every_quality_are_recorded(loop):
    """Latched before the recorder came, best effort, and both on one topic; not those of others."""
    run = loop(topics=['bound', 'sensor', '/mixed', '/never'])
    other = run.source.create_publisher(JointState, 'other', 10)
    policies = (
        {'durability': DurabilityPolicy.TRANSIENT_LOCAL},
        {'reliability': ReliabilityPolicy.BEST_EFFORT},
    )
    latched, best_effort = (QoSProfile(depth=10, **policy) for policy in policies)
    run.source.create_publisher(JointState, 'bound', latched).publish(JointState(name=['early']))
    publishers = [
        run.source.create_publisher(JointState, topic, quality)
        for topic, quality in (
            ('sensor', best_effort),
            ('mixed', latched),
            ('mixed', best_effort),
        )
    ]
    run.spin_until(lambda: run.source.count_publishers('mixed') == 2)
    run.spin_until(lambda: all(each.get_subscription_count() > 0 for each in publishers))
    for publisher in publishers:
        publisher.publish(JointState())
    run.spin_until_recorded(bound=1, sensor=1, mixed=2)
    assert other.get_subscription_count() == 0
    found = run.messages()
    assert sorted(topic for topic, _, _ in found) == ['/bound', '/mixed', '/mixed', '/sensor']
    assert [b'early' in raw for topic, _, raw in found if topic == '/bound'] == [True]


def test_quality_and_type_are_taken_from_the_graph(loop):
    """Also the type of a package that rosbags does not know."""
    run = loop()
    quality = QoSProfile(depth=7, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    run.source.create_publisher(Float64MultiArray, 'commands', quality)
    goals = run.source.create_publisher(Goals, 'goals', 10)
    run.spin_until(lambda: '/commands' in run.recorder._bag.message_counts)
    run.spin_until(lambda: goals.get_subscription_count() > 0)
    goals.publish(Goals())
    run.spin_until_recorded(goals=1)
    seen, seen_goals = (
        run.recorder.get_publishers_info_by_topic(topic)[0] for topic in ('/commands', '/goals')
    )
    run.close()
    with Reader(run.bag) as reader:
        found = {connection.topic: connection for connection in reader.connections}
    commands = found['/commands']
    assert str(seen.topic_type_hash) == commands.digest == definition(commands.msgtype)[1]
    assert [each.durability.name for each in commands.ext.offered_qos_profiles] == [
        'TRANSIENT_LOCAL'
    ]
    # The graph knows neither history nor depth.
    assert quality_of(seen.qos_profile) == Quality(
        depth=0, durability='transient_local', history='unknown', deadline=FOREVER
    )
    assert found['/goals'].digest == str(seen_goals.topic_type_hash)
    assert 'geometry_msgs/Quaternion' in found['/goals'].msgdef.data


def test_received_messages_are_on_disk_before_a_type_is_imported(loop, monkeypatch):
    def import_slowly(type_name):
        on_disk.append(messages_on_disk(run.bag / 'bag_0.mcap'))
        return original(type_name)

    run, on_disk = loop(topics=['joint_states', 'goals']), []
    publisher = run.source.create_publisher(JointState, 'joint_states', 100)
    run.spin_until(lambda: publisher.get_subscription_count() > 0)
    original = recorder_node.message_class
    monkeypatch.setattr(recorder_node, 'message_class', import_slowly)
    run.source.create_publisher(Goals, 'goals', 10)
    for _ in range(50):
        publisher.publish(JointState())
    assert publisher.wait_for_all_acked()
    deadline = time.monotonic() + PATIENCE
    while not on_disk:  # only the topic discovery runs, nothing else of the recorder
        assert time.monotonic() < deadline, 'still waiting'
        run.recorder._discover()
    assert on_disk == [50]


def test_messages_dropped_by_a_full_queue_are_counted_as_missed(loop):
    run = loop(topics=['joint_states'], queue_depth=5)
    publisher = run.source.create_publisher(JointState, 'joint_states', 100)
    run.spin_until(lambda: publisher.get_subscription_count() > 0)
    publisher.publish(JointState())
    run.spin_until_recorded(joint_states=1)
    for _ in range(50):
        publisher.publish(JointState())
    assert publisher.wait_for_all_acked()
    run.spin_until_recorded(joint_states=6)
    losses = run.recorder._losses['/joint_states']
    assert len(run.messages()) == 51 - losses.missed
    assert losses.missed > 0


def test_messages_sent_before_the_recorder_connected_are_reported_as_lost(loop, capfd):
    run = loop()
    publisher = run.source.create_publisher(JointState, 'joint_states', 100)
    encoder = JointStateEncoder(['joint1'])
    for k in range(7):  # nobody subscribes yet, and nothing is kept
        publisher.publish(encoder.encode(k, [k], [0], [0]))
    run.spin_until(lambda: publisher.get_subscription_count() > 0)
    for k in range(7, 10):
        publisher.publish(encoder.encode(k, [k], [0], [0]))
    run.spin_until_recorded(joint_states=3)
    run.close()
    lost = '0 missed, 7 sent before the recorder connected'
    assert f'/joint_states: 3 messages, {lost}' in capfd.readouterr().err
    assert read_content(run.bag).losses == {'/joint_states': lost}
    (bag,) = read_bags([run.bag])
    assert [(event.kind, event.text) for event in bag.events] == [
        ('lost', f'/joint_states: {lost}')
    ]
