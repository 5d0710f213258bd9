# SPDX-License-Identifier: Apache-2.0
"""Numbers of a recording that are none: stand-ins for missing values, torques nobody recorded.

A stand-in, such as -9999 or 1e10, is far from all other values of its column.  A torque
of a moving arm is not the same in all rows, nor exactly zero for long between values
that are not small, nor zero in all joints at once.

Values are those of a table, or of a bag, which are on disk: they are read in blocks,
and whole columns of them only where one may have a stand-in.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.topic_messages import Values
from blf_dsc_controller.identification.on_disk import blocks_of
from blf_dsc_controller.run import Floats

_FAR = 500.0  # as a file has it: those in use begin with 999
_TIMES = 5.0  # as far as any other value of the column
_MOST = 8  # different ones in a column
_LONG = 5  # rows of zeros
_NOT_SMALL = 0.1  # of a joint's largest torque, beside such zeros ...
_STEPS = 5.0  # ... and times its least one, which may be a step

Column = Floats | Values
"""Values (N, n), in memory or on disk."""


class Extremes(NamedTuple):
    """Least and largest known value of each column (n,); inf and -inf if it has none."""

    least: Floats
    most: Floats

    @property
    def largest(self) -> Floats:
        """The largest distance from zero."""
        return np.maximum(-self.least, self.most)

    @property
    def are_same(self) -> NDArray[np.bool_]:
        """Which columns have one value only."""
        return np.asarray(self.least == self.most)


def extremes(values: Column, rows: NDArray[np.bool_]) -> Extremes:
    """Return the extremes of values (N, n) in some rows (N,)."""
    least: list[Floats] = []
    most: list[Floats] = []
    for at in blocks_of(rows.size):
        block = values[at]
        known = np.isfinite(block) & rows[at, None]
        least.append(np.min(block, axis=0, initial=np.inf, where=known))
        most.append(np.max(block, axis=0, initial=-np.inf, where=known))
    return Extremes(np.min(least, axis=0), np.max(most, axis=0))


def stand_ins(
    values: Column, size: int, names: Sequence[str]
) -> tuple[NDArray[np.bool_], list[str]]:
    """Return the rows (N,) of values (N, k) of one kind that have stand-ins, and what to say."""
    rows = np.zeros(size, dtype=bool)
    said: list[str] = []
    found = extremes(values, ~rows)
    with np.errstate(over='ignore'):  # of values such as 1e308
        spread = np.maximum(found.most - found.least, 0.0)
    columns = {k: np.array(values[:, k]) for k in _where(spread >= _FAR)}
    spread[list(columns)] = 0.0
    for _ in range(_MOST if columns else 0):
        with np.errstate(over='ignore'):
            apart = _stand_ins(columns, spread.max())
        for k, value in apart.items():
            at = columns[k] == value
            columns[k][at] = np.nan
            rows |= at
            said.append(f'{names[k]} is {value:g} in {at.sum()} row(s)')
        if not apart:
            break
    return rows, said


def _where(which: NDArray[np.bool_]) -> list[int]:
    return [int(k) for k in np.flatnonzero(which)]


def _stand_ins(columns: dict[int, Floats], spread: float) -> dict[int, float]:
    """Return a stand-in of each column that has one, farther off than any other values are.

    Values of other columns have that spread.
    """
    found = {k: _apart(column[np.isfinite(column)]) for k, column in columns.items()}
    largest = max([spread, *(each.spread for each in found.values())])
    return {
        k: each.value
        for k, each in found.items()
        if each.distance > max(_FAR, _TIMES * each.spread, largest)
    }


class _Apart(NamedTuple):
    """The value of a column that is farthest from all others, which have this spread."""

    value: float
    distance: float
    spread: float


def _apart(known: Floats) -> _Apart:
    """Return the value of a column (N,) that may be a stand-in."""
    if not known.size or np.ptp(known) < _FAR:
        return _Apart(np.nan, 0.0, float(np.ptp(known)) if known.size else 0.0)
    median = _middle(known)
    farthest = float(known[np.argmax(np.abs(known - median))])
    # where most are missing, the median is the stand-in
    found = [_compared(known, value) for value in (farthest, median)]
    return max(found, key=lambda each: each.distance / (each.spread or _FAR))


def _compared(known: Floats, value: float) -> _Apart:
    others = known[known != value]
    centre = _middle(others)
    spread = float(np.abs(others - centre).max())
    return _Apart(value, abs(value - centre), spread)


def _middle(values: Floats) -> float:
    """Return the median, one of the values: a mean of two would overflow."""
    half = values.size // 2
    return float(np.partition(values, half)[half])


def unrecorded(torque: Column, size: int) -> NDArray[np.bool_]:
    """Return the rows (N,) in which all torques (N, n) are zero, or one is for long.

    Few of the former at the begin and the end stay: arms may have no torque there.
    """
    is_zero: NDArray[np.bool_] = np.concatenate(
        [torque[at] == 0.0 for at in blocks_of(size)]
    )
    found = np.zeros(size, dtype=bool)
    for begin, end in _runs(np.all(is_zero, axis=1)):
        is_inside = begin > 0 and end < size  # the first state may be before any torque
        if is_zero.shape[1] > 1 and (is_inside or end - begin >= _LONG):
            found[begin:end] = True
    least, most = _sizes(torque, size)
    not_small = np.maximum(_NOT_SMALL * most, _STEPS * least)
    for k, zeros in enumerate(is_zero.T):
        runs = [run for run in _runs(zeros) if run[1] - run[0] >= _LONG]
        for (begin, end), beside in zip(
            runs, _beside(torque, k, runs, size), strict=True
        ):
            if not (beside <= not_small[k]).any():
                found[begin:end] = True
    return found


def _beside(
    torque: Column, k: int, runs: Sequence[tuple[int, int]], size: int
) -> Floats:
    """Return the torque (r, 2) of a joint before and after each run; inf where there is none."""
    at = np.array([(begin - 1, end) for begin, end in runs], dtype=np.intp)
    at = at.reshape(-1, 2)
    values = torque[np.clip(at, 0, size - 1).ravel(), k]
    outside = (at < 0) | (at >= size)
    return np.where(outside, np.inf, np.abs(values).reshape(-1, 2))


def _sizes(torque: Column, size: int) -> tuple[Floats, Floats]:
    """Return the least and the largest torque (n,) of each joint besides zero."""
    least: list[Floats] = []
    most: list[Floats] = []
    for at in blocks_of(size):
        block = np.abs(torque[at])
        least.append(np.min(block, axis=0, initial=np.inf, where=block > 0.0))
        most.append(np.max(block, axis=0, initial=0.0, where=block > 0.0))
    return np.min(least, axis=0), np.max(most, axis=0)


def _runs(which: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield begin and end of each run of true values."""
    edges = np.flatnonzero(np.diff(which.astype(np.int8), prepend=0, append=0))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
