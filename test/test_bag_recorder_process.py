# SPDX-License-Identifier: Apache-2.0
"""The recorder as a process of its own: every way to end it, and full load."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import rclpy
from foreign_readers import messages_on_disk
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState

from blf_dsc_controller.messages.codecs import JointStateEncoder

PATIENCE = 300.0  # s, until a test gives up on what should take a moment
RECORDER = (sys.executable, '-m', 'blf_dsc_controller.nodes.recorder_node')
TOPICS = ('a', 'b', 'c', 'd', 'e')


def wait_for(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, 'still waiting'
        time.sleep(0.01)


# A reader and its writer find each other one after the other: what is kept cannot fall between.
KEPT = QoSProfile(depth=2000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Recording:
    """A recorder process and publishers that it listens to."""

    def __init__(self, bag):
        names = ', '.join(TOPICS)
        parameters = [f'output:={bag}', f'topics:=[{names}]']
        arguments = [word for parameter in parameters for word in ('-p', parameter)]
        self.process = subprocess.Popen(
            [*RECORDER, '--ros-args', *arguments], stderr=subprocess.PIPE, text=True
        )
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = Node('source', context=self.context)
        self.publishers = [self.node.create_publisher(JointState, topic, KEPT) for topic in TOPICS]

    def wait_until_it_listens(self):
        """Wait until every topic has the recorder as its subscriber."""
        wait_for(lambda: all(one.get_subscription_count() for one in self.publishers))

    def publish(self, count, start=0):
        """Publish messages numbered from `start` on every topic, as fast as goes."""
        encoder = JointStateEncoder(['joint1', 'joint2'])
        for k in range(start, start + count):
            raw = encoder.encode(k, [k, 0], [0, 0], [0, 0])
            for publisher in self.publishers:
                publisher.publish(raw)
            if k % 20 == 0:  # not faster than the 20,000 messages a second of a fast lock-step run
                time.sleep(0.005)

    def end(self, signal_number):
        """End the recorder; return its exit code and what it said."""
        self.process.send_signal(signal_number)
        _, said = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, said

    def close(self):
        """Leave nothing behind."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def recording(tmp_path):
    one = Recording(tmp_path / 'bag')
    yield one
    one.close()


def counts(bag):
    with Reader(bag) as reader:
        return {connection.topic: connection.msgcount for connection in reader.connections}


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_completes_the_bag(recording, tmp_path, number):
    recording.wait_until_it_listens()
    recording.publish(2000)
    for publisher in recording.publishers:
        publisher.wait_for_all_acked()
    code, said = recording.end(number)

    assert code == 0, said
    assert counts(tmp_path / 'bag') == {f'/{topic}': 2000 for topic in TOPICS}
    for topic in TOPICS:
        assert f'/{topic}: 2000 messages, 0 missed' in said
    assert 'Traceback' not in said
    assert 'invalid' not in said  # a context that is gone


def test_a_signal_before_any_message_leaves_an_empty_bag(recording, tmp_path):
    wait_for((tmp_path / 'bag').exists)
    code, said = recording.end(signal.SIGTERM)
    assert code == 0, said
    assert counts(tmp_path / 'bag') == {}
    assert '/a: never appeared' in said


def test_an_existing_folder_ends_it_with_one_clear_line(tmp_path):
    run = subprocess.run(
        [*RECORDER, '--ros-args', '-p', f'output:={tmp_path}'],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert run.returncode == 1
    assert f'{tmp_path} exists already' in run.stderr
    assert 'Traceback' not in run.stderr


def test_a_kill_loses_nothing_but_the_last_moment(recording, tmp_path):
    recording.wait_until_it_listens()
    file = tmp_path / 'bag' / 'bag_0.mcap'
    recording.publish(1000)
    # All of it is on disk while the recorder runs on, with no further message to push it out.
    wait_for(lambda: messages_on_disk(file) == 5000)
    recording.publish(500, start=1000)
    os.kill(recording.process.pid, signal.SIGKILL)
    recording.process.wait()
    assert messages_on_disk(file) >= 5000
