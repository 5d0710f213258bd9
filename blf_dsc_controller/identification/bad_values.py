# SPDX-License-Identifier: Apache-2.0
"""Numbers of a recording that are none: stand-ins for missing values, torques nobody recorded.

A stand-in, such as -9999 or 1e10, is far from all other values of its column.  A torque
of a moving arm is not the same in all rows, nor exactly zero for long between values
that are not small, nor zero in all joints at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.run import Floats

_FAR = 500.0  # as a file has it: those in use begin with 999
_TIMES = 5.0  # as far as any other value of the column
_MOST = 8  # different ones in a column
_LONG = 5  # rows of zeros
_NOT_SMALL = 0.1  # of a joint's largest torque, beside such zeros ...
_STEPS = 5.0  # ... and times its least one, which may be a step


class Extremes(NamedTuple):
    """Least and largest known value of each column (n,); inf and -inf if it has none."""

    least: Floats
    most: Floats

    @property
    def largest(self) -> Floats:
        """The largest distance from zero."""
        return np.maximum(-self.least, self.most)


def extremes(values: Floats) -> Extremes:
    """Return the extremes of values (N, n)."""
    known = np.isfinite(values)
    return Extremes(
        np.min(values, axis=0, initial=np.inf, where=known),
        np.max(values, axis=0, initial=-np.inf, where=known),
    )


def stand_ins(
    values: Floats, names: Sequence[str]
) -> tuple[NDArray[np.bool_], list[str]]:
    """Return the rows (N,) of values (N, k) of one kind that have stand-ins, and what to say."""
    rows = np.zeros(len(values), dtype=bool)
    said: list[str] = []
    found = extremes(values)
    with np.errstate(over='ignore'):  # of values such as 1e308
        spread = np.maximum(found.most - found.least, 0.0)
    doubtful = np.flatnonzero(spread >= _FAR).tolist()
    columns = {k: np.array(values[:, k]) for k in doubtful}
    spread[doubtful] = 0.0
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


def unrecorded(torque: Floats) -> NDArray[np.bool_]:
    """Return the rows (N,) in which all torques (N, n) are zero, or one is for long.

    Few of the former at the begin and the end stay: arms may have no torque there.
    """
    size, n = torque.shape
    sizes = np.abs(torque)
    found = np.zeros(size, dtype=bool)
    for begin, end in _runs((sizes == 0.0).all(axis=1)):
        is_inside = begin > 0 and end < size  # the first state may be before any torque
        if n > 1 and (is_inside or end - begin >= _LONG):
            found[begin:end] = True
    for own in sizes.T:
        least = np.min(own, initial=np.inf, where=own > 0.0)
        most = np.max(own, initial=0.0, where=own > 0.0)
        not_small = max(_NOT_SMALL * most, _STEPS * least)
        for begin, end in _runs(own == 0.0):
            before = own[begin - 1] if begin else np.inf
            after = own[end] if end < size else np.inf
            is_beside_small = before <= not_small or after <= not_small
            if end - begin >= _LONG and not is_beside_small:
                found[begin:end] = True
    return found


def _runs(which: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield begin and end of each run of true values."""
    edges = np.flatnonzero(np.diff(which.astype(np.int8), prepend=0, append=0))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
