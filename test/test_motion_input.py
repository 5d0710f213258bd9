# SPDX-License-Identifier: Apache-2.0
"""Streams and stops as the nodes and `blf_dsc drive` take them, in lock-step without ROS."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('ruckig', reason='needs ruckig')

from fault_table import Rig

from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder

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
