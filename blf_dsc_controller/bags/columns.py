# SPDX-License-Identifier: Apache-2.0
"""A long table in a temporary file, of which only what is asked for comes into memory."""

from __future__ import annotations

import os
import tempfile
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

BLOCK = 4096
"""Rows that are written at once, each column in one piece."""

_PART = 16 * BLOCK  # rows in memory at once, if some of them are chosen

Rows: TypeAlias = 'slice | NDArray[np.intp]'
ALL = slice(None)


class Columns:
    """Append-only table of `width` columns of 64-bit numbers."""

    def __init__(self, width: int) -> None:
        self.width = width
        self._pending = np.empty((BLOCK, width), np.int64)
        self._blocks = self._filled = 0
        self._file: Any = None

    def __len__(self) -> int:
        return BLOCK * self._blocks + self._filled

    def __del__(self) -> None:
        if self._file is not None:
            self._file.close()

    def append(self, rows: NDArray[np.int64]) -> None:
        """Append rows (m, width)."""
        while rows.shape[0]:
            taken = rows[: BLOCK - self._filled]
            self._pending[self._filled : self._filled + taken.shape[0]] = taken
            self._filled += taken.shape[0]
            rows = rows[taken.shape[0] :]
            if self._filled == BLOCK:
                if self._file is None:
                    self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - its owner's
                self._file.write(self._pending.T.tobytes())
                self._blocks, self._filled = self._blocks + 1, 0

    def read(self, columns: NDArray[np.intp], rows: Rows = ALL) -> NDArray[np.int64]:
        """Return these columns and rows (m, number of columns) as an array of its own."""
        if not isinstance(rows, slice):
            found = np.empty((rows.size, columns.size), np.int64)
            for begin in range(0, len(self), _PART):
                chosen = np.flatnonzero((rows >= begin) & (rows < begin + _PART))
                if chosen.size:
                    part = self.read(columns, slice(begin, begin + _PART))
                    found[chosen] = part[rows[chosen] - begin]
            return found
        first, last, step = rows.indices(len(self))
        if step > 1:
            return self.read(columns, np.arange(first, last, step))
        found = np.empty((max(last - first, 0), columns.size), np.int64)
        for number in range(first // BLOCK, -(-last // BLOCK)):
            begin = number * BLOCK
            within = slice(max(first - begin, 0), min(last - begin, BLOCK))
            target = found[begin + within.start - first : begin + within.stop - first]
            if number == self._blocks:
                target[:] = self._pending[within][:, columns]
            else:
                for k, column in enumerate(columns.tolist()):
                    offset = 8 * (BLOCK * (number * self.width + column) + within.start)
                    raw = os.pread(self._file.fileno(), 8 * target.shape[0], offset)
                    target[:, k] = np.frombuffer(raw, np.int64)
        return found
