# SPDX-License-Identifier: Apache-2.0
"""Streams and stops as the nodes and `blf_dsc drive` take them, in lock-step without ROS."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('ruckig', reason='needs ruckig')

from fault_table import Rig

from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryPoint

AT_REST = np.array([1.85, 1.6])  # rad
FIRST = np.array([1.9, 1.4])  # rad
STEP = np.array([0.004, -0.004])  # rad in 20 ms, 0.2 rad/s


class Quiet:
    """A log that nobody reads."""

    def info(self, message):
        pass

    def warning(self, message, *, throttle_duration_sec=0.0):
        pass

    error = warning


@pytest.fixture
def rig():
    """An arm on its reference, whose controller takes motions."""
    rig = Rig({'limits.acceleration': [6.0, 6.0]})
    rig.inputs = MotionInput(2, lambda: rig.guard, lambda _: False, Quiet())
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
    q, dq, _ = rig.guard.controller.reference_at(rig.guard.time)
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
    rig.guard.reset()
    rig.step()
    assert rig.guard.time == 0.0  # before the stop, by the clock of the law
    stream(rig, 5)
    assert rig.inputs.targets == 15


def test_a_plan_that_is_ready_too_late_is_made_again_for_twice_as_long_ahead(rig):
    """Of a busy computer: planning took longer than the lead."""
    inputs = MotionInput(2, lambda: rig.guard, lambda _: True, Quiet())
    reports = []
    made = []

    def make():
        made.append(rig.guard.time)
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
    assert plan.at == pytest.approx(rig.guard.time + 0.01)
