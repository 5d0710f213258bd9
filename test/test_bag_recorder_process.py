# SPDX-License-Identifier: Apache-2.0
"""The recorder in its own process: signals, kills, a full disk, odd types."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import rclpy
from foreign_readers import messages_on_disk, read
from own_domain import own_domain
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from small_disk import small_disk

from blf_dsc_controller.bags.recover import recover
from blf_dsc_controller.messages.codecs import JointStateEncoder, joint_state_stamp

KILLS, MOST = (20, 10_000) if os.environ.get('NIGHTLY') else (3, 1000)
PATIENCE = 300.0  # s, until a test gives up on what should take a moment
RECORDER = (sys.executable, '-m', 'blf_dsc_controller.nodes.recorder_node', '--ros-args')
ODD_PARTICIPANT = Path(__file__).with_name('odd_participant.py')
ENCODER = JointStateEncoder(['joint1', 'joint2'])
# Kept for the recorder, which may match slightly later than the publisher.
KEPT = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = ('a', 'b', 'c', 'd', 'e')


class Rig:
    """A node that publishes, and recorders in processes of their own."""

    def __init__(self, topics=('a',)):
        self.context, self.topics, self.processes = Context(), topics, []
        self.environment = {**os.environ, 'ROS_DOMAIN_ID': str(own_domain())}
        rclpy.init(context=self.context, domain_id=int(self.environment['ROS_DOMAIN_ID']))
        self.node = Node('source', context=self.context)
        self.publishers = [self.node.create_publisher(JointState, each, KEPT) for each in topics]
        self._executor = SingleThreadedExecutor(context=self.context)

    def start(self, output, **parameters):
        """Start a recorder."""
        given = {'output': output, 'topics': f'[{", ".join(self.topics)}]', **parameters}
        words = [word for name, value in given.items() for word in ('-p', f'{name}:={value}')]
        self.processes.append(
            subprocess.Popen(
                [*RECORDER, *words], stderr=subprocess.PIPE, text=True, env=self.environment
            )
        )
        return self.processes[-1]

    def start_odd(self, *topics):
        """Start an odd_participant.py that publishes topics such as `b=foo::bar::Name`."""
        command = [sys.executable, ODD_PARTICIPANT, *topics]
        self.processes.append(subprocess.Popen(command, env=self.environment))

    def record(self, output, **parameters):
        """Start a recorder and wait until it has subscribed."""
        process = self.start(output, **parameters)
        self.wait_for(lambda: all(each.get_subscription_count() for each in self.publishers))
        return process

    def wait_for(self, condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, 'still waiting'
            rclpy.spin_once(self.node, timeout_sec=0.01, executor=self._executor)

    def publish(self, *numbers):
        """Publish messages with these numbers as stamps [ns] on every topic."""
        for number in numbers:
            raw = ENCODER.encode(number, [1, 2], [3, 4], [5, 6])
            for publisher in self.publishers:
                publisher.publish(raw)
            if number % 20 == 19:  # not faster than the 20,000 a second of a fast lock-step run
                time.sleep(0.005)

    def end(self, process, number):
        """Stop a recorder by a signal; return its exit code and output."""
        process.send_signal(number)
        _, output = process.communicate(timeout=PATIENCE)
        return process.returncode, output

    def close(self):
        for process in self.processes:
            if process.poll() is None:
                process.kill()
                process.communicate()
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def rig():
    rigs = []

    def make(*arguments):
        rigs.append(Rig(*arguments))
        return rigs[-1]

    yield make
    for each in rigs:
        each.close()


def counts(bag):
    with Reader(bag) as reader:
        return {connection.topic: connection.msgcount for connection in reader.connections}


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_completes_the_bag(rig, tmp_path, number):
    rig = rig(TOPICS)
    process = rig.record(tmp_path / 'bag')
    rig.publish(*range(2000))
    for publisher in rig.publishers:
        publisher.wait_for_all_acked()
    code, output = rig.end(process, number)
    assert code == 0, output
    assert counts(tmp_path / 'bag') == {f'/{topic}': 2000 for topic in TOPICS}
    assert all(f'/{topic}: 2000 messages, 0 missed' in output for topic in TOPICS)
    assert 'Traceback' not in output
    assert 'invalid' not in output  # a context that was shut down


def test_signal_before_any_message_leaves_an_empty_bag_that_is_not_overwritten(rig, tmp_path):
    rig = rig(('a',))
    process = rig.start(tmp_path / 'bag', topics='[never]')
    rig.wait_for((tmp_path / 'bag').exists)
    code, output = rig.end(process, signal.SIGTERM)
    assert code == 0, output
    assert counts(tmp_path / 'bag') == {}
    assert '/never: never appeared' in output
    process = rig.start(tmp_path / 'bag')
    _, output = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert f'{tmp_path / "bag"} exists already' in output
    assert 'Traceback' not in output


def test_all_is_on_disk_while_the_recorder_runs(rig, tmp_path):
    rig = rig(TOPICS)
    rig.record(tmp_path / 'bag')
    rig.publish(*range(1000))  # then no message follows to flush it
    rig.wait_for(lambda: messages_on_disk(tmp_path / 'bag' / 'bag_0.mcap') == 5000)


def test_full_disk_stops_the_recorder_with_one_error_and_a_whole_bag(rig, tmp_path):
    rig = rig()
    with small_disk(tmp_path / 'disk', 18) as disk:
        process = rig.record(disk / 'bag')
        deadline = time.monotonic() + PATIENCE
        while process.poll() is None:
            assert time.monotonic() < deadline, 'still recording'
            rig.publish(*range(100))
        _, output = process.communicate()
        assert process.returncode == 1
        assert output.count('the disk is full') == 1
        assert 'Traceback' not in output
        assert len(read(disk / 'bag')) > 1000
        assert not recover(disk / 'bag', tmp_path / 'clean').losses


def test_unknown_message_packages_are_not_imported_and_do_not_stop_the_recorder(rig, tmp_path):
    rig = rig()
    process = rig.record(tmp_path / 'bag', topics='[a, b, c, d, e]')
    names = {'b': 'unittest::__main__::X', 'c': 'foo::X', 'd': 'unittest::msg::X', 'e': 'X'}
    rig.start_odd(*(f'{topic}={name}' for topic, name in names.items()))
    output = wait_for_lines(process, [f'/{topic} is not recorded: its type' for topic in names])
    assert output.count('/c is not recorded') == 1
    assert '/b is not recorded: its type unittest/__main__/X is not installed here' in output
    assert '/c is not recorded: its type foo/X is not installed here' in output
    rig.publish(1)
    rig.start_odd('f=std_msgs::msg::\udce4')  # not UTF-8
    wait_for_lines(process, ['the name of a topic or type is not UTF-8'])
    rig.publish(2)
    encoded = ENCODER.encode(1, [1, 2], [3, 4], [5, 6])[12:]  # after the stamp
    rig.wait_for(lambda: (tmp_path / 'bag' / 'bag_0.mcap').read_bytes().count(encoded) == 2)
    assert rig.end(process, signal.SIGINT)[0] == 0
    assert [topic for topic, _, _ in read(tmp_path / 'bag')] == ['/a', '/a']


def wait_for_lines(process, expected):
    """Read the output of a recorder until it has all expected texts; return it."""
    output = ''
    while not all(text in output for text in expected):
        line = process.stderr.readline()
        assert line, f'it has ended: {output}'
        output += line
    return output


@pytest.mark.parametrize('k', range(KILLS))
def test_kill_loses_nothing_that_was_written(k, rig, tmp_path):
    """How soon it is written: see test_data_is_flushed_periodically."""
    rig = rig(TOPICS)
    process = rig.record(tmp_path / 'bag')
    rig.publish(*range(random.Random(k).randrange(50, MOST)))  # noqa: S311
    written = messages_on_disk(tmp_path / 'bag' / 'bag_0.mcap')
    process.kill()
    process.wait()
    *cut, last = recover(tmp_path / 'bag', tmp_path / 'clean').losses
    assert 'the recording was not closed' in last
    assert all('(cut off)' in loss for loss in cut)
    numbers = {f'/{topic}': [] for topic in TOPICS}
    for topic, _, raw in read(tmp_path / 'clean'):
        numbers[topic].append(joint_state_stamp(raw))
    assert sum(map(len, numbers.values())) >= written
    assert all(found == list(range(len(found))) for found in numbers.values())
