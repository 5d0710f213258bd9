# SPDX-License-Identifier: Apache-2.0
"""Streams: the sender's clock is found whatever the network does, and losses cost little."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('ruckig', reason='needs ruckig')

from blf_dsc_controller import ControllerConfig, TrajectoryError, change
from blf_dsc_controller.reference.approach import hold
from blf_dsc_controller.reference.retargeting import Target, plan_target
from blf_dsc_controller.reference.stream import TargetStream
from blf_dsc_controller.reference.terms import pack, sampled, sinusoids_term

FASTEST = np.array([1.5, 1.5])
SLOPE = np.array([0.3, -0.2])  # rad/s
TIMEOUT = 1.0  # s


def receive(stream, sent, late=0.0):
    """Pass targets of a motion at constant velocity to a stream; return the last ones."""
    delays = np.broadcast_to(late, np.shape(sent))
    return [
        stream.target(at + delay, SLOPE * at, timeout=TIMEOUT, fastest=FASTEST)
        for at, delay in zip(sent, delays, strict=True)
    ]


@pytest.mark.parametrize('interval', [0.004, 0.01, 0.1])
def test_clock_of_a_sender_is_found_from_late_arrivals(interval):
    """Up to a third of an interval late, at random: a mean of a sixth, 0.096 rms.

    A line through 64 arrivals leaves a quarter of that at its end, and 12^0.5 / 64^1.5
    in its slope: five times that hold for 800 messages, of which a tenth is lost.
    """
    stream = TargetStream()
    rng = np.random.default_rng(1)
    numbers = np.arange(1000)
    sent = interval * numbers[(numbers < 100) | (rng.uniform(size=1000) > 0.1)]
    late = interval * rng.uniform(0.0, 1.0 / 3.0, sent.size)
    receive(stream, sent[:200], late[:200])
    for at, delay in zip(sent[200:], late[200:], strict=True):
        target = receive(stream, [at], delay)[0]
        expected = at + (1.0 + 1.0 / 6.0) * interval
        assert abs(target.due - expected) < 5.0 * 0.024 * interval
        assert abs(stream.interval - interval) < 5.0 * 0.00065 * interval


@pytest.mark.parametrize('step', [0.03, -0.03])
def test_step_of_the_targets_is_no_velocity(step):
    """0.03 rad in 10 ms are 3 rad/s, twice as fast as the arm: only its other joint moves on."""
    stream = TargetStream()
    receive(stream, 0.01 * np.arange(50))
    stepped = SLOPE * 0.5 + (step, 0.0)
    target = stream.target(0.5, stepped, timeout=TIMEOUT, fastest=FASTEST)
    assert target.velocities[0] == 0.0
    assert target.velocities[1] == pytest.approx(SLOPE[1])


@pytest.mark.parametrize('held', [True, False])
def test_target_that_nothing_follows_is_held_or_left_behind_while_braking(held):
    """It is due at 1 s; its line is left at 1.2 s."""
    q = np.array([2.1, 1.5])
    target = Target(tuple(q), (0.1, -0.1), 1.0, 1.2, held)
    config = ControllerConfig()
    motion = plan_target(target, pack(2, [hold(q)]), 0.0, config)
    on_line, last = sampled(motion.vector, np.array([1.1, motion.end + 1.0]))
    np.testing.assert_allclose(on_line[0], np.add(q, (0.01, -0.01)), atol=1e-9)
    np.testing.assert_array_equal(last[1:], 0.0)
    if held:
        np.testing.assert_allclose(last[0], q, atol=1e-9)
    else:
        assert np.all((last[0] - q) * [1.0, -1.0] > 0.02)


@pytest.mark.parametrize('side', [1.0, -1.0])
@pytest.mark.parametrize('coast', [0.03, 0.3])
def test_stream_towards_a_position_limit_is_slowed_so_that_the_arm_can_stop(
    side, coast
):
    """It rests at the limit, 0.3 rad past the target, however long it follows the line."""
    limit = {
        'limits.position_lower': [-1.0, -1.0],
        'limits.position_upper': [1.0, 1.0],
    }
    config = change(ControllerConfig(), limit)
    q = np.full(2, side * 0.7)
    target = Target(tuple(q), (side * 1.4,) * 2, 1.0, 1.0 + coast, held=False)
    start = pack(2, [hold(np.full(2, side * 0.2))])
    motion = plan_target(target, start, 0.0, config)
    reached, _, _ = sampled(motion.vector, np.array([motion.end]))[0]
    np.testing.assert_allclose(reached, side, atol=1e-9)


@pytest.mark.parametrize('side', [1.0, -1.0])
def test_target_is_refused_if_the_arm_would_leave_its_limits_before_it_turns(side):
    """From 1.4 rad/s at 6 rad/s^2 it needs 0.16 rad to stop: 0.05 rad are left."""
    limit = {
        'limits.position_lower': [-1.0, -1.0],
        'limits.position_upper': [1.0, 1.0],
        'limits.acceleration': [6.0, 6.0],
    }
    config = change(ControllerConfig(), limit)
    target = Target((0.0, 0.0), (0.0, 0.0), 1.0, 1.1, held=False)
    for left, refused in ((0.05, True), (0.3, False)):
        q = (side * (1.0 - left), 0.0)
        swing = sinusoids_term(q, (side * 0.1, 0.0), (14.0,), (-np.pi / 2,))
        moving = pack(2, [swing])
        if refused:
            with pytest.raises(
                TrajectoryError, match=r"'joint1' would be at .* room to"
            ):
                plan_target(target, moving, 0.0, config)
        else:
            plan_target(target, moving, 0.0, config)


@pytest.mark.parametrize(
    ('past', 'refused'), [(0.1, False), (0.5, True), (45.0, True), (-100.0, True)]
)
def test_target_in_other_units_is_refused_and_one_a_little_past_the_range_reduced(
    past, refused
):
    """Degrees, or parts of a range: an arm swept through its range at up to 1.4 rad/s."""
    limit = {
        'limits.position_lower': [-1.0, -1.0],
        'limits.position_upper': [1.0, 1.0],
    }
    config = change(ControllerConfig(), limit)
    q = past + np.sign(past)
    target = Target((q, 0.0), (0.0, 0.0), 1.0, 1.1, held=True)
    start = pack(2, [hold(np.zeros(2))])
    if refused:
        with pytest.raises(TrajectoryError, match=r"'joint1' .* are they in degrees"):
            plan_target(target, start, 0.0, config)
        return
    motion = plan_target(target, start, 0.0, config)
    reached, _, _ = sampled(motion.vector, np.array([motion.end]))[0]
    assert reached[0] == pytest.approx(1.0)
