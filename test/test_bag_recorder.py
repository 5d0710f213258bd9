# SPDX-License-Identifier: Apache-2.0
"""The recorder: what it records, kills, a full disk, odd types, beside a loop.

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
from collections import Counter, defaultdict
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import PATIENCE, PATIENT, closed_loop
from mcap.reader import make_reader
from nav_msgs.msg import Goals
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from recorded_run import messages_on_disk, read
from ros_rig import RosRig
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState

from blf_dsc_controller.analysis.report import read_bag
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.bags.recovery import recover
from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    JointStateEncoder,
    joint_state_stamp,
)
from blf_dsc_controller.nodes.recorder_node import BagRecorderNode

# s
KILLS, MOST, DURATION = (20, 10_000, 60) if os.environ.get('NIGHTLY') else (1, 1000, 1)
RECORDER = (
    sys.executable,
    '-m',
    'blf_dsc_controller.nodes.recorder_node',
    '--ros-args',
)
REALTIME = 'import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))'
ODD_PARTICIPANT = Path(__file__).with_name('odd_participant.py')
ENCODER = JointStateEncoder(['joint1', 'joint2'])
# Kept for the recorder, which may match slightly later than the publisher.
KEPT = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = ('a', 'b', 'c', 'd', 'e')


def encoded(number):
    """Return a joint state with this number as its stamp [ns]."""
    return ENCODER.encode(number, [1, 2], [3, 4], [5, 6])


# In the process of its publishers.


@pytest.fixture
def bag(tmp_path):
    return tmp_path / 'bag'


def connected(ros, recorder, type_, topic, quality=100):
    """Return a publisher of the test that the recorder has subscribed to."""
    publisher = ros.tester.create_publisher(type_, topic, quality)
    until_subscribed(ros, recorder, publisher)
    return publisher


def until_subscribed(ros, recorder, *publishers):
    """Spin until the recorder has these topics, and its subscriptions and publishers matched."""
    ros.until(
        lambda: all(
            each.topic_name in recorder.bag.message_counts
            and each.get_subscription_count()
            for each in publishers
        )
    )


def until_recorded(ros, recorder, **counts):
    """Spin until the recorder has at least these numbers of messages by topic."""
    found = recorder.bag
    ros.until(
        lambda: all(
            found.message_counts.get(f'/{k}', 0) >= n for k, n in counts.items()
        )
    )


def test_messages_are_recorded_byte_for_byte(ros, bag):
    recorder = ros.add(BagRecorderNode, output=str(bag))
    publisher = connected(ros, recorder, JointState, 'joint_states')
    sent = [encoded(k) for k in range(1050)]
    before = time.time_ns()
    for k, raw in enumerate(sent):
        publisher.publish(raw)
        if k % 50 == 49 and k < 1000:
            until_recorded(ros, recorder, joint_states=k + 1)
            after = time.time_ns()
    assert publisher.wait_for_all_acked()
    recorder.close()
    states = [entry for entry in read(bag) if entry[0] == '/joint_states']
    # The last ones were received before it was closed, without spinning the executor
    # once more.
    assert [raw for _, _, raw in states] == sent
    stamps = [stamp for _, stamp, _ in states[:1000]]
    assert [before, *stamps, after] == sorted([before, *stamps, after])


def test_plant_as_the_clock_logs_at_the_stamp_of_the_last_joint_state(ros, bag):
    """What comes before the first of them waits for it.

    Stamps that fall do not set time back.
    """
    topics = ['early', 'joint_states']
    given = {'output': str(bag), 'clock': 'plant', 'topics': topics}
    recorder = ros.add(BagRecorderNode, given)
    early, states = (connected(ros, recorder, JointState, each) for each in topics)
    for publisher, numbers in ((early, (1, 2)), (states, (70, 90, 80))):
        for number in numbers:
            publisher.publish(encoded(number))
        ros.until(lambda: len(recorder.waiting) == 2 or recorder.plant_time == 90)
    until_recorded(ros, recorder, early=2, joint_states=3)
    recorder.close()
    assert [(topic[1:], at) for topic, at, _ in read(bag)] == [
        *(('early', 70), ('early', 70), ('joint_states', 70)),
        *(('joint_states', 90), ('joint_states', 90)),
    ]


def test_topics_of_every_quality_and_type_are_recorded_as_offered(ros, bag):
    """Latched before the recorder came, best effort, and both on one topic.

    Not those of others.

    Also a type of a package that rosbags does not know.
    """
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    create = ros.tester.create_publisher
    create(JointState, 'bound', KEPT).publish(JointState(name=['early']))
    other = create(JointState, 'other', 10)
    chosen = ['bound', 'sensor', '/mixed', '/never', 'goals']
    recorder = ros.add(BagRecorderNode, output=str(bag), topics=chosen)
    kinds = (('sensor', best_effort), ('mixed', KEPT), ('mixed', best_effort))
    publishers = [create(JointState, topic, quality) for topic, quality in kinds]
    publishers.append(create(Goals, 'goals', 100))
    until_subscribed(ros, recorder, *publishers)
    for publisher in publishers:
        publisher.publish(publisher.msg_type())
    until_recorded(ros, recorder, bound=1, sensor=1, mixed=2, goals=1)
    assert other.get_subscription_count() == 0
    recorder.close()
    messages = read(bag)
    assert Counter(topic for topic, _, _ in messages) == {
        '/bound': 1,
        '/mixed': 2,
        '/sensor': 1,
        '/goals': 1,
    }
    early = [raw for topic, _, raw in messages if topic == '/bound']
    assert b'early' in early[0]
    with Reader(bag) as reader:
        found = {connection.topic: connection for connection in reader.connections}
    assert 'geometry_msgs/Quaternion' in found['/goals'].msgdef.data
    (offered,) = found['/bound'].ext.offered_qos_profiles
    mixed = found['/mixed'].ext.offered_qos_profiles
    # The graph knows neither history nor depth.
    latched = (offered.durability.name, offered.history.name)
    assert latched == ('TRANSIENT_LOCAL', 'UNKNOWN')
    kinds = {quality.reliability.name for quality in mixed}
    assert kinds == {'RELIABLE', 'BEST_EFFORT'}


def test_message_that_two_subscriptions_bring_is_recorded_once(ros, bag):
    """A best-effort publisher that appears later needs a subscription of its own."""
    recorder = ros.add(BagRecorderNode, output=str(bag), topics=['mixed'])
    first = connected(ros, recorder, JointState, 'mixed')
    unreliable = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    late = ros.tester.create_publisher(JointState, 'mixed', unreliable)
    ros.until(lambda: first.get_subscription_count() == 2)
    until_subscribed(ros, recorder, late)
    for k in range(20):
        first.publish(encoded(k))
    until_recorded(ros, recorder, mixed=20)
    late.publish(encoded(99))
    until_recorded(ros, recorder, mixed=21)
    ros.spin(0.2)
    recorder.close()
    assert [joint_state_stamp(raw) for *_, raw in read(bag)] == [*range(20), 99]


def test_losses_are_counted_and_reported(ros, bag, capfd):
    """Messages sent before the recorder connected, and those dropped by a full queue."""
    publisher = ros.tester.create_publisher(JointState, 'joint_states', 100)
    for k in range(7):  # nobody subscribes yet, and nothing is kept
        publisher.publish(encoded(k))
    recorder = ros.add(
        BagRecorderNode, output=str(bag), topics=['joint_states'], queue_depth=5
    )
    until_subscribed(ros, recorder, publisher)
    for burst, count in ((range(8, 9), 1), (range(9, 59), 6)):
        for k in burst:
            publisher.publish(encoded(k))
        assert publisher.wait_for_all_acked()
        until_recorded(ros, recorder, joint_states=count)
    recorder.close()
    missed = 51 - len(read(bag))
    assert missed > 0
    lost = f'{missed} missed, 7 sent before the recorder connected'
    assert f'/joint_states: {51 - missed} messages' in capfd.readouterr().err
    assert read_content(bag).losses == {'/joint_states': lost}
    shown = read_bag(bag)
    assert ('lost', f'/joint_states: {lost}') in [event[1:] for event in shown.events]


# In a process of its own.


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
            for publisher in self.publishers:
                publisher.publish(encoded(number))
            # not faster than the 20,000 a second of a fast lock-step run
            if number % 20 == 19:
                time.sleep(0.005)

    def end(self, process, number=signal.SIGINT):
        """Stop a recorder by a signal; return its exit code and output."""
        process.send_signal(number)
        return self.output(process)

    def output(self, process):
        """Wait for the end of a recorder; return its exit code and output."""
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


def test_all_is_on_disk_while_it_runs_and_ctrl_c_completes_the_bag(rig, bag):
    process = rig.record(bag)
    rig.publish(*range(2000))  # then no message follows to flush it
    rig.until(lambda: messages_on_disk(bag / 'bag_0.mcap') == 10_000)
    code, output = rig.end(process)
    assert code == 0, output
    assert Counter(topic for topic, *_ in read(bag)) == {
        f'/{topic}': 2000 for topic in TOPICS
    }
    assert all(f'/{topic}: 2000 messages' in output for topic in TOPICS)
    assert 'invalid' not in output  # a context that was shut down


def test_signal_before_any_message_leaves_an_empty_bag_that_is_not_overwritten(
    rig, bag
):
    for code, words in ((0, '/never: never appeared'), (1, f'{bag} exists already')):
        process = rig.record(bag, ['never'])
        rig.until(lambda code=code: code or bag.exists())
        returned, output = (
            rig.end(process, signal.SIGTERM) if code == 0 else rig.output(process)
        )
        assert (returned, words in output) == (code, True), output
        assert read(bag) == []


def test_unknown_message_packages_are_not_imported_and_do_not_stop_the_recorder(
    rig, bag
):
    process = rig.record(bag, ['a', 'f', 'g', 'h', 'i'])
    names = {
        'f': 'unittest::__main__::X',
        'g': 'foo::X',
        'h': 'unittest::msg::X',
        'i': 'X',
    }
    odd = [sys.executable, ODD_PARTICIPANT]
    rig.start([*odd, *(f'{topic}={name}' for topic, name in names.items())])
    output = wait_for_lines(
        process, [f'/{topic} is not recorded: its type' for topic in names]
    )
    assert output.count('/g is not recorded') == 1
    assert (
        '/f is not recorded: its type unittest/__main__/X is not installed here'
        in output
    )
    assert '/g is not recorded: its type foo/X is not installed here' in output
    rig.publish(1)
    rig.start([*odd, 'j=std_msgs::msg::\udce4'])  # not UTF-8
    wait_for_lines(process, ['the name of a topic or type is not UTF-8'])
    rig.publish(2)
    content = encoded(1)[12:]  # after the stamp
    rig.until(lambda: (bag / 'bag_0.mcap').read_bytes().count(content) == 2)
    assert rig.end(process)[0] == 0
    assert [topic for topic, _, _ in read(bag)] == ['/a', '/a']


def wait_for_lines(process, expected):
    """Read the output of a recorder until it has all expected texts; return it."""
    output = ''
    while not all(text in output for text in expected):
        line = process.stderr.readline()
        assert line, f'it has ended: {output}'
        output += line
    return output


@pytest.mark.parametrize('k', range(KILLS))
def test_kill_loses_nothing_that_was_written(k, rig, bag, tmp_path):
    """How soon it is written: see test_data_is_flushed_periodically."""
    process = rig.record(bag)
    rig.publish(*range(random.Random(k).randrange(50, MOST)))  # noqa: S311
    written = messages_on_disk(bag / 'bag_0.mcap')
    process.kill()
    process.wait()
    *cut, last = recover(bag, tmp_path / 'clean').losses
    assert 'the recording was not closed' in last
    assert all('(cut off)' in loss for loss in cut)
    numbers = {f'/{topic}': [] for topic in TOPICS}
    for topic, _, raw in read(tmp_path / 'clean'):
        numbers[topic].append(joint_state_stamp(raw))
    assert sum(map(len, numbers.values())) >= written
    assert all(found == list(range(len(found))) for found in numbers.values())


def test_real_time_loop_is_timed_and_every_message_of_it_is_in_the_bag(tmp_path):
    """The arm rests in a horizontal plane, whatever a busy computer does to the loop."""
    # Only one node in real time, which cannot keep the others from both processors.
    fifo = (
        'sim_plant:\n  ros__parameters:\n    arm: {gravity: 0.0}\n'
        '    realtime: {priority: 10}\n'
    )
    # Soft: with the delays of a busy computer, the gains for 1 kHz would shake the arm.
    at_rest = (
        '    reference: {type: hold}\n    two_link.gravity: 0.0\n'
        '    two_link.barrier_weight: [1.0, 1.0]\n'
        '    two_link.surface_gain: [1.0, 1.0]\n    two_link.mu: [1.0, 1.0]\n'
        '    two_link.feedback_gain: [1.0, 1.0]\n    disturbance.gain: [0.0, 0.0]\n'
        '    learning: {enabled: false}\n'
    )
    config = tmp_path / 'fifo.yaml'
    out = tmp_path / 'out'
    config.write_text(fifo + PATIENT + at_rest)
    arguments = ('--config', config, '--mode', 'realtime', '--duration', DURATION)
    run = closed_loop(*arguments, '--out', out)
    assert run.returncode == 0, run.stdout + run.stderr
    assert 'late steps' in run.stdout
    timing = json.loads((out / 'summary.json').read_text())['timing']
    assert set(timing) == {'rate', 'latency', 'late_steps'}
    assert list(timing['latency']) == ['p50', 'p99', 'p99.9', 'max']
    numbers = defaultdict(list)
    with (out / 'bag' / 'bag_0.mcap').open('rb') as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            numbers[channel.topic].append(message.sequence)
    every_sample = (topics.JOINT_STATES, topics.TIMING, topics.COMMANDS)
    for topic in (*every_sample, topics.TRACKING_ERROR, topics.MONITOR):
        found = numbers[topic.resolved]
        assert found == list(range(1, len(found) + 1))
    # On a busy machine the first torque may take seconds, and the plant sends its state
    # again.
    log = (out / 'logs' / f'{PLANT}.log').read_text()
    again = log.count('sending the state again')
    # what the system refuses is named, with who can grant it
    asked = [sys.executable, '-c', REALTIME]
    granted = subprocess.run(asked, capture_output=True, check=False).returncode == 0
    assert ('rtprio' in log) is not granted
    assert len(numbers[topics.JOINT_STATES.resolved]) == 1000 * DURATION + 1 + again
    assert len(numbers[topics.TIMING.resolved]) == 1000 * DURATION  # one for each step
    # Nor were the last ones lost, which no later sequence number would reveal.
    assert 'not reach every' not in log
    assert read_content(out / 'bag').losses == {}
