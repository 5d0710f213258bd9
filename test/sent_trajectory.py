# SPDX-License-Identifier: Apache-2.0
"""Trajectories that tests send to a running controller."""

from __future__ import annotations

import numpy as np
from rclpy.duration import Duration
from rclpy.time import Time
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from blf_dsc_controller.messages import topics

JOINTS = ('joint1', 'joint2')
SECOND = 1_000_000_000
FIELDS = ('positions', 'velocities', 'accelerations')


def two_tones(t, shift):
    """Return position, velocity and acceleration (3, 2) at t [s] of two tones on each joint."""
    rates, sizes = np.array([1.0, 2.3]), np.array([[0.2, 0.08], [0.25, -0.05]])
    tones = sizes * np.exp(1j * (rates * t + [0.2, -0.9]))
    motion = np.array([(tones * (1j * rates) ** k).sum(axis=1).real for k in range(3)])
    motion[0] += [1.9, 1.4] + shift * np.ones(2)
    return motion


def trajectory(joints, shift, *, duration, fields=3, stamp=0):
    """Return a trajectory into two tones within a second, at rest a second after them."""
    sent = JointTrajectory(joint_names=joints)
    sent.header.stamp = Time(nanoseconds=stamp).to_msg()
    times = 1.0 + 0.05 * np.arange(round(duration / 0.05))
    points = [two_tones(t, shift) for t in times]
    rest = np.vstack((points[-1][:1], np.zeros((2, 2))))
    for t, point in zip((*times, times[-1] + 1.0), (*points, rest), strict=True):
        values = point[:fields, [JOINTS.index(joint) for joint in joints]]
        at = Duration(nanoseconds=round(t * 1e9)).to_msg()
        arrays = dict(zip(FIELDS, values, strict=False))
        sent.points.append(JointTrajectoryPoint(**arrays, time_from_start=at))
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
