# SPDX-License-Identifier: Apache-2.0
"""Topics beside `blf_dsc drive`: those of the node, motions that are followed, ROS that is lost.

The simulated arm waits a millisecond after each state, as a robot does: in this time
the test's own nodes run, and the process of the topics.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import rclpy
from plant_driver import PlantDriver
from rclpy.duration import Duration
from recorded_run import messages_of
from ros_rig import JOINTS, PATIENCE
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.drive import ros_topics
from blf_dsc_controller.drive.beside import LinkLog
from blf_dsc_controller.drive.loop import DriveLoop, End
from blf_dsc_controller.drive.ros_topics import RosTopics
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topic_link, topics
from blf_dsc_controller.messages.journal import EventType, decode
from blf_dsc_controller.messages.link import Link
from blf_dsc_controller.messages.topic_link import KINDS, STOP
from blf_dsc_controller.nodes import topics_process
from blf_dsc_controller.nodes.topics_process import LoopTopics

HOLD = {'safety.torque': 'hold_gravity', 'limits.acceleration': [6.0, 6.0]}
CONFIG = change(blf.load_loop('recommended').controller, HOLD)
PUBLISHED = (
    topics.JOINT_STATES,
    topics.COMMANDS,
    topics.REFERENCE,
    topics.TRACKING_ERROR,
    topics.BOUND,
    topics.MONITOR,
)
EVENTS = (topics.JOURNAL, topics.TARGETS)


class PacedDriver(PlantDriver):
    """The simulated arm, with something to do between two states."""

    def __init__(self, *given):
        super().__init__(*given)
        self.between = None

    def read(self):
        self.between(self.count)
        return super().read()


@pytest.fixture
def beside(ros, monkeypatch):
    """Return a function that runs the loop with topics, and something between two states."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(ros.context.get_domain_id()))

    def run(between, tmp_path, duration=60.0, namespace=''):
        driver = PacedDriver('plant', CONFIG, DriveConfig())
        driver.connect()
        controller = blf.ArmController(CONFIG, record=tmp_path / 'bag', stamps='wall')
        beside = RosTopics(controller, namespace)
        try:
            with controller:
                loop = DriveLoop(driver, controller, duration=duration, beside=beside)
                driver.between = lambda count: between(count, loop, beside)
                outcome = loop.run()
        finally:
            beside.close()
        return driver, outcome, beside

    return run


def waypoint(positions):
    """Return a trajectory of one point, a second ahead."""
    point = JointTrajectoryPoint(positions=positions)
    point.time_from_start = Duration(seconds=1.0).to_msg()
    return JointTrajectory(joint_names=JOINTS, points=[point])


