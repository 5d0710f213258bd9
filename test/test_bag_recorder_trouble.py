# SPDX-License-Identifier: Apache-2.0
"""The recorder as a process in trouble: killed at any moment, on a full disk, asked for a ring."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import rclpy
from mcap.reader import make_reader
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from small_disk import small_disk
from std_srvs.srv import Trigger

from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.bags.encoders import JointStateEncoder
from blf_dsc_controller.recovery.recover import recover

PATIENCE = 30.0  # s, until a test gives up on what should take a moment
KILLS = int(os.environ.get('BAG_KILLS', '3'))
RECORDER = (sys.executable, '-m', 'blf_dsc_controller.nodes.recorder_node', '--ros-args')
ENCODER = JointStateEncoder(['joint1', 'joint2'])
# Kept for the recorder, which may match a moment after the publisher has.
KEPT = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Rig:
    """A publisher and recorder processes beside it."""

    def __init__(self):
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = Node('source', context=self.context)
        self.node.declare_parameter('gain', [1.0, 2.0])
        self.publisher = self.node.create_publisher(JointState, 'a', KEPT)
        self.processes = []

    def record(self, output, **parameters):
        """Start a recorder and wait until it listens."""
        given = {'output': output, 'topics': '[a]', **parameters}
        words = [word for name, value in given.items() for word in ('-p', f'{name}:={value}')]
        process = subprocess.Popen([*RECORDER, *words], stderr=subprocess.PIPE, text=True)
        self.processes.append(process)
        self.wait_for(lambda: self.publisher.get_subscription_count() > 0)
        return process

    def wait_for(self, condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, 'still waiting'
            rclpy.spin_once(self.node, timeout_sec=0.01, executor=self.executor())

    def executor(self):
        if not hasattr(self, '_executor'):
            self._executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        return self._executor

    def publish_for(self, seconds):
        """Publish each millisecond; return when each message was sent [ns]."""
        sent, end = [], time.monotonic() + seconds
        while time.monotonic() < end:
            self.publisher.publish(ENCODER.encode(len(sent), [1, 2], [3, 4], [5, 6]))
            sent.append(time.time_ns())
            time.sleep(0.001)
        return sent

    def close(self):
        for process in self.processes:
            if process.poll() is None:
                process.kill()
                process.communicate()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def rig():
    one = Rig()
    yield one
    one.close()


def read(path):
    with Reader(path) as reader:
        return [(c.topic, at, bytes(raw)) for c, at, raw in reader.messages()]


def test_whenever_it_is_killed_all_but_the_last_moment_is_recovered(rig, tmp_path):
    # Ten moments of a minute: BAG_KILLS=10 (make test-long). The time is that of reception by the
    # recorder, which a busy machine delays; so the last tenth of a second is counted from there.
    moments = random.Random(4)  # noqa: S311 - any moments will do
    for k in range(KILLS):
        process = rig.record(tmp_path / f'{k}')
        rig.publish_for(0.3)
        rig.publish_for(moments.uniform(0.0, 0.7))
        process.send_signal(signal.SIGKILL)
        killed = time.time_ns()
        process.wait()
        recovery = recover(tmp_path / f'{k}', tmp_path / f'{k}_clean')
        found = read(recovery.path)
        (file,) = recovery.path.glob('*.mcap')
        with file.open('rb') as stream:
            assert len(list(make_reader(stream).iter_messages())) == len(found)
        assert recovery.missed == {'/a': 0}
        assert killed - found[-1][1] < 1e9  # generous to a busy machine: no assert on the clock
        assert not recovery.losses or recovery.losses[0].reason == 'cut off'
        rig.wait_for(lambda: rig.publisher.get_subscription_count() == 0)


def test_a_full_disk_ends_it_with_one_clear_error_and_a_whole_bag(rig, tmp_path):
    with small_disk(tmp_path / 'disk', 4) as disk:
        process = rig.record(disk / 'bag')
        deadline = time.monotonic() + PATIENCE
        while process.poll() is None:
            assert time.monotonic() < deadline, 'still recording'
            for _ in range(100):
                rig.publisher.publish(ENCODER.encode(0, [1, 2], [3, 4], [5, 6]))
            time.sleep(0.005)
        _, said = process.communicate()
        assert process.returncode == 1
        assert said.count('the disk is full') == 1
        assert 'Traceback' not in said
        assert len(read(disk / 'bag')) > 1000
        assert recover(disk / 'bag', tmp_path / 'clean').is_whole


def test_its_ring_is_written_when_it_is_asked_to(rig, tmp_path):
    rig.record(tmp_path / 'bag', ring=0.5)
    client = rig.node.create_client(Trigger, '/bag_recorder/trigger')
    rig.wait_for(client.service_is_ready)
    rig.publish_for(1.5)
    answer = client.call_async(Trigger.Request())
    rig.wait_for(answer.done)
    assert answer.result().success, answer.result().message
    assert answer.result().message.endswith(f'messages into {tmp_path / "bag"}')
    stamps = [at for topic, at, _ in read(tmp_path / 'bag') if topic == '/a']
    assert stamps[-1] - stamps[1] <= 0.5e9  # the first is older: the topic is a latched one
    again = client.call_async(Trigger.Request())
    rig.wait_for(again.done)
    assert (tmp_path / 'bag-2' / 'metadata.yaml').exists()


def test_the_parameters_of_who_publishes_are_in_the_bag(rig, tmp_path):
    process = rig.record(tmp_path / 'bag')
    file = tmp_path / 'bag' / 'bag_0.mcap'
    rig.wait_for(lambda: b'gain: [1.0, 2.0]' in file.read_bytes())
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    context = read_context(tmp_path / 'bag')
    assert '/source:\n  ros__parameters:\n    gain: [1.0, 2.0]\n' in context.configuration
    assert context.facts['messages /a'].startswith('0 written, 0 missed')
