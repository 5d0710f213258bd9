# SPDX-License-Identifier: Apache-2.0
"""The shapers of `benchmark shaping`: consistent motions that do not excite their resonance."""

from __future__ import annotations

import numpy as np
import pytest

from benchmark import shaping
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build

MOVE = shaping.Move(0.1, 0.0, np.zeros(2), np.array((0.6, -0.2)), 5.0)
FREQUENCY = 20.0  # Hz: a period has 50 samples, half of one 25
TIMES = 1e-3 * np.arange(1500)


@pytest.fixture(name='config')
def two_links() -> ControllerConfig:
    limits = {'limits.velocity': [2.0, 2.0], 'limits.acceleration': [40.0, 40.0]}
    return build(ControllerConfig, limits)  # nothing is stretched, as in the study


@pytest.fixture(name='move')
def move_with_duration() -> shaping.Move:
    distance = MOVE.goal - MOVE.start
    points = shaping.trapezoid_points(
        distance, shaping.VELOCITY, MOVE.limit, shaping.SPACING
    )
    return MOVE._replace(duration=points[-1].time)


def left(ddq: np.ndarray, frequency: float) -> float:
    """Return the amplitude that an undamped oscillator has after an acceleration (k, n)."""
    phases = np.exp(-2j * np.pi * frequency * TIMES)
    return float(np.abs(phases @ ddq).max())


@pytest.mark.parametrize('rule', [shaping.MOVEIT, *shaping.SHAPED])
def test_a_motion_is_consistent_and_ends_at_its_goal(config, move, rule):
    fields, later = shaping.reference(rule, move, config, TIMES, FREQUENCY)
    end = move.begin + move.duration + later
    after = end < TIMES
    np.testing.assert_allclose(fields[after, 0] - move.goal, 0.0, atol=1e-4)
    q, dq, ddq = fields.swapaxes(0, 1)
    # accelerations of 5 rad/s^2, and what overshoots them between points, times a sample
    np.testing.assert_allclose(np.diff(q, axis=0), 1e-3 * dq[1:], atol=1e-5)
    steps = 1e-3 * np.abs(ddq).max()
    np.testing.assert_allclose(np.diff(dq, axis=0), 1e-3 * ddq[1:], atol=steps)
    # and without a drift: the sum of differences is the way
    np.testing.assert_allclose(1e-3 * dq.sum(axis=0), move.goal, atol=1e-3)


@pytest.mark.parametrize('rule', ['ZV', 'ZVD', 'mean'])
def test_a_shaper_leaves_its_resonance_at_rest_and_stays_within_the_motion(
    config, move, rule
):
    asked, _ = shaping.reference(shaping.MOVEIT, move, config, TIMES, FREQUENCY)
    shaped, later = shaping.reference(rule, move, config, TIMES, FREQUENCY)
    # the impulses are whole samples apart, so that nothing but rounding is left
    assert left(shaped[:, 2], FREQUENCY) < 1e-9 * len(TIMES)
    assert left(asked[:, 2], FREQUENCY) > 1.0
    assert later == pytest.approx(0.5 / FREQUENCY if rule == 'ZV' else 1.0 / FREQUENCY)
    for derivative in range(3):
        lowest = asked[:, derivative].min(axis=0) - 1e-9
        highest = asked[:, derivative].max(axis=0) + 1e-9
        assert (shaped[:, derivative] >= lowest).all()
        assert (shaped[:, derivative] <= highest).all()


def test_ringing_is_that_of_gears_and_not_of_the_loop():
    t = 1e-3 * np.arange(500)[:, np.newaxis]
    of_gears = shaping.ringing_of(3.0 * np.sin(2.0 * np.pi * 20.0 * t), 1e-3)
    of_loop = shaping.ringing_of(3.0 * np.sin(2.0 * np.pi * 2.0 * t), 1e-3)
    assert of_gears == pytest.approx(3.0 / np.sqrt(2.0), rel=1e-3)
    assert of_loop < 0.02 * of_gears
