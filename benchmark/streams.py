# SPDX-License-Identifier: Apache-2.0
"""How far behind and how smooth the reference of a stream is, and that of chunks.

    python -m benchmark streams

Without ROS and without an arm, the same each time: messages arrive 2 ms after they were
sent, in one case up to a third of an interval later, in another a tenth is lost. A target
is planned for 4 ms ahead, a chunk for 20 ms, as the node does.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.reference.retargeting import Target, plan_target
from blf_dsc_controller.reference.stream import TargetStream
from blf_dsc_controller.reference.terms import minimum_jerk, pack, remaining, sampled
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryPoint,
    plan_trajectory,
)
from blf_dsc_controller.run import Floats

RATES = (10.0, 30.0, 50.0, 100.0, 250.0)  # Hz
_LATENCY = 0.002  # s
_LEAD = 0.004  # s of planning
_CHUNK_LEAD = 0.02  # s
_LATE = 1.0 / 3.0  # of an interval
_LOST = 0.1
_SAMPLE = 1e-3  # s
_DURATION = 12.0  # s
_SETTLED = 2.0  # s
_SIZE = 0.2  # rad
_RATE = 3.0  # rad/s
_HEAD = ('stream', *(f'{rate:g} Hz' for rate in RATES))
_AHEAD = 0.1  # s between the points of a chunk, ...
_POINTS = 10  # ... of which it has so many
_CHUNKS = 0.2  # s between chunks
_CHANGE = 0.003  # rad by which a chunk differs from the one before


class Message(NamedTuple):
    """A message of a stream."""

    sent: float  # s
    arrived: float  # s


@cache
def config() -> ControllerConfig:
    """Return limits of 1.5 rad/s and 6 rad/s^2."""
    return build(ControllerConfig, {'limits.acceleration': [6.0, 6.0]})


def motion(t: Floats, derivative: int = 0) -> Floats:
    """Return what the sender means (k, 2) at times (k,) [s], or a derivative of it."""
    phases = _RATE * t[:, np.newaxis] + derivative * np.pi / 2.0 + (0.0, 1.0)
    waves: Floats = _SIZE * _RATE**derivative * np.sin(phases)
    return waves


def messages(interval: float, late: float = 0.0, lost: float = 0.0) -> list[Message]:
    """Return the messages that arrive; `late` is up to how many intervals, `lost` the share."""
    rng = np.random.default_rng(0)
    sent = np.arange(0.0, _DURATION, interval)
    arrived = sent + _LATENCY + late * interval * rng.uniform(size=sent.size)
    kept = rng.uniform(size=sent.size) >= lost
    return [Message(*each) for each in zip(sent[kept], arrived[kept], strict=True)]


def followed(
    sent: list[Message], interval: float, *, with_velocities: bool = False
) -> tuple[Floats, Floats]:
    """Return times (k,) [s] and the reference (k, 3, 2) of a stream."""
    settings = config()
    stream = TargetStream()
    fastest = np.array(settings.limits.velocity)

    def plans() -> Iterator[tuple[float, Callable[[Floats], Floats]]]:
        for message in sent:
            now = _SAMPLE * np.floor(message.arrived / _SAMPLE)
            at = np.array([message.sent])
            target = stream.target(
                now,
                motion(at)[0],
                timeout=settings.reference.stream_timeout,
                fastest=fastest,
                velocities=motion(at, 1)[0] if with_velocities else None,
                ahead=interval if with_velocities else None,
            )
            begin = now + _LEAD

            yield begin, partial(_plan_target, target, begin)

    return _sampled(plans())


def _plan_target(target: Target, begin: float, before: Floats) -> Floats:
    return plan_target(target, before, begin, config()).vector


def _plan_trajectory(trajectory: Trajectory, begin: float, before: Floats) -> Floats:
    return plan_trajectory(trajectory, before, begin, config()).vector


def _sampled(
    plans: Iterator[tuple[float, Callable[[Floats], Floats]]],
) -> tuple[Floats, Floats]:
    """Return times (k,) [s] and the reference (k, 3, 2) of plans, each from its own begin on."""
    times: Floats = np.arange(0.0, _DURATION, _SAMPLE)
    vector = pack(2, [minimum_jerk(np.zeros(1), motion(np.zeros(1)))])
    parts = []
    first = 0
    for begin, plan in plans:
        last = max(first, int(np.searchsorted(times, begin)))
        parts.append(sampled(vector, times[first:last]))
        vector = remaining(plan(vector), begin - _SAMPLE)
        first = last
    parts.append(sampled(vector, times[first:]))
    return times, np.concatenate(parts)


def lag_of(times: Floats, positions: Floats) -> tuple[float, float]:
    """Return by how much [s] the reference is behind the sender, and how far [rad] off then."""
    settled = times > _SETTLED
    lags = np.arange(0.0, 0.25, 0.5e-3)
    off = [
        np.abs(positions[settled] - motion(times[settled] - lag)).max() for lag in lags
    ]
    best = int(np.argmin(off))
    return float(lags[best]), float(off[best])


def stream_rows() -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of streams."""
    for name, with_velocities in (('positions', False), ('with velocities', True)):
        for case, late, lost in (
            ('', 0.0, 0.0),
            (', late', _LATE, 0.0),
            (', lost', 0.0, _LOST),
        ):
            row = []
            for rate in RATES:
                times, reference = followed(
                    messages(1.0 / rate, late, lost),
                    1.0 / rate,
                    with_velocities=with_velocities,
                )
                lag, off = lag_of(times, reference[:, 0])
                row.append(f'{1e3 * lag:.1f} ms, {1e3 * off:.1f} mrad')
            yield name + case, *row


