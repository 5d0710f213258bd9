# SPDX-License-Identifier: Apache-2.0
"""Streams and stops as the nodes and `blf_dsc drive` take them, in lock-step without ROS."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

pytest.importorskip('ruckig', reason='needs ruckig')

from fault_table import Rig

from blf_dsc_controller import TrajectoryPoint, change
from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder
from blf_dsc_controller.reference.trajectory import Trajectory

AT_REST = np.array([1.85, 1.6])  # rad
FIRST = np.array([1.9, 1.4])  # rad
STEP = np.array([0.004, -0.004])  # rad in 20 ms, 0.2 rad/s


@pytest.fixture
def rig():
    """An arm on its reference, whose controller takes motions."""
    rig = Rig({'limits.acceleration': [6.0, 6.0]})
    rig.inputs = MotionInput(2, lambda: rig.guard, lambda _: False, Mock())
    rig.step(50)
    return rig


def stream(rig, count):
    """Send positions at 50 Hz; return the last ones."""
    for k in range(count):
        last = FIRST + k * STEP
        rig.inputs.take_positions(Float64MultiArrayEncoder(2).encode(last))
        rig.step(20)
    return last


def test_stream_begins_at_rest_after_a_stop(rig):
    """Its messages from before gave its targets a velocity, which led past a single one."""
    last = stream(rig, 50) + STEP
    rig.inputs.stop(rig.guard, 'a test')
    rig.inputs.take_positions(Float64MultiArrayEncoder(2).encode(last))
    rig.step(1000)
    q, dq, _ = rig.guard.controller.reference_at(rig.guard.reference.time)
    np.testing.assert_allclose(q, last, atol=1e-9)
    assert not dq.any()


def test_sender_is_followed_again_once_it_has_paused_or_after_a_reset(rig):
    stream(rig, 5)
    assert 'topics are ignored' in rig.inputs.take_stop()
    stream(rig, 5)
    assert rig.inputs.targets == 5
    rig.step(1000)  # a pause of a second
    stream(rig, 5)
    assert rig.inputs.targets == 10
    rig.inputs.take_stop()
    rig.guard.starting.reset()
    rig.step()
    assert rig.guard.reference.time == 0.0  # before the stop, by the clock of the law
    stream(rig, 5)
    assert rig.inputs.targets == 15


def test_a_plan_that_is_ready_too_late_is_made_again_for_twice_as_long_ahead(rig):
    """Of a busy computer: planning took longer than the lead."""
    inputs = MotionInput(2, lambda: rig.guard, lambda _: True, Mock())
    reports = []
    made = []

    def make():
        made.append(rig.guard.reference.time)
        return Trajectory(('joint1', 'joint2'), (TrajectoryPoint(2.0, tuple(AT_REST)),))

    inputs.follow(
        rig.guard, make, 'a test', lambda _: None, lambda *given: reports.append(given)
    )
    inputs.job.plan.result()
    rig.step(30)  # 30 ms, of a lead of 20 ms
    inputs.poll(rig.guard)
    assert not reports
    inputs.job.plan.result()
    rig.step(30)
    inputs.poll(rig.guard)
    ((plan, reason),) = reports
    assert not reason
    assert len(made) == 2
    assert plan.at == pytest.approx(rig.guard.reference.time + 0.01)


def test_a_stop_ends_the_motion_that_waits_for_another_to_be_planned(rig):
    """Else the arm would go there after the next motion, of which nobody thinks any more."""
    inputs = MotionInput(2, lambda: rig.guard, lambda _: True, Mock())
    reasons = []

    def follow(positions):
        point = TrajectoryPoint(2.0, tuple(positions))
        made = Trajectory(('joint1', 'joint2'), (point,))
        inputs.follow(
            rig.guard,
            lambda: made,
            'a test',
            lambda _: None,
            lambda _, reason: reasons.append(reason),
        )

    follow(AT_REST)
    follow(FIRST)
    inputs.stop(rig.guard, 'a test')
    assert reasons == ['the reference was stopped'] * 2
    follow(AT_REST)
    while inputs.job is not None:
        inputs.job.plan.result()
        inputs.poll(rig.guard)
    assert reasons[2:] == ['']


def moved(rig, seconds):
    """Step the arm; return the state of its reference (k, 3, 2) at each sample."""
    seen = []
    for _ in range(round(1000 * seconds)):
        rig.step()
        seen.append(rig.guard.controller.reference_at(rig.guard.reference.time))
    return np.array(seen)


def go_to(rig, positions):
    """Send a trajectory of one point that is too near in time."""
    point = TrajectoryPoint(0.05, tuple(positions))
    made = Trajectory(('joint1', 'joint2'), (point,))
    reports = []
    rig.inputs.follow(
        rig.guard,
        lambda: made,
        'a test',
        lambda _: None,
        lambda *given: reports.append(given),
    )
    ((plan, reason),) = reports
    assert plan is not None, reason


@pytest.mark.parametrize('scale', [1.0, 0.25])
def test_motions_that_are_sent_use_their_share_of_the_limits(rig, scale):
    rig.guard.retune(change(rig.config, {'limits.scale': scale}))
    rig.inputs.take_stop()
    moved(rig, 1.0)
    q = rig.guard.controller.reference_at(rig.guard.reference.time)[0]
    limits = rig.config.limits
    largest = scale * np.array((limits.velocity, limits.acceleration))
    for target in (q + np.array([0.9, -0.9]), q):
        go_to(rig, target)
        seen = np.abs(moved(rig, 3.5))
        peaks = seen[:, 1:].max(axis=0)
        assert (peaks <= largest * (1.0 + 1e-6)).all()
        assert (peaks > 0.98 * largest).all()
        np.testing.assert_allclose(seen[-1, 0], np.abs(target), atol=1e-9)


def test_stream_that_is_faster_than_its_share_is_followed_at_that(rig):
    rig.guard.retune(change(rig.config, {'limits.scale': 0.1}))
    rig.inputs.take_stop()
    moved(rig, 1.0)
    q = rig.guard.controller.reference_at(rig.guard.reference.time)[0]
    fastest = 0.1 * np.array(rig.config.limits.velocity)
    for k in range(1, 40):  # 0.6 rad/s
        target = q + 0.012 * k
        rig.inputs.take_positions(Float64MultiArrayEncoder(2).encode(target))
        speeds = np.abs(moved(rig, 0.02)[:, 1])
        assert (speeds <= fastest * (1.0 + 1e-6)).all()
    assert (speeds > 0.98 * fastest).all()


@pytest.mark.parametrize(
    ('time', 'scale', 'far'),
    [(0.1, 0.05, 1.0), (0.2, 0.3, 1.7), (0.6, 0.3, 0.0), (1.15, 0.05, 1.7)],
)
def test_motion_sent_while_the_reference_is_faster_is_not_rejected(
    rig, scale, far, time
):
    """It keeps at most the speed that it begins with; the next one has its share."""
    rig.inputs.take_stop()
    moved(rig, 1.0)
    q = rig.guard.controller.reference_at(rig.guard.reference.time)[0]
    go_to(rig, q + np.array([1.5, -1.5]))
    _, dq, ddq = moved(rig, time)[-1]
    rig.guard.retune(change(rig.config, {'limits.scale': scale}))
    go_to(rig, q + far * np.array([1.0, -1.0]))
    seen = np.abs(moved(rig, 1.5)[:, 1])
    limits = rig.config.limits
    allowed = scale * np.array(limits.velocity)
    gained = 0.5 * ddq * np.abs(ddq) / (scale * np.array(limits.jerk))
    begun = np.maximum(np.abs(dq), np.abs(dq + gained))
    assert (seen <= np.maximum(allowed, begun) * (1.0 + 1e-6)).all()
    rig.inputs.take_stop()
    moved(rig, 1.0)
    go_to(rig, q)
    assert (np.abs(moved(rig, 0.5)[:, 1]) <= allowed * (1.0 + 1e-6)).all()
