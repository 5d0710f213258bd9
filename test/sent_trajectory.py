# SPDX-License-Identifier: Apache-2.0
"""Trajectories that tests send to a running controller."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Duration, Time
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from blf_dsc_controller.messages import topics

JOINTS = ('joint1', 'joint2')
SECOND = 1_000_000_000


def two_tones(t, shift):
    """Return position, velocity and acceleration (3, 2) at t [s] of two tones on each joint."""
    rates, phases = np.array([1.0, 2.3]), np.array([0.2, -0.9])
    sizes = np.array([[0.2, 0.08], [0.25, -0.05]])
    angle = rates * t + phases
    middle = np.array([1.9, 1.4]) + shift
    return np.stack(
        (
            middle + sizes @ np.cos(angle),
            -sizes @ (rates * np.sin(angle)),
            -sizes @ (rates**2 * np.cos(angle)),
        )
    )


def trajectory(joints, shift, *, duration, names=None, period=0.05, lead=1.0, fields=3, stamp=0):
    """Return a trajectory into two tones within `lead` [s], at rest a second after them."""
    sent = JointTrajectory(joint_names=names or joints)
    sent.header.stamp = Time(sec=stamp // SECOND, nanosec=stamp % SECOND)
    times = lead + np.arange(round(duration / period)) * period
    points = [two_tones(t, shift) for t in times]
    rest = np.vstack((points[-1][:1], np.zeros((2, 2))))
    for t, point in zip((*times, times[-1] + 1.0), (*points, rest), strict=True):
        values = [row[[JOINTS.index(joint) for joint in joints]] for row in point[:fields]]
        nanoseconds = round(t * 1e9)
        sent.points.append(
            JointTrajectoryPoint(
                **dict(zip(('positions', 'velocities', 'accelerations'), values, strict=False)),
                time_from_start=Duration(sec=nanoseconds // SECOND, nanosec=nanoseconds % SECOND),
            )
        )
    return sent


def inputs(law):
    """Return the status of the trajectories that a controller was sent."""
    return law._status.trajectories


def send(ros, law, sent):
    """Send a trajectory; return the reason of the last rejection, empty if there was none."""
    name = '/' + topics.JOINT_TRAJECTORY.relative
    publisher = ros.tester.create_publisher(JointTrajectory, name, 10)
    ros.until(lambda: publisher.get_subscription_count() > 0)
    before = inputs(law).accepted + inputs(law).rejected
    publisher.publish(sent)
    ros.until(lambda: inputs(law).accepted + inputs(law).rejected > before)
    ros.tester.destroy_publisher(publisher)
    return inputs(law).reason
