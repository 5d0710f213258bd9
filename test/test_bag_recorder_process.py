# SPDX-License-Identifier: Apache-2.0
"""The recorder in its own process: all ways to stop it, and full load."""

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

PATIENCE = 300.0  # s, timeout of waits that normally take a moment
RECORDER = (sys.executable, '-m', 'blf_dsc_controller.nodes.recorder_node')
TOPICS = ('a', 'b', 'c', 'd', 'e')


def wait_for(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, 'still waiting'
        time.sleep(0.01)


# Discovery of reader and writer is not simultaneous: kept messages are not lost in between.
KEPT = QoSProfile(depth=2000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Recording:
    """A recorder process and the publishers that it records."""

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

    def wait_for_subscriptions(self):
        """Wait until every topic has the recorder as its subscriber."""
        wait_for(lambda: all(each.get_subscription_count() for each in self.publishers))

    def publish(self, count, start=0):
        """Publish messages numbered from `start` on every topic, as fast as possible."""
        encoder = JointStateEncoder(['joint1', 'joint2'])
        for k in range(start, start + count):
            raw = encoder.encode(k, [k, 0], [0, 0], [0, 0])
            for publisher in self.publishers:
                publisher.publish(raw)
            if k % 20 == 0:  # not faster than the 20,000 messages a second of a fast lock-step run
                time.sleep(0.005)

    def stop(self, signal_number):
        """Stop the recorder with a signal; return its exit code and output."""
        self.process.send_signal(signal_number)
        _, output = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, output

    def close(self):
        """Kill the recorder if it still runs, and clean up."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def recording(tmp_path):
    instance = Recording(tmp_path / 'bag')
    yield instance
    instance.close()


def counts(bag):
    with Reader(bag) as reader:
        return {connection.topic: connection.msgcount for connection in reader.connections}


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_completes_the_bag(recording, tmp_path, number):
    recording.wait_for_subscriptions()
    recording.publish(2000)
    for publisher in recording.publishers:
        publisher.wait_for_all_acked()
    code, output = recording.stop(number)

    assert code == 0, output
    assert counts(tmp_path / 'bag') == {f'/{topic}': 2000 for topic in TOPICS}
    for topic in TOPICS:
        assert f'/{topic}: 2000 messages, 0 missed' in output
    assert 'Traceback' not in output
    assert 'invalid' not in output  # a context that was shut down


def test_signal_before_any_message_leaves_an_empty_bag(recording, tmp_path):
    wait_for((tmp_path / 'bag').exists)
    code, output = recording.stop(signal.SIGTERM)
    assert code == 0, output
    assert counts(tmp_path / 'bag') == {}
    assert '/a: never appeared' in output


def test_existing_folder_is_rejected_without_a_traceback(tmp_path):
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


def test_kill_loses_only_the_last_messages(recording, tmp_path):
    recording.wait_for_subscriptions()
    file = tmp_path / 'bag' / 'bag_0.mcap'
    recording.publish(1000)
    # All of it reaches the disk while the recorder runs, without another message to flush it.
    wait_for(lambda: messages_on_disk(file) == 5000)
    recording.publish(500, start=1000)
    os.kill(recording.process.pid, signal.SIGKILL)
    recording.process.wait()
    assert messages_on_disk(file) >= 5000
