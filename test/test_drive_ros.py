# SPDX-License-Identifier: Apache-2.0
"""Topics beside `blf_dsc drive`: those of the node, motions that are followed, ROS that is lost.

The simulated arm waits a millisecond after each state, as a robot does: in this time
the test's own nodes run, and the process of the topics.
"""

from __future__ import annotations

import re
import signal
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from plant_driver import PlantDriver
from rclpy.duration import Duration
from recorded_run import messages_of
from ros_rig import JOINTS, PATIENCE
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

import blf_dsc_controller as blf
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.drive import ros_topics
from blf_dsc_controller.drive.loop import DriveLoop, End
from blf_dsc_controller.drive.ros_topics import RosTopics
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import decode

HOLD = {'safety.torque': 'hold_gravity', 'limits.acceleration': [6.0, 6.0]}
CONFIG = blf.change(blf.load_loop('recommended').controller, HOLD)
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
    assert kinds[:2] == ['configure', 'activate']
    assert 'brake' in kinds
    assert {each.name for each in diagnostics[-1].status} == {
        f'blf_dsc_controller/{part}' for part in ('state', 'loop', 'learning')
    }
    assert blf.verify(tmp_path / 'bag').difference is None
    stamp = blf.read_run(tmp_path / 'bag').stamp[0]
    assert abs(time.time_ns() - stamp) < 1e9 * PATIENCE  # of the wall clock


def test_stop_that_a_silent_loop_has_not_confirmed_fails_and_brakes_when_it_goes_on(
    ros, beside, tmp_path
):
    """The robot has fallen silent, twice; in a namespace.

    The answer to the first stop, which comes late, is none to the second.
    """
    client = ros.tester.create_client(Trigger, '/left/blf_dsc_controller/stop')
    answers = []

    def between(count, *_):
        time.sleep(0.001)
        if count in (50, 100):
            ros.until(client.service_is_ready)
            future = client.call_async(Trigger.Request())
            ros.until(future.done)
            answers.append(future.result())

    beside(between, tmp_path, duration=0.3, namespace='left')
    journal = messages_of(tmp_path / 'bag')[topics.JOURNAL.resolved]
    braked = [each for each in map(decode, journal) if each.type == 'brake']
    for answer in answers:
        assert not answer.success
        assert 'not confirmed: the loop has not answered for 1 s' in answer.message
    # the first after each silence
    assert [each.messages for each in braked] == [51, 101]


@pytest.mark.parametrize(
    ('number', 'problem'),
    [
        (signal.SIGKILL, 'ROS ended before the loop'),
        (signal.SIGSTOP, r'ROS did not take \d{3,} messages in time'),
    ],
)
def test_loop_does_not_notice_that_ros_is_lost(
    beside, tmp_path, monkeypatch, number, problem
):
    """Each torque is, bit for bit, that without ROS; what is lost is said."""
    monkeypatch.setattr(ros_topics, '_END', 0.5)

    def between(count, _, beside):
        time.sleep(0.001)
        if count == 100:
            beside._ros.process.send_signal(number)
            beside._link._most = 10_000  # bytes that wait
            if number == signal.SIGKILL:
                beside._ros.process.wait()

    driver, outcome, after = beside(between, tmp_path, duration=0.6)
    assert outcome.end is End.DURATION
    assert re.match(problem, after.problem)
    alone = PlantDriver('plant', CONFIG, DriveConfig())
    alone.connect()
    with blf.ArmController(CONFIG) as controller:
        DriveLoop(alone, controller, duration=0.6).run()
    np.testing.assert_array_equal(driver.torques, alone.torques)


def test_ros_that_does_not_start_is_an_error_with_a_remedy(monkeypatch, capfd):
    monkeypatch.setattr(ros_topics, '_PROCESS', 'blf_dsc_controller.no_such_module')
    with pytest.raises(blf.BlfDscError, match=r'see above; without --ros the robot'):
        RosTopics(blf.ArmController(CONFIG))
    assert 'no_such_module' in capfd.readouterr().err