def test_topics_are_those_of_the_bag_and_motions_are_followed(ros, beside, tmp_path):
    """Every message arrives, byte for byte; a trajectory and a stop on their real way."""
    received = {topic: ros.listen(topic, raw=True) for topic in PUBLISHED + EVENTS}
    state = ros.listen(topics.STATE)
    diagnostics = ros.listen(topics.DIAGNOSTICS)
    sender = ros.publisher(topics.JOINT_TRAJECTORY)
    client = ros.tester.create_client(Trigger, '/blf_dsc_controller/stop')
    did = {}

    def is_heard(beside):
        """Whether a status arrives: its subscription is the last one that the process learns of."""
        beside._tell_status(beside._guard)
        beside._link.flush()
        return diagnostics

    def between(count, loop, beside):
        ros.executor.spin_once(timeout_sec=0.001)
        events = [decode(raw) for raw in received[topics.TARGETS]]
        if count == 0:
            ros.until(
                lambda: (
                    client.service_is_ready()
                    and sender.get_subscription_count()
                    and is_heard(beside)
                )
            )
        if count == 500:
            sender.publish(waypoint([2.0, 1.5]))
        elif events and 'stop' not in did and count > 1300:
            did['stop'] = client.call_async(Trigger.Request())
        elif 'stop' in did and did['stop'].done() and 'end' not in did:
            did['end'] = True
            loop.request_end()

    _, outcome, after = beside(between, tmp_path)
    assert (outcome.end, after.problem) == (End.REQUESTED, '')
    assert did['stop'].result().success
    assert 'braking for' in did['stop'].result().message
    bag = messages_of(tmp_path / 'bag')
    ros.until(
        lambda: all(
            len(raws) >= len(bag[topic.resolved]) for topic, raws in received.items()
        )
    )
    ros.until(lambda: 'not in command' in state[-1].message)
    for topic, raws in received.items():
        messages, wanted = raws, bag[topic.resolved]
        if topic in EVENTS:  # strings, which the middleware pads
            wanted, messages = (list(map(decode, each)) for each in (wanted, messages))
        assert messages == wanted, topic.name
    (sent,) = [decode(raw) for raw in received[topics.TARGETS]]
    assert sent.content['points'][0]['positions'] == [2.0, 1.5]
    kinds = [decode(raw).type for raw in received[topics.JOURNAL]]
    assert kinds[:2] == [EventType.CONFIGURE, EventType.ACTIVATE]
    assert EventType.BRAKE in kinds
    assert {each.name for each in diagnostics[-1].status} == {
        f'blf_dsc_controller/{part}' for part in ('state', 'loop', 'learning')
    }
    assert blf.verify(tmp_path / 'bag').difference is None
    stamp = blf.read_run(tmp_path / 'bag').stamp[0]
    assert abs(time.time_ns() - stamp) < 1e9 * PATIENCE  # of the wall clock


def test_status_is_told_every_second_and_as_soon_as_the_state_changes(monkeypatch):
    """By a clock and a state that are made up."""
    now, state, told = [100.0], SimpleNamespace(revision=3), []
    monkeypatch.setattr(ros_topics, 'monotonic', lambda: now[0])
    beside = RosTopics.__new__(RosTopics)
    beside._guard = SimpleNamespace(supervisor=state)
    beside._reported = 100.0, 3
    beside._tell_status = lambda _: told.append((now[0], state.revision))
    for now[0], state.revision in ((100.5, 3), (100.6, 4), (100.7, 4), (101.7, 4)):
        beside._tell_changes()
    assert told == [(100.6, 4), (101.7, 4)]


def test_stop_that_a_silent_loop_has_not_confirmed_fails_and_brakes_when_it_goes_on(
    ros, beside, tmp_path
):
    """The robot has fallen silent; in a namespace."""
    client = ros.tester.create_client(Trigger, '/left/blf_dsc_controller/stop')
    answers = []

    def between(count, *_):
        time.sleep(0.001)
        if count == 50:
            ros.until(client.service_is_ready)
            future = client.call_async(Trigger.Request())
            ros.until(future.done)
            answers.append(future.result())

    beside(between, tmp_path, duration=0.3, namespace='left')
    journal = messages_of(tmp_path / 'bag')[topics.JOURNAL.resolved]
    braked = [each for each in map(decode, journal) if each.type is EventType.BRAKE]
    (answer,) = answers
    assert not answer.success
    assert 'not confirmed: the loop has not answered for 1 s' in answer.message
    assert [each.messages for each in braked] == [51]  # the first after the silence


@pytest.mark.parametrize(
    ('number', 'problem'),
    [
        (signal.SIGKILL, 'ROS ended before the loop'),
        (signal.SIGSTOP, 'ROS did not take the last messages'),
    ],
)
def test_loop_does_not_notice_that_ros_is_lost(
    beside, tmp_path, monkeypatch, number, problem
):
    """Each torque is, bit for bit, that without ROS."""
    monkeypatch.setattr(ros_topics, '_END', 0.5)

    def between(count, _, beside):
        time.sleep(0.001)
        if count == 100:
            beside._process.send_signal(number)
            if number == signal.SIGKILL:
                beside._process.wait()

    driver, outcome, after = beside(between, tmp_path, duration=0.6)
    assert outcome.end is End.DURATION
    assert problem in after.problem
    alone = PlantDriver('plant', CONFIG, DriveConfig())
    alone.connect()
    with blf.ArmController(CONFIG) as controller:
        DriveLoop(alone, controller, duration=0.6).run()
    np.testing.assert_array_equal(driver.torques, alone.torques)


