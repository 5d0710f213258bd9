# SPDX-License-Identifier: Apache-2.0
"""How many of MoveIt's trajectories exceed the controller's limits and are stretched.

    python -m benchmark scaling

As MoveIt's time parametrisation: from rest to rest, each joint with a trapezoidal
velocity, all in the time of the slowest, sampled with positions, velocities and
accelerations. Without ROS and without an arm, the same each time.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.reference.terms import minimum_jerk, pack
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryPoint,
    plan_trajectory,
)
from blf_dsc_controller.run import Floats

# of the controller's velocity and acceleration
SCALES = ((1.0, 1.0), (1.0, 0.6), (0.9, 0.8), (0.9, 0.7), (0.9, 0.6))
SPACINGS = (0.1, 0.05, 0.02)  # s between points
MOTIONS = 40
_LIMITS = {'limits.acceleration': [6.0, 6.0]}  # rad/s^2; 1.5 rad/s
_FARTHEST = 1.5  # rad
_LATE = 1e-6  # s, more than rounding


def trapezoid(distance: Floats, velocity: float, acceleration: float) -> Floats:
    """Return the knots (4,) [s] of the velocity of the joint with the longest way."""
    longest = float(np.abs(distance).max())
    ramp = min(velocity / acceleration, np.sqrt(longest / acceleration))
    cruise = longest / (acceleration * ramp) - ramp
    return np.cumsum([0.0, ramp, cruise, ramp])


def points_of(
    distance: Floats, scale: tuple[float, float], spacing: float
) -> list[TrajectoryPoint]:
    """Return the points of a motion from 0 over distances (2,) [rad]."""
    limits = build(ControllerConfig, _LIMITS).limits
    velocity = scale[0] * limits.velocity[0]
    return trapezoid_points(
        distance, velocity, scale[1] * limits.acceleration[0], spacing
    )


def trapezoid_points(
    distance: Floats, velocity: float, acceleration: float, spacing: float
) -> list[TrajectoryPoint]:
    """Return the points of a motion from 0 over distances (n,) [rad] within limits.

    They are at most `spacing` [s] apart, with velocities and accelerations.
    """
    knots = trapezoid(distance, velocity, acceleration)
    count = max(2, int(np.ceil(knots[-1] / spacing)) + 1)
    times = np.linspace(0.0, knots[-1], count)
    up, down = knots[1], knots[2]
    ddq = np.where(times < up, acceleration, np.where(times < down, 0.0, -acceleration))
    dq = acceleration * np.minimum(np.minimum(times, up), knots[-1] - times)
    early = 0.5 * acceleration * np.minimum(times, up) ** 2
    cruised = acceleration * up * np.clip(times - up, 0.0, down - up)
    left = np.clip(times - down, 0.0, None)
    q = early + cruised + left * (acceleration * up - 0.5 * acceleration * left)
    ddq[[0, -1]] = 0.0  # the arm rests
    share = distance / np.abs(distance).max()
    fields = np.array((q, dq, ddq))[:, :, np.newaxis] * share
    return [
        TrajectoryPoint(float(t), *map(tuple, point))
        for t, point in zip(times, fields.swapaxes(0, 1).tolist(), strict=True)
    ]


def stretch(distance: Floats, scale: tuple[float, float], spacing: float) -> float:
    """Return by which share of its time a motion is stretched."""
    config = build(ControllerConfig, _LIMITS)
    at_rest = pack(2, [minimum_jerk(np.zeros(1), np.zeros((1, 2)))])
    points = points_of(distance, scale, spacing)
    trajectory = Trajectory(config.joints, tuple(points[1:]), 0.0)
    motion = plan_trajectory(trajectory, at_rest, 0.0, config)
    late = motion.end - points[-1].time
    return late / points[-1].time if late > _LATE else 0.0


def rows() -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table."""
    rng = np.random.default_rng(0)
    distances = rng.uniform(-_FARTHEST, _FARTHEST, (MOTIONS, 2))
    for scale in SCALES:
        row = []
        for spacing in SPACINGS:
            found = np.array([stretch(each, scale, spacing) for each in distances])
            share = 100.0 * np.count_nonzero(found) / MOTIONS
            row.append(f'{share:.0f} %, {100.0 * found.max():.0f} %')
        yield f'{scale[0]:g}', f'{scale[1]:g}', *row


def main(_options: argparse.Namespace) -> None:
    """Print the table: how many are stretched, and by how much at most."""
    heads = [f'every {spacing:g} s' for spacing in SPACINGS]
    print_table(('of the velocity', 'of the acceleration', *heads), list(rows()))
