# SPDX-License-Identifier: Apache-2.0
"""Streams: no noise is amplified, no target that stays is overshot, whatever the network does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('ruckig', reason='needs ruckig')

from blf_dsc_controller import ControllerConfig, TrajectoryError, change
from blf_dsc_controller.configuration.nodes import load, locate
from blf_dsc_controller.reference.approach import hold
from blf_dsc_controller.reference.retargeting import Target, plan_target
from blf_dsc_controller.reference.stream import TargetStream
from blf_dsc_controller.reference.terms import pack, sampled, sinusoids_term

PANDA = load(locate('panda'), 'blf_dsc_controller', ControllerConfig, {})
HOME = np.mean((PANDA.limits.position_lower, PANDA.limits.position_upper), axis=0)
LEAD = 4  # ms that planning takes
SLOPE = np.array([0.3, -0.2])  # rad/s
TIMEOUT = 1.0  # s


def receive(stream, sent, late=0.0):
    """Pass targets of a motion at constant velocity to a stream; return the last ones."""
    delays = np.broadcast_to(late, np.shape(sent))
    return [
        stream.target(at + delay, SLOPE * at, timeout=TIMEOUT)
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
        expected = at + interval / 6.0 + max(2.0 * interval, 0.1)
        assert abs(target.due - expected) < 5.0 * 0.024 * interval
        assert abs(stream.interval - interval) < 5.0 * 0.00065 * interval


def arrivals(rng, rate, count, jitter):
    """Return numbers and times [ms] of messages that are late, of which a tenth is lost."""
    numbers = np.arange(count)
    late = jitter * rng.uniform(size=count)
    kept = rng.uniform(size=count) > 0.1
    kept[[0, -1]] = True  # nothing can be said of a last target that is lost
    return numbers[kept], np.ceil(1000.0 * (numbers + late) / rate).astype(int)[kept]


def follow(positions, times, end):
    """Return the reference (end, 7) [rad] from HOME at each ms, as a Panda's loop plans it."""
    stream = TargetStream()
    vector, seen, now = pack(7, [hold(HOME)]), [], 0
    for offset, arrived in zip(positions, times, strict=True):
        target = stream.target(1e-3 * arrived, HOME + offset, timeout=0.25)
        at = max(now, arrived + LEAD)
        seen.append(sampled(vector, 1e-3 * np.arange(now, at))[:, 0])
        vector, now = plan_target(target, vector, 1e-3 * at, PANDA).vector, at
    seen.append(sampled(vector, 1e-3 * np.arange(now, end))[:, 0])
    return np.concatenate(seen) - HOME


RATES = st.floats(10.0, 200.0)  # Hz
JITTERS = st.floats(0.0, 0.8)  # of an interval
SEEDS = st.integers(0, 1000)


@settings(max_examples=6)
@given(RATES, JITTERS, SEEDS)
def test_noise_of_the_targets_is_never_amplified(rate, jitter, seed):
    rng = np.random.default_rng(seed)
    numbers, times = arrivals(rng, rate, 80, jitter)
    noise = 2e-3 * rng.normal(size=(numbers.size, 7))
    seen = follow(noise, times, times[-1])
    assert np.std(seen) <= np.std(noise)
    assert np.abs(seen).max() <= np.abs(noise).max()


@settings(max_examples=10)
@given(RATES, JITTERS, SEEDS, st.floats(0.02, 1.0), st.floats(0.1, 1.0))
def test_target_that_stays_is_reached_and_not_overshot(
    rate, jitter, seed, speed, lasts
):
    """A ramp of up to 1 rad/s that ends at once; from there the arm brakes in 0.14 rad."""
    rng = np.random.default_rng(seed)
    count = int((lasts + 1.0) * rate)
    numbers, times = arrivals(rng, rate, count, jitter)
    far = speed * lasts
    ramp = np.minimum(speed * numbers / rate, far)
    seen = follow(np.outer(ramp, np.ones(7)), times, times[-1] + 500)
    assert seen.max() <= far + 1e-3
    np.testing.assert_allclose(seen[-1], far, atol=1e-9)


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
