# SPDX-License-Identifier: Apache-2.0
"""What happens between two samples is in the bag of the running nodes, and replays bit for bit."""

from __future__ import annotations

import time
from struct import Struct

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import recorded_run
from fake_clock import FakeClock
from rclpy.parameter import Parameter
from ros_rig import RosRig, activate, configure, deactivate
from sent_trajectory import JOINTS, SECOND, send, trajectory

from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.messages.cdr import STAMP_OFFSET
from blf_dsc_controller.messages.encoders import JointStateEncoder
from blf_dsc_controller.messages.topics import (
    ACCEPTED_TRAJECTORY,
    COMMANDS,
    JOINT_STATES,
    JOINT_TRAJECTORY,
    REFERENCE,
    TRACKING_ERROR,
)
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile
from blf_dsc_controller.nodes.process import drain
from blf_dsc_controller.nodes.recorder_node import BagRecorderNode
from blf_dsc_controller.replay.recorded import replay

MILLISECOND = 1_000_000  # ns
BRISK = {
    'limits__acceleration': [4.0, 4.0],  # rad/s^2, for a lead of a second
    'barrier__bound': [0.02, 0.02],  # rad, twenty times what this run needs
}
DAMPED = {'safety__torque': 'hold_gravity', 'safety__damping': [2.0, 1.0]}  # never twice the same


class Recording:
    """A loop in lock-step and its recorder, all in this process."""

    def __init__(self, path, clock=time.monotonic_ns, **controller):
        self.ros = RosRig()
        self.path = path
        self.recorder = self.ros.add(BagRecorderNode, output=str(path))
        complete = {'wait_for_subscribers': 1}
        waiting = complete | {'autostart': False}
        self.arm, self.law = self.ros.loop(waiting, complete | controller, clock=clock)
        configure(self.ros, self.arm)
        # What is changed from here on is not in the configuration that the bag begins with.
        name = self.law.get_fully_qualified_name()
        self.ros.until(lambda: name in self.recorder.parameters_of)
        activate(self.ros, self.arm)

    def run(self, samples):
        self.ros.run(self.arm, samples)

    def change(self, name, value):
        (result,) = self.law.set_parameters([Parameter(name, value=value)])
        assert result.successful, result.reason

    def end(self):
        """Hold the time, let the recorder have everything, and complete the bag."""
        deactivate(self.ros, self.arm)
        self.ros.until(lambda: self.law.guard.last_seen == self.arm.stamp)
        for node in (self.arm, self.law):
            drain(node.publishers)
        self.recorder.close()
        self.ros.close()
        return self.path


@pytest.fixture(scope='module')
def moved(tmp_path_factory):
    """Two trajectories, the second of which waits, and a gain that changes in between."""
    run = Recording(tmp_path_factory.mktemp('moved') / 'bag', **BRISK)
    run.run(200)
    assert send(run.ros, run.law, trajectory(JOINTS, np.zeros(2), duration=1.0)) == ''
    run.run(300)
    run.change('feedback.gain', [50.0, 25.0])
    run.run(200)
    begin = run.law.guard.last_stamp + SECOND // 4
    sent = trajectory(JOINTS[::-1], np.array([0.05, -0.1]), duration=0.5, fields=2, stamp=begin)
    assert send(run.ros, run.law, sent) == ''
    run.run(600)
    (run.path.parent / 'begin').write_text(str(begin))
    return run.end()


@pytest.fixture(scope='module')
def stopped(tmp_path_factory):
    """A pause, two safe stops with a gain changed in the first, starts and a reset after them."""
    run = Recording(tmp_path_factory.mktemp('stopped') / 'bag', **DAMPED)
    run.run(100)
    deactivate(run.ros, run.law)
    run.run(600)  # past the ramp
    activate(run.ros, run.law)
    run.run(200)
    run.arm._start_stamp += SECOND // 10  # the next state is too late
    run.ros.until(lambda: run.law.stopped)
    run.run(50)
    run.change('safety.damping', [4.0, 3.0])
    run.run(50)
    deactivate(run.ros, run.law)
    run.run(50)
    activate(run.ros, run.law)
    run.run(100)
    run.ros.reset(run.law)
    run.run(100)
    deactivate(run.ros, run.arm)  # so that what follows has a place among the states
    name, type_ = JOINT_STATES.relative, message_class(JOINT_STATES.type)
    publisher = run.ros.tester.create_publisher(type_, name, qos_profile(JOINT_STATES.offered))
    run.ros.until(lambda: publisher.get_subscription_count() >= 2)
    stamp = run.law.guard.last_stamp + MILLISECOND
    publisher.publish(JointStateEncoder(JOINTS[:1]).encode(stamp, [0.0], [0.0], [0.0]))
    run.ros.until(lambda: run.law.stopped)
    activate(run.ros, run.arm)
    run.run(50)
    return run.end()


