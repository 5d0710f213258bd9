# SPDX-License-Identifier: Apache-2.0
"""Numbers in temporary files: appended, then mapped into memory and read as arrays."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.run import Floats

BLOCK = 1 << 14
"""Rows that are computed at once."""


class OnDisk:
    """A temporary file to which bytes or arrays are appended.

    Attributes:
        size: bytes that it has.
    """

    def __init__(self) -> None:
        self.size = 0
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed below

    def __del__(self) -> None:
        if '_file' in vars(self):  # not if Ctrl-C came while it was opened
            with suppress(OSError):  # of a full disk, which has been reported
                self._file.close()

    def append(self, data: bytes | NDArray[Any]) -> None:
        """Append bytes, or the content of an array."""
        raw = data if isinstance(data, bytes) else data.tobytes()
        self._file.write(raw)
        self.size += len(raw)

    def array(self, dtype: str) -> NDArray[Any]:
        """Return what was appended as an array (N,), which may outlive the file."""
        self._file.flush()
        if not self.size:
            return np.zeros(0, dtype)
        return np.memmap(self._file, dtype, 'c').view(np.ndarray)


def blocks_of(size: int) -> Iterator[slice]:
    """Yield slices of so many rows, one after the other."""
    for first in range(0, size, BLOCK):
        yield slice(first, min(first + BLOCK, size))


class Samples:
    """An array (N, ...) of floats on disk, of which rows come into memory when indexed."""

    def __init__(self, blocks: Iterator[Floats]) -> None:
        """Write blocks of rows (., ...), of which there is at least one."""
        self._store = OnDisk()
        for block in blocks:
            self._shape = block.shape[1:]
            self._store.append(np.asarray(block, dtype=np.float64))

    def __len__(self) -> int:
        return len(self._mapped())

    def __getitem__(self, rows: Any) -> Floats:
        return np.array(self._mapped()[rows])

    def _mapped(self) -> Floats:
        """Map the file for as long as it is read: pages that were read are memory, too."""
        return self._store.array('<f8').reshape(-1, *self._shape)


def mapped(size: int, function: Callable[[slice], Floats], margin: int = 0) -> Samples:
    """Return the rows (`size`, k) that a function returns for the slices of `blocks_of`.

    It is given so many rows more on both sides, where there are some.
    """

    def own(rows: slice) -> Floats:
        first = max(rows.start - margin, 0)
        found = function(slice(first, min(rows.stop + margin, size)))
        return found[rows.start - first : rows.stop - first]

    return Samples(map(own, blocks_of(size)))
