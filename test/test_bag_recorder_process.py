# SPDX-License-Identifier: Apache-2.0
"""The recorder in its own process: signals, kills, a full disk, odd types.

`make test-nightly` kills ten times within a minute of recording and prints the loss of each kill.
"""

from __future__ import annotations

import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import time
from bisect import bisect_right
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import rclpy
from foreign_readers import messages_on_disk, read
from mcap.reader import make_reader
from own_domain import own_domain
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from small_disk import small_disk

from blf_dsc_controller.bags.recover import recover
from blf_dsc_controller.messages.codecs import JointStateEncoder

LONG = bool(os.environ.get('LONG_TESTS'))
KILLS = 10 if LONG else 3
LONGEST = 12.0 if LONG else 1.0  # s of recording before a kill: ten take a minute on average
PERIOD = 1_000_000  # ns between two messages of a topic
PROMISE = 100_000_000  # ns, the most that a kill may lose
PATIENCE = 300.0  # s, until a test gives up on what should take a moment
RECORDER = (sys.executable, '-m', 'blf_dsc_controller.nodes.recorder_node', '--ros-args')
ODD_PARTICIPANT = Path(__file__).with_name('odd_participant.py')
ENCODER = JointStateEncoder(['joint1', 'joint2'])
# Kept for the recorder, which may match slightly later than the publisher.
KEPT = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = ('a', 'b', 'c', 'd', 'e')


class Rig:
    """A node that publishes, and recorders in processes of their own."""

    def __init__(self, topics=('a',), quality=KEPT):
        self.context, self.topics, self.processes = Context(), topics, []
        self.environment = {**os.environ, 'ROS_DOMAIN_ID': str(own_domain())}
        rclpy.init(context=self.context, domain_id=int(self.environment['ROS_DOMAIN_ID']))
        self.node = Node('source', context=self.context)
        self.publishers = [self.node.create_publisher(JointState, one, quality) for one in topics]
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
        self.wait_for(lambda: all(one.get_subscription_count() for one in self.publishers))
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
    process = rig.record(tmp_path / 'bag')
    file = tmp_path / 'bag' / 'bag_0.mcap'
    rig.publish(*range(1000))
    rig.wait_for(lambda: messages_on_disk(file) == 5000)  # without another message to flush it
    rig.publish(*range(1000, 1500))
    process.kill()
    process.wait()
    assert messages_on_disk(file) >= 5000


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


class Waiting:
    """Time that the threads of a process spent waiting for a processor, excused in the test."""

    def __init__(self, pid):
        self._pid = pid
        self._times = []  # ns
        self._waited = []  # ns of each thread, at these times

    def look(self):
        """Record the waiting times."""
        found = dict(self._waited[-1]) if self._waited else {}  # keeps threads that have ended
        self._times.append(time.time_ns())
        for path in Path(f'/proc/{self._pid}/task').glob('*/schedstat'):
            try:
                found[path.parent.name] = int(path.read_text().split()[1])
            except (OSError, ValueError, IndexError):  # thread ended; or not supported
                continue
        self._waited.append(found)

    def since(self, start):
        """Sum over the threads [ns] from a time [ns] to the last look."""
        first = self._waited[max(0, bisect_right(self._times, start) - 1)]
        return sum(waited - first.get(thread, 0) for thread, waited in self._waited[-1].items())


def publish_until(rig, condition, each, sent):
    """Publish once per millisecond until a condition holds; check it every 10 ms."""
    begin = time.time_ns() - len(sent) * PERIOD
    while not condition():
        each()
        for _ in range(10):
            time.sleep(max(0.0, (begin + len(sent) * PERIOD - time.time_ns()) * 1e-9))
            sent.append(time.time_ns())
            rig.publish(len(sent) - 1)


def recovered(bag, out):
    """Numbers of the recovered messages by topic; both independent readers agree on them."""
    *cut, last = recover(bag, out).losses
    assert 'the recording was not closed' in last
    assert all('(cut off)' in loss for loss in cut)
    (file,) = out.glob('*.mcap')
    found = read(out)
    with file.open('rb') as stream:
        messages = list(make_reader(stream).iter_messages())
    assert [message.data for _, _, message in messages] == [raw for _, _, raw in found]
    numbers = {topic: [] for topic in TOPICS}
    for topic, _, raw in found:
        seconds, nanoseconds = struct.unpack_from('<iI', raw, 4)
        numbers[topic[1:]].append(seconds * 10**9 + nanoseconds)
    return numbers


@pytest.mark.parametrize('k', range(KILLS))
def test_kill_loses_at_most_the_last_tenth_of_a_second(k, rig, tmp_path):
    # Each kill has its own publishers: those that knew a killed reader delay others.
    rig, sent = rig(TOPICS, QoSProfile(depth=5000)), []
    with tempfile.TemporaryDirectory(dir='/dev/shm') as folder:  # a busy disk would delay it
        bag = Path(folder) / 'bag'
        process = rig.start(bag)
        waiting, own = Waiting(process.pid), Waiting(os.getpid())

        def look():
            waiting.look()
            own.look()

        def is_recording():
            file = bag / 'bag_0.mcap'
            return file.exists() and file.stat().st_size > 50_000

        publish_until(rig, is_recording, look, sent)
        end = time.monotonic() + random.Random(k).uniform(0.0, LONGEST)  # noqa: S311
        publish_until(rig, lambda: time.monotonic() >= end, look, sent)
        killed = time.time_ns()
        process.send_signal(signal.SIGKILL)
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # /proc then has its last wait
        look()
        for topic, numbers in recovered(bag, tmp_path / 'clean').items():
            assert numbers == list(range(numbers[0], numbers[-1] + 1))
            rest = sent[numbers[-1] + 1 :]
            lost = killed - rest[0] if rest else 0  # ns
            excused = waiting.since(killed - lost) + own.since(killed - lost)
            print(  # noqa: T201 - shown by make test-nightly
                f'killed after {len(numbers):5} of /{topic}: without the last {lost * 1e-6:5.1f} '
                f'ms; it and the publisher waited for a processor {excused * 1e-6:.1f} ms of these'
            )
            # Lost messages had been sent, perhaps even received, no longer ago than this.
            assert lost <= PROMISE + excused
