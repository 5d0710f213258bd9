# SPDX-License-Identifier: Apache-2.0
"""Approaches, sent trajectories and narrowing bounds over ROS, in lock-step in one process."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from rclpy.time import Time
from ros_rig import JOINTS
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

import blf_dsc_controller as blf
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import joint_trajectory
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.journal import decode
from blf_dsc_controller.reference.terms import sampled

PATIENT = {'safety__state_timeout': 60.0}
PLANNED = {
    watchdog: PATIENT | {'safety__watchdog': watchdog} for watchdog in ('on', 'off')
}


SECOND = 1_000_000_000
FIELDS = ('positions', 'velocities', 'accelerations')


def trajectory(*, duration, fields=3, stamp=0, spacing=0.05):
    """Return a trajectory into a sinusoid within a second, at rest a second after it."""
    sent = JointTrajectory(joint_names=JOINTS)
    sent.header.stamp = Time(nanoseconds=stamp).to_msg()
    times = 1.0 + spacing * np.arange(round(duration / spacing))
    size = np.array([0.2, -0.25])  # rad
    sine, cosine = (np.outer(wave(times), size) for wave in (np.sin, np.cos))
    points = [*zip(np.add(sine, (1.9, 1.4)), cosine, -sine, strict=True)]
    rest = points[-1][0], 0.0 * size, 0.0 * size
    for t, point in zip((*times, times[-1] + 1.0), (*points, rest), strict=True):
        at = Duration(nanoseconds=round(t * 1e9)).to_msg()
        arrays = dict(zip(FIELDS, point[:fields], strict=False))
        sent.points.append(JointTrajectoryPoint(**arrays, time_from_start=at))
    return sent


def inputs(law):
    """Return the status of the trajectories that a controller was sent."""
    return law.status.trajectories


def send(ros, law, sent):
    """Send a trajectory.

    Return the reason of the last rejection, empty if there was none.
    """
    name = '/' + topics.JOINT_TRAJECTORY.relative
    publisher = ros.tester.create_publisher(JointTrajectory, name, 10)
    ros.until(lambda: publisher.get_subscription_count() > 0)
    before = inputs(law).accepted + inputs(law).rejected
    publisher.publish(sent)
    ros.until(lambda: inputs(law).accepted + inputs(law).rejected > before)
    ros.tester.destroy_publisher(publisher)
    return inputs(law).reason


def phase(law):
    return law.guard.supervisor.phase


def test_long_chunk_is_followed_from_the_sample_that_was_promised_on(ros):
    """2,000 points, decoded and planned beside the loop: every sample comes, none is late."""
    references = ros.listen(topics.REFERENCE)
    motions = ros.listen(topics.TARGETS, raw=True)
    arm, law = ros.loop(None, PLANNED['on'] | {'telemetry__decimation': 1})
    ros.run(arm, 200)
    before = law.guard.controller.reference_vector.copy()
    sent = trajectory(duration=10.0, spacing=5e-3)
    assert send(ros, law, sent) == ''
    ros.run(arm, 3000)
    after = law.guard.controller.reference_vector
    ros.until(lambda: motions and len(references) > 3000)
    promised = decode(motions[0]).content['at']
    begin = law.guard.reference.start_stamp
    stamps = [Time.from_msg(each.header.stamp).nanoseconds for each in references]
    assert set(np.diff(stamps)) == {SECOND // 1000}
    times = 1e-9 * (np.array(stamps) - begin)
    q = np.array([each.position for each in references])
    is_old = times < promised
    # how many depends on the computer: lock-step does not wait for the planning
    assert 200 < np.count_nonzero(is_old) < times.size
    np.testing.assert_array_equal(q[is_old], sampled(before, times[is_old])[:, 0])
    np.testing.assert_array_equal(q[~is_old], sampled(after, times[~is_old])[:, 0])


def of_another_arm(sent):
    sent.joint_names = ('joint1', 'elbow')


def oversized(sent):
    sent.points *= 8000


REJECTED = {
    of_another_arm: "its joints are 'joint1', 'elbow', but each of 'joint1', 'joint2' is needed",
    oversized: 'bytes, more than 10000 points can have',
}


@pytest.mark.parametrize(
    ('spoil', 'watchdog'), [(of_another_arm, 'off'), (oversized, 'on')]
)
def test_rejected_trajectory_changes_nothing(ros, spoil, watchdog):
    """Planned in the background, or not."""
    arm, law = ros.loop(None, PLANNED[watchdog])
    ros.run(arm, 20)
    before = law.guard.controller.reference_vector.copy()
    sent = trajectory(duration=0.1)
    spoil(sent)
    assert REJECTED[spoil] in send(ros, law, sent)
    assert inputs(law).rejected == 1
    np.testing.assert_array_equal(law.guard.controller.reference_vector, before)
    ros.run(arm, 20)
    assert phase(law) is blf.Phase.TRACKING


@pytest.mark.parametrize('fields', [1, 3])
def test_trajectory_message_is_decoded_as_by_rclpy(fields):
    message = trajectory(duration=0.2, fields=fields, stamp=5 * SECOND + 7)
    message.header.frame_id = 'base'
    message.points[0].effort = [1.0, 2.0, 3.0]
    raw = serialize_message(message)
    read = joint_trajectory(raw)
    assert (read.stamp, read.names) == (5 * SECOND + 7, JOINTS)
    for (time, arrays), point in zip(read.points, message.points, strict=True):
        expected = (
            point.positions,
            point.velocities,
            point.accelerations,
            point.effort,
        )
        assert arrays == [tuple(values) for values in expected]
        assert (
            time == point.time_from_start.sec * SECOND + point.time_from_start.nanosec
        )
    for end in range(0, len(raw) // 2, 7):
        with pytest.raises(MessageError):
            joint_trajectory(raw[:end])
