# SPDX-License-Identifier: Apache-2.0
"""Recordings of an arm, evenly sampled; several become one with gaps between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats, Stamps

_SLOWEST = 0.02  # s between states
_FASTEST = 1e-5  # s, likewise
_SPARSE = 100.0  # times the intervals between states: longest bag
_GAP = 3.0  # intervals between two states


class Recording(NamedTuple):
    """N samples of n joints, a period apart."""

    joints: tuple[str, ...]
    period: float  # s
    q: Floats  # (N, n) rad, or m
    torque: Floats  # (N, n) N m, or N
    gap: NDArray[np.bool_]  # (N,) whether nothing was recorded here
    source: str  # of the torques: a topic, or columns of a table


def resampled(
    joints: tuple[str, ...], stamp: Stamps, q: Floats, torque: Floats, source: str
) -> Recording:
    """Resample evenly, interpolating over uneven stamps and up to two lost states.

    Positions and torques are (N, n) at the stamps (N,) [ns]; NaN where one is unknown.

    Raises:
        BlfDscError: there are too few states, or their stamps cannot be of one clock.
    """
    known = np.isfinite(np.column_stack((q, torque))).all(axis=1)
    stamp, order = np.unique(stamp[known], return_index=True)
    q = q[known][order]
    torque = torque[known][order]
    if stamp.size < 2:
        raise BlfDscError(
            f'there are {stamp.size} joint state(s) with a position, a torque and a unique '
            'stamp; hundreds are needed'
        )
    time = (stamp - stamp[0]) * 1e-9
    intervals = np.diff(time)
    period = float(np.median(intervals))
    if period > _SLOWEST:
        raise BlfDscError(
            f'the joint states are {period:.3g} s apart; at least one in {_SLOWEST:g} s is needed'
        )
    if period < _FASTEST or time[-1] > _SPARSE * period * time.size:
        raise BlfDscError(
            f'{time.size} joint states are {period:.3g} s apart, but the last one comes '
            f'{time[-1]:.3g} s after the first: are their stamps of one clock? Cut the recording '
            'where they jump'
        )
    grid = np.arange(0.0, time[-1], period)
    gap = (intervals > _GAP * period)[np.searchsorted(time, grid, side='right') - 1]
    return Recording(
        joints,
        period,
        interpolated(grid, time, q),
        interpolated(grid, time, torque),
        gap,
        source,
    )


def interpolated(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> Floats:
    """Return the values (N, n) of these times at other times (k,), linearly interpolated."""
    columns = [np.interp(at, time, column) for column in values.T]
    return np.asarray(np.transpose(columns))


def joined(first: Recording, *others: Recording) -> tuple[Recording, list[float]]:
    """Return recordings with gaps between them as one, and the times [s] at which others begin.

    All have the period of the first.
    """
    together = first
    begins = []
    for other in others:
        begins.append(together.q.shape[0] * together.period)
        times = np.arange(other.q.shape[0]) * other.period
        grid = np.arange(0.0, times[-1], first.period)
        gap = np.interp(grid, times, other.gap) > 0.0
        gap[0] = True
        q = interpolated(grid, times, other.q)
        torque = interpolated(grid, times, other.torque)
        together = together._replace(
            q=np.vstack((together.q, q)),
            torque=np.vstack((together.torque, torque)),
            gap=np.append(together.gap, gap),
            source=f'{together.source}, {other.source}',
        )
    return together, begins