@pytest.fixture
def rewritten(tmp_path):
    """Writes a bag again, with other messages or another configuration."""

    def write(bag, change=lambda entry: entry, configure=lambda text: text):
        entries = [change(list(entry)) for entry in recorded_run.messages(bag)]
        configuration = configure(read_context(bag).configuration)
        return recorded_run.write(tmp_path / 'changed', entries, configuration)

    return write


def flipped(topic, number):
    """Change the last bit of a double at the end of the message with this number."""
    count = iter(range(10**6))

    def change(entry):
        if entry[0] == topic.resolved and next(count) == number:
            raw = bytearray(entry[3])
            raw[-8] ^= 1
            entry[3] = bytes(raw)
        return entry

    return change


def accepted(entry):
    store = typestore()
    return store.deserialize_cdr(entry[3], ACCEPTED_TRAJECTORY.type)


def compared(outcome):
    return {one.topic.rsplit('/', 1)[-1]: one.values for one in outcome.comparisons}


def test_trajectories_and_a_gain_replay_where_they_took_effect(moved):
    outcome = replay(moved)
    assert outcome.difference is None
    assert outcome.remarks == ()
    assert outcome.changes == 1
    assert outcome.done == ('2 trajectories replayed where they took effect',)
    samples = outcome.states.stamp.size
    assert samples >= 1300
    assert compared(outcome)['commands'] == 2 * samples
    assert compared(outcome)['reference'] == 4 * samples


def test_what_is_told_of_a_trajectory_is_what_was_sent_and_when_it_was_taken(moved):
    told = [
        accepted(entry)
        for entry in recorded_run.messages(moved)
        if entry[0] == ACCEPTED_TRAJECTORY.resolved
    ]
    assert [tuple(one.joint_names) for one in told] == [JOINTS, JOINTS[::-1]]
    assert told[0].header.frame_id == ''
    assert told[1].header.frame_id == (moved.parent / 'begin').read_text()
    sent = trajectory(JOINTS, np.zeros(2), duration=1.0)
    for one, other in zip(told[0].points, sent.points, strict=True):
        np.testing.assert_array_equal(one.positions, other.positions)
        np.testing.assert_array_equal(one.accelerations, other.accelerations)
        assert one.time_from_start.nanosec == other.time_from_start.nanosec


def test_a_trajectory_taken_a_sample_later_is_another_run(moved, rewritten):
    stamps = []

    def later(entry):
        if entry[0] == ACCEPTED_TRAJECTORY.resolved and not stamps:
            message = accepted(entry)
            stamps.append(message.header.stamp.sec * SECOND + message.header.stamp.nanosec)
            message.header.stamp.nanosec += MILLISECOND
            raw = typestore().serialize_cdr(message, ACCEPTED_TRAJECTORY.type)
            entry[3] = bytes(raw)
        return entry

    difference = replay(rewritten(moved, later)).difference
    assert difference.stamp == stamps[0] + MILLISECOND


def test_a_trajectory_with_another_value_is_another_run(moved, rewritten):
    def changed(entry):
        if entry[0] == ACCEPTED_TRAJECTORY.resolved:
            message = accepted(entry)
            message.points[0].positions = np.add(message.points[0].positions, [0.0, 1e-9])
            entry[3] = bytes(typestore().serialize_cdr(message, ACCEPTED_TRAJECTORY.type))
        return entry

    outcome = replay(rewritten(moved, changed))
    (reference,) = [one for one in outcome.comparisons if one.topic == REFERENCE.resolved]
    assert reference.difference.stamp == outcome.difference.stamp
    assert reference.difference.field in ('position of joint2', 'velocity of joint2')


