# SPDX-License-Identifier: Apache-2.0
"""A long table in a temporary file, of which only what is asked for comes into memory."""

from __future__ import annotations

import os
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

_BLOCK = 4096  # rows that are written at once, each column in one piece


class Columns:
    """Append-only table of `width` columns of 64-bit numbers."""

    def __init__(self, width: int) -> None:
        self.width = width
        self._pending = np.empty((width, _BLOCK), np.int64)
        self._blocks = self._filled = 0
        self._file: Any = None

    def __len__(self) -> int:
        return _BLOCK * self._blocks + self._filled

    def __del__(self) -> None:
        if self._file is not None:
            self._file.close()

    def append(self, rows: NDArray[np.int64]) -> None:
        """Append rows (m, width)."""
        while rows.shape[0]:
            taken = rows[: _BLOCK - self._filled]
            self._pending[:, self._filled : self._filled + taken.shape[0]] = taken.T
            self._filled += taken.shape[0]
            rows = rows[taken.shape[0] :]
            if self._filled == _BLOCK:
                if self._file is None:
                    self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - its owner's
                self._file.write(self._pending)
                self._blocks, self._filled = self._blocks + 1, 0

    def read(self, column: int, rows: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return some rows of a column, as an array of its own."""
        if not rows.size:
            return np.empty(0, np.int64)
        first, last = (int(row) // _BLOCK for row in (rows.min(), rows.max()))
        found = np.empty((last + 1 - first, _BLOCK), np.int64)
        for number in range(first, min(last + 1, self._blocks)):
            offset = 8 * _BLOCK * (number * self.width + column)
            found[number - first] = np.frombuffer(
                os.pread(self._file.fileno(), 8 * _BLOCK, offset), np.int64
            )
        if last == self._blocks:
            found[-1] = self._pending[column]
        return np.asarray(found.ravel()[rows - first * _BLOCK])
