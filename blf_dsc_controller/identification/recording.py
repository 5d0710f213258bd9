# SPDX-License-Identifier: Apache-2.0
"""Recordings of an arm, evenly sampled; several become one with gaps between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats, Stamps

Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

TURN = 2.0 * np.pi
"""A full turn [rad]."""

LONGEST_PERIOD = 0.02
"""Longest time between states [s], but for jitter."""

_JITTER = 1.2  # times that, median that is accepted
_FASTEST = 1e-5  # s, likewise
_FEWEST = 10  # states
_SPARSE = 100.0  # times the intervals between states: longest bag
GAP = 3.0
"""Intervals between two states from which something is missing."""


class Recording(NamedTuple):
    """N samples of n joints, a period apart."""

    joints: tuple[str, ...]
    period: float  # s
    q: Floats  # (N, n) rad, or m
    torque: Floats  # (N, n) N m, or N
    gap: Flags  # (N,) whether nothing was recorded here
    source: str  # of the torques: a topic, or columns of a table
    currents: bool = False  # whether the columns of the torques are named so
    twist: Floats | None = None  # (N, n) motors minus links, rad or m, if known

    @property
    def duration(self) -> float:
        """Time that it takes [s]."""
        return self.gap.size * self.period


def resampled(
    joints: tuple[str, ...],
    stamp: Stamps,
    q: Floats,
    torque: Floats,
    source: str,
    turning: Flags,
    motors: Floats | None = None,
) -> Recording:
    """Resample evenly, interpolating over uneven stamps and up to two lost states.

    Positions and torques are (N, n) at the stamps (N,) [ns]; NaN where one is unknown,
    and so are positions of the `motors`.  Those of `turning` joints (n,) may be wrapped
    to one turn.

    Raises:
        BlfDscError: there are too few states, or their stamps cannot be of one clock.
    """
    groups = [q, torque] if motors is None else [q, torque, motors]
    order = _order(stamp, groups)
    if not np.array_equal(order, np.arange(stamp.size)):
        stamp = stamp[order]
        groups = [each[order] for each in groups]
    q, torque, *others = groups
    time, even, period, gap = _grid_of(stamp)
    turns = _turns(q, turning)
    if turns.any():
        q = q + TURN * turns
        names = ', '.join(np.array(joints)[turns.any(axis=0)])
        source = f'{source} (positions of {names} are wrapped: full turns added)'
    twist = None
    if others:
        twist = interpolated(even, time, _twist(q, others[0], turning))
    q, torque = (interpolated(even, time, each) for each in (q, torque))
    return Recording(joints, period, q, torque, gap, source, twist=twist)


def _order(stamp: Stamps, groups: Sequence[Floats]) -> Indices:
    """Return the rows in which all values are known, each stamp once, in their order."""
    known = [np.isfinite(each).all(axis=1) for each in groups]
    order = np.flatnonzero(np.all(known, axis=0))
    return order[np.unique(stamp[order], return_index=True)[1]]


def _turns(q: Floats, turning: Flags) -> Floats:
    """Return the full turns (N, n) that the encoders of joints have left out.

    From one state to the next, a joint turns by less than half a turn.  A larger step is
    the end of the encoder's range.
    """
    turns = np.diff(q, axis=0, prepend=q[:1])
    turns /= -TURN
    np.round(turns, out=turns)
    turns *= turning
    return np.cumsum(turns, axis=0, out=turns)


def _grid_of(stamp: Stamps) -> tuple[Floats, Floats, float, Flags]:
    """Return the times [s] of states at these stamps, which increase, and even ones.

    Also the period of the latter [s], and whether nothing was recorded at each.

    Raises:
        BlfDscError: there are too few, or they cannot be of one clock.
    """
    if stamp.size < _FEWEST:
        raise BlfDscError(
            f'there are {stamp.size} joint state(s) with a position, a torque and a unique '
            'stamp; hundreds are needed'
        )
    time = (stamp - stamp[0]) * 1e-9
    intervals = np.diff(time)
    period = float(np.median(intervals))
    if period > _JITTER * LONGEST_PERIOD:
        raise BlfDscError(
            f'the joint states are {period:.3g} s apart; at least one in {LONGEST_PERIOD:g} s is '
            f'needed: record them at {1.0 / LONGEST_PERIOD:.0f} Hz or more'
        )
    if period < _FASTEST or time[-1] > _SPARSE * period * time.size:
        raise BlfDscError(
            f'{time.size} joint states are {period:.3g} s apart, but the last one comes '
            f'{time[-1]:.3g} s after the first: are their stamps of one clock? Cut the recording '
            'where they jump'
        )
    even = np.arange(0.0, time[-1], period)
    gap = (intervals > GAP * period)[np.searchsorted(time, even, side='right') - 1]
    return time, even, period, gap


def _twist(links: Floats, motors: Floats, turning: Flags) -> Floats:
    """Return motors minus links (N, n), without what their zeros differ by, and full turns."""
    twist = motors - links
    twist -= np.median(twist, axis=0)
    twist -= TURN * np.round(twist / TURN) * turning
    return twist


def interpolated(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> Floats:
    """Return the values (N, n) of these times at other times (k,), linearly interpolated.

    Before the first time and after the last one, values are those at that time.
    """
    columns = [np.interp(at, time, column) for column in values.T]
    return np.transpose(columns)


def joined(first: Recording, *others: Recording) -> tuple[Recording, list[float]]:
    """Return recordings with gaps between them as one, and the times [s] at which others begin.

    All have the period of the first.
    """
    together = first
    begins = []
    for other in others:
        begins.append(together.duration)
        times = np.asarray(np.arange(other.gap.size) * other.period, dtype=np.float64)
        grid = np.arange(0.0, times[-1], first.period)
        gap = np.interp(grid, times, other.gap) > 0.0
        gap[0] = True
        values: dict[str, Any] = {}
        for name in ('q', 'torque', 'twist'):
            before, after = getattr(together, name), getattr(other, name)
            values[name] = None
            if before is not None and after is not None:
                values[name] = np.append(before, interpolated(grid, times, after), 0)
        together = together._replace(
            **values,
            gap=np.append(together.gap, gap),
            source=f'{together.source}, {other.source}',
        )
    return together, begins
