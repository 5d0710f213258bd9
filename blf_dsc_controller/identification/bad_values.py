# SPDX-License-Identifier: Apache-2.0
"""Numbers of a recording that are none: stand-ins for missing values, torques nobody recorded.

A stand-in, such as -9999 or 1e10, is far from all other values of its column.  A torque
of a moving arm is not the same in all rows, nor exactly zero for long between values
that are not small, nor zero in all joints at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from blf_dsc_controller.identification.recording import Flags
from blf_dsc_controller.run import Floats

_FAR = 500.0  # as a file has it: those in use begin with 999
_TIMES = 5.0  # as far as any other value of the column
_MOST = 8  # different ones in a column
_LONG = 5  # rows of zeros
_NOT_SMALL = 0.1  # of a joint's largest torque, beside such zeros ...
_STEPS = 5.0  # ... and times its least one, which may be a step


def extremes(values: Floats) -> tuple[Floats, Floats]:
    """Return least and largest known value of each column (n,) of values (N, n).

    They are inf and -inf where none is known.
    """
    known = np.isfinite(values)
    least = np.min(values, axis=0, initial=np.inf, where=known)
    return least, np.max(values, axis=0, initial=-np.inf, where=known)


def stand_ins(values: Floats, names: Sequence[str]) -> tuple[Flags, list[str]]:
    """Return the rows (N,) of values (N, k) of one kind that have stand-ins, and what to say."""
    rows = np.zeros(len(values), dtype=bool)
    said: list[str] = []
    lowest, highest = extremes(values)
    with np.errstate(over='ignore'):  # of values such as 1e308
        spread = np.maximum(highest - lowest, 0.0)
        doubtful = np.flatnonzero(spread >= _FAR).tolist()
        left = {k: np.unique(values[np.isfinite(values[:, k]), k]) for k in doubtful}
        spread[doubtful] = 0.0
        for _ in range(_MOST):
            apart = {k: _apart(each) for k, each in left.items() if each.size > 1}
            least = max([spread.max(), *(own for _, _, own in apart.values())])
            for k, (value, distance, own) in apart.items():
                if distance > max(_FAR, _TIMES * own, least):
                    at = values[:, k] == value
                    rows |= at
                    said.append(f'{names[k]} is {value:g} in {at.sum()} row(s)')
                    left[k] = left[k][left[k] != value]
    return rows, said


def _apart(known: Floats) -> tuple[float, float, float]:
    """Return what may be a stand-in of different values (k,) in their order: an end of them.

    Also how far it is from the others, and their spread.
    """
    middle = np.median(known)
    value = max(known[[0, -1]], key=lambda end: (abs(end - middle), abs(end)))
    others = known[known != value]
    centre = np.median(others)
    return value, abs(value - centre), np.abs(others - centre).max()


def unrecorded(torque: Floats) -> Flags:
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


def _runs(which: Flags) -> Iterator[tuple[int, int]]:
    """Yield begin and end of each run of true values."""
    edges = np.flatnonzero(np.diff(which.astype(np.int8), prepend=0, append=0))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
