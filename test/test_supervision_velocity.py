# SPDX-License-Identifier: Apache-2.0
"""Velocities estimated from positions."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.supervision.checks import Velocity

MILLISECOND = 1_000_000  # ns


def estimated(*states):
    """Estimated velocity (rad/s) of joint 1 at each (stamp in ms, position in rad)."""
    velocity, found = Velocity(2), []
    for stamp, position in states:
        measurement = np.array([position, 0.0, 7.0, 7.0, 8.0, 8.0])
        velocity.replace(stamp * MILLISECOND, measurement)
        found.append(measurement[2])
        assert (measurement[4:] == 8.0).all()
    return found


def test_velocity_is_the_difference_quotient_of_two_states():
    np.testing.assert_allclose(estimated((1, 0.5), (2, 0.502), (4, 0.501)), [0.0, 2.0, -0.5])


def test_repeated_stamp_keeps_the_velocity_and_the_next_one_counts_from_it():
    found = estimated((1, 0.5), (2, 0.502), (2, 0.502), (2, 0.502), (3, 0.503))
    np.testing.assert_allclose(found, [0.0, 2.0, 2.0, 2.0, 1.0])


def test_velocity_is_zero_where_the_stamps_restart():
    np.testing.assert_allclose(estimated((5, 0.5), (6, 0.502), (1, 0.1), (2, 0.1)), [0, 2, 0, 0])


def test_repeated_reading_with_a_new_stamp_is_continued_at_its_velocity():
    """Once; an arm that really stands still is at rest in the sample after."""
    moving = (1, 0.5), (2, 0.502)
    found = estimated(*moving, (3, 0.502), (3, 0.504), (4, 0.506), (5, 0.508))
    np.testing.assert_allclose(found, [0.0, 2.0, 2.0, 2.0, 2.0, 2.0])
    np.testing.assert_allclose(estimated(*moving, (3, 0.502), (4, 0.502)), [0.0, 2.0, 2.0, 0.0])
    coarse = (1, 0.5), (2, 0.5002), (3, 0.5002)  # less than three counts of 16 bits
    np.testing.assert_allclose(estimated(*coarse), [0.0, 0.2, 0.0])