def test_ros_that_does_not_start_is_an_error_with_a_remedy(monkeypatch, capfd):
    monkeypatch.setattr(ros_topics, '_PROCESS', 'blf_dsc_controller.no_such_module')
    with pytest.raises(BlfDscError, match=r'see above; without --ros the robot'):
        RosTopics(blf.ArmController(CONFIG))
    assert 'no_such_module' in capfd.readouterr().err


def test_a_namespace_without_topics_is_an_error(capsys):
    assert main(['drive', '--robot', 'plant', '--namespace', 'left']) == 1
    assert '--namespace is for the topics, which need --ros' in capsys.readouterr().err


@pytest.fixture
def loop_topics(ros):
    """Return the topics of a loop, in this process, and the loop's end of their link."""
    ours, theirs = linked()
    node = ros.keep(rclpy.create_node('blf_dsc_controller', context=ros.context))
    return LoopTopics(node, theirs, [KINDS[topics.COMMANDS]], JOINTS), ours


def test_loop_logs_at_any_level_in_any_order(loop_topics, capfd):
    """As of a trajectory that is followed, one that is not, and a stop after it."""
    beside, loop = loop_topics
    log = LinkLog(loop)
    log.info('followed')
    log.warning('rejected')
    log.info('braking')
    log.error('recorded in part')
    loop.flush()
    for kind, content in beside._link.messages():
        beside.take(kind, content)
    out, err = capfd.readouterr()
    logged = re.findall(r'^\[(\w+)\].*: (.+)$', out + err, re.MULTILINE)
    assert logged == [
        ('INFO', 'followed'),
        ('WARN', 'rejected'),
        ('INFO', 'braking'),
        ('ERROR', 'recorded in part'),
    ]


def test_late_answer_to_a_stop_is_none_to_the_next(loop_topics, monkeypatch):
    """Else a loop that hangs since then would seem to brake."""
    beside, loop = loop_topics
    monkeypatch.setattr(topics_process, '_PATIENCE', 0.05)
    with pytest.raises(BlfDscError, match='not confirmed'):
        beside._stop()
    loop.put(STOP, topic_link.encode('braking for 1 s'))
    loop.flush()
    for kind, content in beside._link.messages():
        beside.take(kind, content)
    with pytest.raises(BlfDscError, match='not confirmed'):
        beside._stop()


def linked(most=1 << 20):
    ours, theirs = socket.socketpair()
    return Link(ours, most), Link(theirs, most)


def test_messages_arrive_whole_in_order_and_of_any_size():
    ours, theirs = linked(64 << 20)
    sent = [(k, os.urandom(k**3)) for k in range(100)]
    for each in sent:
        ours.put(*each)
    got = []
    while len(got) < len(sent):
        ours.flush()
        got += theirs.messages()
    assert got == sent


def test_wait_ends_with_a_message_and_not_before():
    ours, theirs = linked()
    sender = threading.Timer(0.2, lambda: (ours.put(3, b'late'), ours.flush()))
    sender.start()
    theirs.wait(60.0)
    assert [*theirs.messages()] == [(3, b'late')]
    sender.join()
    ours.close()
    theirs.wait(60.0)
    assert [*theirs.messages()] == []
    assert theirs.broken


def test_what_is_not_taken_is_dropped_and_counted_and_the_rest_is_whole():
    ours, theirs = linked()
    for k in range(100):
        ours.put(k, bytes(50_000))
        ours.flush()
    assert ours.lost > 0
    got = []
    while len(got) < 100 - ours.lost:
        ours.flush()
        got += theirs.messages()
    assert [kind for kind, _ in got] == sorted(kind for kind, _ in got)
    assert all(content == bytes(50_000) for _, content in got)
    theirs.close()
    ours.put(0, b'')
    ours.flush()
    assert ours.broken
