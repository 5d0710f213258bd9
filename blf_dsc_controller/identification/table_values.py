# SPDX-License-Identifier: Apache-2.0
"""Numbers of a table that are none: stand-ins for missing values, torques that nobody recorded.

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

_FAR = 500.0  # as a table has it: those in use begin with 999
_TIMES = 5.0  # as far as any other value of the column
_MOST = 8  # different ones in a column
_LONG = 5  # rows of zeros
_NOT_SMALL = 0.1  # of a joint's largest torque, beside such zeros ...
_STEPS = 5.0  # ... and times its least one, which may be a step


def blank_stand_ins(values: Floats, names: Sequence[str]) -> list[str]:
    """Turn the stand-ins in columns (N, k) of one kind into NaN; return what was done."""
    said = []
    for _ in range(_MOST):
        with np.errstate(over='ignore'):  # of values such as 1e308
            found = _stand_ins(values)
        for k, value in found.items():
            at = values[:, k] == value
            values[at, k] = np.nan
            said.append(
                f'{names[k]!r} is {value:g} in {at.sum()} row(s), read as missing'
            )
        if not found:
            break
    return said


def _stand_ins(values: Floats) -> dict[int, float]:
    """Return a stand-in of each column that has one, farther off than any other values are."""
    columns = [_apart(column[np.isfinite(column)]) for column in values.T]
    largest = max(each.spread for each in columns)
    return {
        k: each.value
        for k, each in enumerate(columns)
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


def constant(torque: Floats) -> NDArray[np.intp]:
    """Return the joints whose known torque (N, n) is the same in all rows."""
    least = np.min(torque, axis=0, initial=np.inf, where=np.isfinite(torque))
    most = np.max(torque, axis=0, initial=-np.inf, where=np.isfinite(torque))
    return np.flatnonzero(least == most)


def unrecorded(torque: Floats) -> NDArray[np.bool_]:
    """Return the rows (N,) in which all torques (N, n) are zero, or one is for long.

    Few of the former at the begin and the end stay: arms may have no torque there.
    """
    is_zero = torque == 0.0
    n = len(torque)
    found = np.zeros(n, dtype=bool)
    for begin, end in _runs(is_zero.all(axis=1)):
        is_inside = begin > 0 and end < n  # the first state may be before any torque
        if torque.shape[1] > 1 and (is_inside or end - begin >= _LONG):
            found[begin:end] = True
    for column, zeros in zip(torque.T, is_zero.T, strict=True):
        sizes = np.abs(column)
        least = np.min(sizes, initial=np.inf, where=sizes > 0.0)
        most = np.max(sizes, initial=0.0, where=sizes > 0.0)
        not_small = max(_NOT_SMALL * most, _STEPS * least)
        for begin, end in _runs(zeros):
            beside = np.append(sizes[begin - 1 : begin], sizes[end : end + 1])
            if end - begin >= _LONG and (beside > not_small).all():
                found[begin:end] = True
    return found


def _runs(which: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield begin and end of each run of true values."""
    edges = np.flatnonzero(np.diff(which.astype(np.int8), prepend=0, append=0))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
