# SPDX-License-Identifier: Apache-2.0
"""The recorder in its own process: signals, kills, a full disk, odd types, beside a loop.

Sequence numbers of the publishers reveal losses. `make test-nightly` records a minute.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import PATIENT, closed_loop
from foreign_readers import messages_on_disk, read
from mcap.reader import make_reader
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_rig import RosRig
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from small_disk import small_disk

from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.bags.recover import recover
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateEncoder, joint_state_stamp

KILLS, MOST, DURATION = (20, 10_000, 60) if os.environ.get('NIGHTLY') else (3, 1000, 3)  # s
PATIENCE = 300.0  # s, until a test gives up on what should take a moment
RECORDER = (sys.executable, '-m', 'blf_dsc_controller.nodes.recorder_node', '--ros-args')
ODD_PARTICIPANT = Path(__file__).with_name('odd_participant.py')
ENCODER = JointStateEncoder(['joint1', 'joint2'])
# Kept for the recorder, which may match slightly later than the publisher.
KEPT = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = ('a', 'b', 'c', 'd', 'e')
EACH_SAMPLE = (
    topics.JOINT_STATES,
    topics.TIMING,
    topics.COMMANDS,
    topics.REFERENCE,
    topics.TRACKING_ERROR,
    topics.LEARNING,
)


class Rig(RosRig):
    """Publishers of the test on five topics, and recorders in processes of their own."""

    def __init__(self):
        super().__init__()
        self.processes = []
        create = self.tester.create_publisher
        self.publishers = [create(JointState, topic, KEPT) for topic in TOPICS]

    def start(self, command, **options):
        """Start a process in the domain of the test."""
        environment = {**os.environ, 'ROS_DOMAIN_ID': str(self.context.get_domain_id())}
        process = subprocess.Popen(command, env=environment, text=True, **options)
        self.processes.append(process)
        return process

    def record(self, output, chosen=TOPICS):
        """Start a recorder, and wait until it has subscribed."""
        words = ('-p', f'output:={output}', '-p', f'topics:=[{", ".join(chosen)}]')
        process = self.start([*RECORDER, *words], stderr=subprocess.PIPE)
        wanted = [each for each in self.publishers if each.topic_name[1:] in chosen]
        self.until(lambda: all(each.get_subscription_count() for each in wanted))
        return process

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
        assert 'Traceback' not in output
        return process.returncode, output

    def close(self):
        for process in self.processes:
            if process.poll() is None:
                process.kill()
                process.communicate()
        super().close()


@pytest.fixture
def rig():
    ros = Rig()
    yield ros
    ros.close()


def counts(bag):
    with Reader(bag) as reader:
        return {connection.topic: connection.msgcount for connection in reader.connections}


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_completes_the_bag(rig, tmp_path, number):
    process = rig.record(tmp_path / 'bag')
    rig.publish(*range(2000))
    for publisher in rig.publishers:
        publisher.wait_for_all_acked()
    code, output = rig.end(process, number)
    assert code == 0, output
    assert counts(tmp_path / 'bag') == {f'/{topic}': 2000 for topic in TOPICS}
    assert all(f'/{topic}: 2000 messages, 0 missed' in output for topic in TOPICS)
    assert 'invalid' not in output  # a context that was shut down


def test_signal_before_any_message_leaves_an_empty_bag_that_is_not_overwritten(rig, tmp_path):
    process = rig.record(tmp_path / 'bag', ['never'])
    rig.until((tmp_path / 'bag').exists)
    code, output = rig.end(process, signal.SIGTERM)
    assert code == 0, output
    assert counts(tmp_path / 'bag') == {}
    assert '/never: never appeared' in output
    process = rig.record(tmp_path / 'bag', ['never'])
    _, output = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert f'{tmp_path / "bag"} exists already' in output
    assert 'Traceback' not in output


def test_all_is_on_disk_while_the_recorder_runs(rig, tmp_path):
    rig.record(tmp_path / 'bag')
    rig.publish(*range(1000))  # then no message follows to flush it
    rig.until(lambda: messages_on_disk(tmp_path / 'bag' / 'bag_0.mcap') == 5000)


def test_full_disk_stops_the_recorder_with_one_error(rig, tmp_path):
    with small_disk(tmp_path / 'disk', 2) as disk:
        process = rig.record(disk / 'bag', 'a')
        deadline = time.monotonic() + PATIENCE
        while process.poll() is None:
            assert time.monotonic() < deadline, 'still recording'
            rig.publish(*range(100))
        _, output = process.communicate()
        assert process.returncode == 1
        hint = f'No space left on device; blf_dsc recover {disk / "bag"}'
        assert output.count(hint) == output.count('No space left') == 1
        assert 'Traceback' not in output
        assert recover(disk / 'bag', tmp_path / 'clean').messages['/a'] > 1000


def test_unknown_message_packages_are_not_imported_and_do_not_stop_the_recorder(rig, tmp_path):
    process = rig.record(tmp_path / 'bag', ['a', 'f', 'g', 'h', 'i'])
    names = {'f': 'unittest::__main__::X', 'g': 'foo::X', 'h': 'unittest::msg::X', 'i': 'X'}
    odd = [sys.executable, ODD_PARTICIPANT]
    rig.start([*odd, *(f'{topic}={name}' for topic, name in names.items())])
    output = wait_for_lines(process, [f'/{topic} is not recorded: its type' for topic in names])
    assert output.count('/g is not recorded') == 1
    assert '/f is not recorded: its type unittest/__main__/X is not installed here' in output
    assert '/g is not recorded: its type foo/X is not installed here' in output
    rig.publish(1)
    rig.start([*odd, 'j=std_msgs::msg::\udce4'])  # not UTF-8
    wait_for_lines(process, ['the name of a topic or type is not UTF-8'])
    rig.publish(2)
    encoded = ENCODER.encode(1, [1, 2], [3, 4], [5, 6])[12:]  # after the stamp
    rig.until(lambda: (tmp_path / 'bag' / 'bag_0.mcap').read_bytes().count(encoded) == 2)
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


# Beside a loop in real time.


@pytest.fixture(scope='module')
def out(tmp_path_factory):
    """Results of a run in real time."""
    folder = tmp_path_factory.mktemp('run')
    config = folder / 'fifo.yaml'
    # Only one node, which cannot keep the others from both processors.
    fifo = 'sim_plant:\n  ros__parameters:\n    realtime: {priority: 10, lock_memory: true}\n'
    config.write_text(fifo + PATIENT)
    arguments = ('--config', config, '--mode', 'realtime', '--duration', DURATION)
    run = closed_loop(*arguments, '--out', folder / 'out')
    assert run.returncode == 0, run.stderr
    (folder / 'out' / 'output.txt').write_text(run.stdout)
    return folder / 'out'


def test_timing_and_permissions_are_reported(out):
    timing = json.loads((out / 'summary.json').read_text())['timing']
    assert set(timing) == {'rate_hz', 'latency_us', 'late_steps'}
    assert timing['rate_hz'] > 0.0
    assert list(timing['latency_us']) == ['p50', 'p99', 'p99.9', 'max']
    assert timing['late_steps'] >= 0
    output = (out / 'output.txt').read_text()
    assert 'real time' in output
    assert 'late steps' in output
    log = (out / 'logs' / f'{topics.PLANT}.log').read_text()
    # Granted or denied, as this machine permits, but always logged.
    assert 'SCHED_FIFO priority 10' in log
    assert 'memory' in log


def test_every_message_of_a_real_time_loop_is_in_the_bag(out):
    recorded = defaultdict(list)
    with (out / 'bag' / 'bag_0.mcap').open('rb') as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            recorded[channel.topic].append(message.sequence)
    facts = read_content(out / 'bag').facts
    for topic in EACH_SAMPLE:
        count = len(recorded[topic.resolved])
        assert recorded[topic.resolved] == list(range(1, count + 1))
        assert facts[f'messages {topic.resolved}'] == f'{count} written, 0 missed'
    logs = [
        (out / 'logs' / f'{node}.log').read_text() for node in (topics.PLANT, topics.CONTROLLER)
    ]
    # On a busy machine the first torque may take seconds, and the plant sends its state again.
    again = logs[0].count('sending the state again')
    assert len(recorded[topics.JOINT_STATES.resolved]) == 1000 * DURATION + 1 + again
    assert len(recorded[topics.TIMING.resolved]) == 1000 * DURATION  # one for each step
    # On a busy machine the controller may skip a state; it then publishes nothing for it.
    answered = (topics.REFERENCE, topics.TRACKING_ERROR, topics.LEARNING)
    assert len({len(recorded[topic.resolved]) for topic in answered}) == 1
    # Nor were the last ones lost, which no later sequence number would reveal.
    assert not any('not reach every' in log for log in logs)