# Chunks.


def chunk(number: int) -> tuple[Floats, Floats]:
    """Return times (k,) [s] and positions, velocities, accelerations (3, k, 2) of a chunk."""
    times: Floats = number * _CHUNKS + _AHEAD * np.arange(1.0, _POINTS + 1.0)
    points = np.array([motion(times, derivative) for derivative in range(3)])
    points[0] += np.random.default_rng(number).normal(0.0, _CHANGE, 2)
    return times, points


def followed_chunks(fields: int) -> tuple[Floats, Floats]:
    """Return times (k,) [s] and this package's reference (k, 3, 2) for chunks with first fields."""
    settings = config()

    def plans() -> Iterator[tuple[float, Callable[[Floats], Floats]]]:
        for number in range(round(_DURATION / _CHUNKS) - _POINTS):
            sent = number * _CHUNKS
            times, points = chunk(number)
            given = [
                TrajectoryPoint(float(t), *map(tuple, point))
                for t, point in zip(
                    times - sent, points[:fields].swapaxes(0, 1).tolist(), strict=True
                )
            ]
            trajectory = Trajectory(settings.joints, tuple(given), sent)
            begin = sent + _LATENCY + _CHUNK_LEAD

            yield begin, partial(_plan_trajectory, trajectory, begin)

    return _sampled(plans())


def splined_chunks(fields: int) -> tuple[Floats, Floats]:
    """Return times and the reference (k, 3, 2) of splines from point to point.

    As joint_trajectory_controller: linear, cubic or quintic by the fields; a new chunk
    begins at the desired state of the moment, and drops all of the one before.
    """
    times: Floats = np.arange(0.0, _DURATION, _SAMPLE)
    reference = np.zeros((times.size, 3, 2))
    knots = np.zeros(1)
    states = np.zeros((3, 1, 2))
    states[0] = motion(np.zeros(1))
    number = 0
    for i, t in enumerate(times):
        if t >= number * _CHUNKS + _LATENCY and number < _DURATION / _CHUNKS - _POINTS:
            own, points = chunk(number)
            now = _spline(knots, states, fields, t)
            knots = np.concatenate(([t], own[own > t]))
            states = np.concatenate((now[:, np.newaxis], points[:, own > t]), axis=1)
            number += 1
        reference[i] = _spline(knots, states, fields, t)
    return times, reference


def _spline(knots: Floats, states: Floats, fields: int, t: float) -> Floats:
    """Return position, velocity, acceleration (3, 2) at t of the polynomial between two knots."""
    k = int(np.clip(np.searchsorted(knots, t, 'right') - 1, 0, max(knots.size - 2, 0)))
    if knots.size == 1 or t >= knots[-1]:
        held: Floats = np.zeros((3, 2))
        held[0] = states[0, -1]
        return held
    h = knots[k + 1] - knots[k]
    powers = np.arange(2 * fields)

    def row(x: float, derivative: int) -> Floats:
        factors = np.ones(powers.size)
        for d in range(derivative):
            factors = factors * (powers - d)
        return np.where(
            powers >= derivative, factors * x ** np.maximum(powers - derivative, 0), 0.0
        )

    conditions = [row(x, d) for x in (0.0, h) for d in range(fields)]
    wanted = np.concatenate((states[:fields, k], states[:fields, k + 1]))
    coefficients = np.linalg.solve(np.array(conditions), wanted)
    return np.array([row(t - knots[k], d) @ coefficients for d in range(3)])


def chunk_rows() -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of chunks."""
    splines = ('linear', 'cubic', 'quintic')
    for fields, given in enumerate(
        ('positions', 'and velocities', 'and accelerations'), start=1
    ):
        for name, follow in (
            ('this package', followed_chunks),
            (f'{splines[fields - 1]} spline', splined_chunks),
        ):
            times, reference = follow(fields)
            inside = (times > _SETTLED) & (times < _DURATION - _POINTS * _CHUNKS)
            q = reference[inside, 0]
            jump = np.abs(np.diff(reference[inside, 1], axis=0)).max()
            largest = np.abs(np.diff(q, 2, axis=0)).max() / _SAMPLE**2
            jerk = np.diff(q, 3, axis=0) / _SAMPLE**3
            off = np.abs(q - motion(times[inside])).max()
            yield (
                given,
                name,
                f'{1e3 * off:.1f}',
                f'{1e3 * jump:.1f}',
                f'{largest:.1f}',
                f'{np.sqrt(np.mean(jerk**2)):.0f}',
            )


def main(_options: argparse.Namespace) -> None:
    """Print the tables."""
    print_table(_HEAD, list(stream_rows()))
    print_table(
        (
            'chunks give',
            'reference',
            'largest error [mrad]',
            'largest step of the velocity in 1 ms [mrad/s]',
            'largest acceleration [rad/s^2]',
            'jerk, rms [rad/s^3]',
        ),
        list(chunk_rows()),
    )