def test_a_bag_that_does_not_tell_what_was_taken_says_so(moved, rewritten):
    def sent(entry):
        is_told = entry[0] == ACCEPTED_TRAJECTORY.resolved
        return [JOINT_TRAJECTORY.resolved, *entry[1:]] if is_told else entry

    outcome = replay(rewritten(moved, sent))
    assert outcome.difference is not None
    assert 'the bag does not tell when it took them' in outcome.remarks[0]


def test_stops_ramps_and_starts_replay_with_every_torque(stopped):
    outcome = replay(stopped)
    assert outcome.difference is None
    assert outcome.remarks == ()
    assert outcome.changes == 1
    operations, safe = outcome.done
    assert operations == (
        'replayed in turn: activate, deactivate, activate, safe stop (stamp jump), deactivate, '
        'activate, reset, safe stop (joint missing)'
    )
    torques = sum(entry[0] == COMMANDS.resolved for entry in recorded_run.messages(stopped))
    assert compared(outcome)['commands'] == 2 * torques
    count = torques - outcome.states.stamp.size
    assert count >= 600 + 3 * 50
    assert safe == f'{count} of the commands compared are safe torques, or on the ramp to one'


def stamps(bag, topic):
    raw = [entry[3] for entry in recorded_run.messages(bag) if entry[0] == topic.resolved]
    seconds, nanoseconds = np.array([Struct('<iI').unpack_from(one, STAMP_OFFSET) for one in raw]).T
    return seconds * SECOND + nanoseconds


@pytest.mark.parametrize('part', [0.02, 0.5, 0.9, 0.99])  # on the ramp, after it, in either stop
def test_one_flipped_bit_of_a_safe_torque_is_found(stopped, rewritten, part):
    states = stamps(stopped, JOINT_STATES)
    safe = np.flatnonzero(~np.isin(states, stamps(stopped, TRACKING_ERROR)))
    number = safe[int(part * safe.size)]  # in lock-step the k-th command answers the k-th state
    difference = replay(rewritten(stopped, flipped(COMMANDS, number))).difference
    assert difference.topic == COMMANDS.resolved
    assert difference.stamp == states[number]
    assert difference.field == 'effort of joint2'
    assert difference.recorded != difference.replayed
    assert difference.recorded == pytest.approx(difference.replayed, abs=1e-12)


@pytest.mark.parametrize(
    ('before', 'after', 'departure'),
    [
        ('state_timeout: 0.04', 'state_timeout: 1.0', 'stop: stamp jump'),
        ('error_ratio: 1.0', 'error_ratio: 0.001', r"answered (joint 'joint1' is"),
    ],
)
def test_a_stop_that_only_one_of_the_two_makes_is_a_difference(
    stopped, rewritten, before, after, departure
):
    def configure(text):
        assert before in text
        return text.replace(before, after)

    outcome = replay(rewritten(stopped, configure=configure))
    assert outcome.difference.field.startswith(departure)


def test_a_stop_for_silence_leaves_its_torques_out_and_the_law_is_followed_again(tmp_path):
    clock = FakeClock()
    run = Recording(tmp_path / 'bag', clock, safety__watchdog='on', **DAMPED)
    run.ros.until(lambda: clock.advance(0.01) or run.arm._offered)
    run.run(50)
    deactivate(run.ros, run.arm)
    clock.advance(0.1)
    run.ros.until(lambda: run.law.stopped)
    silent = run.law.guard.last_stamp
    activate(run.ros, run.arm)
    run.ros.until(lambda: clock.advance(0.01) or run.arm._offered)
    run.run(20)
    deactivate(run.ros, run.law)
    activate(run.ros, run.law)  # after a stop with the estimates alone
    run.run(50)
    outcome = replay(run.end())
    assert outcome.difference is None
    turns = 'replayed in turn: activate, safe stop (state timeout), deactivate, activate'
    assert outcome.done[0].startswith(turns)
    (commands,) = [one for one in outcome.comparisons if one.topic == COMMANDS.resolved]
    assert 'state timeout' in commands.left_out
    before = np.count_nonzero(outcome.states.stamp <= silent)
    assert commands.values == 2 * before
    assert outcome.states.stamp.size >= before + 30
    assert compared(outcome)['tracking_error'] == 6 * outcome.states.stamp.size
