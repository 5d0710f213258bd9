# SPDX-License-Identifier: Apache-2.0
"""Full turns that the encoder of a joint has left out: positions wrapped to one turn.

From one state to the next, a joint turns by less than half a turn.  A larger step is
the end of the encoder's range.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.run import Floats

TURN = 2.0 * np.pi
"""A full turn [rad]."""


class Turns:
    """Turns of n joints, to be added to N positions.

    Attributes:
        wrapped: which joints (n,) have any.
    """

    def __init__(self, blocks: Iterable[Floats], turning: NDArray[np.bool_]) -> None:
        """Take successive positions (k, n), of which some joints turn [rad]."""
        steps: list[tuple[Floats, NDArray[np.intp]]] = []
        first = 0
        last: Floats | None = None
        for block in blocks:
            before = block[:1] if last is None else last
            step = np.diff(block, axis=0, prepend=before)
            turns = -np.round(step / TURN) * turning
            at = np.flatnonzero(turns.any(axis=1))
            steps.append((turns[at], at + first))
            first += len(block)
            last = block[-1:]
        turns = np.concatenate(
            [np.zeros((1, turning.size)), *(each for each, _ in steps)]
        )
        self._total = np.cumsum(turns, axis=0)
        self._at = np.concatenate([np.zeros(0, np.intp), *(at for _, at in steps)])
        self.wrapped = turns.any(axis=0)

    def added(self, rows: slice, q: Floats) -> Floats:
        """Return the positions (k, n) of some rows without steps at full turns."""
        if not self._at.size:
            return q
        passed = np.searchsorted(self._at, np.arange(len(q)) + rows.start, 'right')
        return np.asarray(q + TURN * self._total[passed])
