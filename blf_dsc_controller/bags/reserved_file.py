# SPDX-License-Identifier: Apache-2.0
"""A file that can still be ended in order when its disk is full.

Beside it lies a file of nothing, which holds room on the disk for what is not written yet: the
present chunk, the index, metadata.yaml. When the disk is full it is given up for them.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT)
_STEP = 1 << 20  # bytes
_LARGEST_BUFFER = 1 << 20  # bytes


class ReservedFile:
    """Takes bytes like a stream, and keeps them until they are flushed.

    Args:
        path: of a file that does not exist yet.

    Attributes:
        is_full: whether the disk has been found full; from then on the file should be ended.

    Raises:
        OSError: it cannot be made, or there is not even room for the reserve.
    """

    def __init__(self, path: Path) -> None:
        self.is_full = False
        self._file = path.open('xb', buffering=0)
        self._buffer = bytearray()
        self._written = 0
        self._reserve = path.with_name(f'.{path.name}.reserve')
        self._reserved = 0
        self._grow(2 * _STEP)
        if self.is_full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    def hold(self, size: int) -> None:
        """See that there is room for `size` bytes more than what is flushed, in whole steps."""
        if size + _STEP > self._reserved and not self.is_full:
            self._grow((size // _STEP + 2) * _STEP)

    def write(self, data: bytes) -> int:
        """Take bytes; OSError if they cannot be written for another reason than a full disk."""
        self._buffer += data
        if len(self._buffer) >= _LARGEST_BUFFER:
            self.flush()
        return len(data)

    def tell(self) -> int:
        """Bytes taken so far."""
        return self._written + len(self._buffer)

    def flush(self) -> None:
        """Hand all bytes to the operating system, at the cost of the reserve if need be."""
        waiting = memoryview(self._buffer)
        while waiting:
            try:
                count = self._file.write(waiting) or 0
            except OSError as error:
                if error.errno not in _FULL or not self._reserved:
                    raise
                self.is_full = True
                self._give_up_reserve()
                continue
            self._written += count
            waiting = waiting[count:]
        waiting.release()
        self._buffer = bytearray()

    def close(self) -> None:
        """Flush and end the file; the room for metadata.yaml is free from here on."""
        self._give_up_reserve()
        self.flush()
        self._file.close()

    def _grow(self, size: int) -> None:
        try:
            with self._reserve.open('ab') as reserve:
                os.posix_fallocate(reserve.fileno(), 0, size)
        except OSError as error:
            if error.errno not in _FULL:
                raise
            self.is_full = True
        else:
            self._reserved = size

    def _give_up_reserve(self) -> None:
        self._reserved = 0
        self._reserve.unlink(missing_ok=True)
