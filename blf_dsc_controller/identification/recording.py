# SPDX-License-Identifier: Apache-2.0
"""Recordings of an arm, evenly sampled; several become one with gaps between them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.run import Floats

Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

TURN = 2.0 * np.pi
"""A full turn [rad]."""

LONGEST_PERIOD = 0.02
"""Longest time between states [s], but for jitter."""

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
