# SPDX-License-Identifier: Apache-2.0
"""Streams of targets, chunks, and stops over ROS, in lock-step in one process."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from nights import at_night

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('ruckig', reason='needs ruckig')

from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from ros_rig import JOINTS
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

import blf_dsc_controller as blf
from blf_dsc_controller.messages import topics

PATIENT = {
    'safety__state_timeout': 60.0,
    'limits__acceleration': [6.0, 6.0],
    'telemetry__decimation': 1,
}


def inputs(law):
    return law.status.trajectories


def positions(values):
    return serialize_message(Float64MultiArray(data=list(values)))


def point(values, ahead, velocities=()):
    at = Duration(nanoseconds=round(ahead * 1e9)).to_msg()
    given = JointTrajectoryPoint(positions=list(values), velocities=list(velocities))
    given.time_from_start = at
    return given


def trajectory(*points):
    return serialize_message(JointTrajectory(joint_names=JOINTS, points=points))


def call_stop(ros):
    """Call ~/stop; return its response."""
    client = ros.tester.create_client(Trigger, '/blf_dsc_controller/stop')
    ros.until(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    ros.until(future.done)
    return future.result()


def sway(t):
    return np.array([1.9, 1.4]) + 0.1 * np.sin(2.0 * t) * np.array([1.0, -1.0])


def positions_of(law, k, period):
    inputs(law).take_positions(positions(sway(k * period)))


def points_of(law, k, period):
    inputs(law).take_trajectory(trajectory(point(sway(k * period), period)))


def chunks_of(law, k, period):
    """Send ten points each time, of which the next replaces all but one."""
    if k % 5 == 0:
        times = (k + 1 + np.arange(10)) * period
        chunk = [point(sway(t), t - k * period) for t in times]
        inputs(law).take_trajectory(trajectory(*chunk))


@pytest.mark.parametrize('send', [positions_of, chunks_of, *at_night(points_of)])
def test_stream_is_followed_as_far_behind_as_the_arm_brakes_without_a_jump(ros, send):
    """At 50 Hz, 55 ms behind at most 0.2 rad/s, from which the arm brakes in 35 ms on average.

    Chunks at 10 Hz keep their own times.
    """
    references = ros.listen(topics.REFERENCE)
    arm, law = ros.loop(None, PATIENT)
    ros.run(arm, 50)
    hold = trajectory(point(sway(0.0), 1.5))
    inputs(law).take_trajectory(hold)
    ros.run(arm, 1700)
    start = law.guard.reference.time
    period = 0.02
    for k in range(150):
        send(law, k, period)
        ros.run(arm, 20)
    assert inputs(law).rejected == 0, inputs(law).reason
    ros.until(lambda: len(references) >= 4750)
    q = np.array([each.position for each in references])
    v = np.array([each.velocity for each in references])
    rise = np.abs(np.diff(v, axis=0))
    assert rise.max() <= 6.0e-3 * 1.001  # the limit over a millisecond
    mean = 0.5e-3 * (v[1:] + v[:-1])
    np.testing.assert_allclose(np.diff(q, axis=0), mean, atol=2e-6)
    # after a second to get under way
    t = 1e-3 * np.arange(1000, 2900)
    behind, off = (0.0, 0.5e-3) if send is chunks_of else (0.055, 1e-3)
    wanted = np.array([sway(each - behind) for each in t])
    first = round(start * 1e3)
    found = q[first + 1000 : first + 2900]
    assert np.abs(found - wanted).max() < off
    assert law.guard.samples.ratio.max() < 1.0
    assert law.guard.supervisor.phase is blf.Phase.TRACKING


def test_stop_brakes_and_outlasts_a_stream_until_that_pauses(ros):
    arm, law = ros.loop(None, PATIENT)
    ros.run(arm, 50)
    far = trajectory(point((1.0, 0.5), 2.0))
    inputs(law).take_trajectory(far)
    ros.run(arm, 1000)
    moving = law.guard.controller.reference_at(law.guard.reference.time)
    assert np.abs(moving[1]).min() > 0.1
    response = call_stop(ros)
    assert response.success
    assert 'braking for ' in response.message
    np.testing.assert_allclose(
        law.guard.controller.reference_at(law.guard.reference.time), moving, atol=0.02
    )
    for _ in range(40):
        inputs(law).take_trajectory(far)
        ros.run(arm, 20)
    at_rest = law.guard.controller.reference_at(law.guard.reference.time)
    np.testing.assert_array_equal(at_rest[1:], 0.0)
    # from v at 6 rad/s^2, which is reached in 0.05 s
    distance = np.abs(at_rest[0] - moving[0])
    assert np.all(distance < 0.5 * np.abs(moving[1]) * (np.abs(moving[1]) / 6.0 + 0.1))
    ros.run(arm, 1100)
    inputs(law).take_trajectory(far)
    ros.run(arm, 1000)
    assert (
        np.abs(law.guard.controller.reference_at(law.guard.reference.time)[1]).min()
        > 0.1
    )


WRONG = {
    'it has 3 positions for 2 joints': (1.0, 1.0, 1.0),
    'its positions are': (1.0, float('nan')),
}


@pytest.mark.parametrize('reason', WRONG)
def test_wrong_positions_are_rejected_with_the_reason(ros, reason):
    arm, law = ros.loop(None, PATIENT)
    ros.run(arm, 50)
    inputs(law).take_positions(positions(WRONG[reason]))
    assert reason in inputs(law).reason
    past = 1.05 * np.array(law.config.limits.position_upper)
    inputs(law).take_positions(positions(past))  # as near as it may
    ros.run(arm, 50)
    assert inputs(law).targets == 1


@pytest.mark.skipif(find_spec('control_msgs') is not None, reason='it is installed')
def test_without_control_msgs_the_reason_is_said_once_and_all_else_works(ros, capfd):
    arm, law = ros.loop(None, PATIENT)
    ros.run(arm, 1100)
    inputs(law).take_trajectory(trajectory(point((1.9, 1.4), 1.0)))
    ros.run(arm, 1500)
    reference = law.guard.controller.reference_at(law.guard.reference.time)
    np.testing.assert_allclose(reference[0], (1.9, 1.4), atol=1e-9)
    said = capfd.readouterr().err
    assert said.count('control_msgs is not installed') == 1
