# SPDX-License-Identifier: Apache-2.0
"""Rows of numbers in a temporary file, of which only what is asked for comes into memory."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np

from blf_dsc_controller.run import Floats

BLOCK = 1 << 14
"""Rows that are in memory at once."""

_BYTES = 8


class Samples(Protocol):
    """Rows (N, k) that are read by slices: an array, or what comes from a file."""

    def __getitem__(self, rows: slice, /) -> Any:
        """Return some rows."""


class OnDisk:
    """Rows (N, k) of floats in a temporary file, read and written by slices without a step."""

    def __init__(self, width: int) -> None:
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - closed below
        self._width = width
        self._size = 0

    def __del__(self) -> None:
        self._file.close()

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return self._size, self._width

    def __len__(self) -> int:
        return self._size

    def append(self, rows: Floats) -> None:
        """Add rows (m, k) at the end."""
        self._size += len(rows)
        self[self._size - len(rows) : self._size] = rows

    def __getitem__(self, rows: slice) -> Floats:
        first, last, _ = rows.indices(self._size)
        found = np.empty((max(last - first, 0), self._width))
        if found.size:
            at = first * self._width * _BYTES
            os.preadv(self._file.fileno(), [found.data.cast('B')], at)
        return found

    def __setitem__(self, rows: slice, values: Floats) -> None:
        first, _, _ = rows.indices(self._size)
        raw = np.ascontiguousarray(values, dtype=np.float64).data.cast('B')
        at = first * self._width * _BYTES
        while raw:
            written = os.pwrite(self._file.fileno(), raw, at)
            at += written
            raw = raw[written:]

    def __array__(self, dtype: Any = None, copy: Any = None) -> Floats:
        """Return all of them."""
        return self[:].astype(dtype or np.float64, copy=False)


def blocks_of(size: int) -> Iterator[slice]:
    """Yield slices of so many rows, one after the other."""
    for first in range(0, size, BLOCK):
        yield slice(first, min(first + BLOCK, size))


def mapped(size: int, function: Callable[[slice], Floats]) -> OnDisk:
    """Return the rows (`size`, k) that a function returns for the slices of `blocks_of`."""
    found = OnDisk(function(slice(0, 1)).shape[1])
    for rows in blocks_of(size):
        found.append(function(rows))
    return found
