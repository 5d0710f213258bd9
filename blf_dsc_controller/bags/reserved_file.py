# SPDX-License-Identifier: Apache-2.0
"""File that can still be completed when its disk is full."""

from __future__ import annotations

import errno
import os
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT)
_STEP = 1 << 20  # bytes
_LARGEST_BUFFER = 1 << 20  # bytes


class ReservedFile:
    """File, buffered until `flush`, that can still be completed when its disk is full.

    A second file of zeros reserves room for what is not written yet: the current chunk, the index,
    metadata.yaml. It is removed when the disk is full; `is_full` then means: complete the file.

    Raises:
        OSError: the file cannot be created, or there is no room for the reserve.
    """

    def __init__(self, path: Path) -> None:
        self.is_full = False
        self._file = path.open('xb', buffering=0)
        self._buffer = bytearray()
        self._written = 0
        self._reserve = path.with_name(f'.{path.name}.reserve')
        self._reserved = 0
        self.reserve(0)
        if self.is_full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    def reserve(self, size: int) -> None:
        """Reserve room for `size` bytes beyond what is flushed, in whole steps."""
        if size + _STEP <= self._reserved or self.is_full:
            return
        reserved = (size // _STEP + 2) * _STEP
        try:
            with self._reserve.open('ab') as reserve:
                os.posix_fallocate(reserve.fileno(), 0, reserved)
        except OSError as error:
            if error.errno not in _FULL:
                raise
            self.is_full = True
        else:
            self._reserved = reserved

    def write(self, data: bytes) -> int:
        """Buffer bytes; OSError if writing fails for a reason other than a full disk."""
        self._buffer += data
        if len(self._buffer) >= _LARGEST_BUFFER:
            self.flush()
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes received so far."""
        return self._written + len(self._buffer)

    def flush(self) -> None:
        """Pass all bytes to the operating system, giving up the reserve if needed."""
        waiting = memoryview(self._buffer)
        while waiting:
            try:
                count = self._file.write(waiting) or 0
            except OSError as error:
                if error.errno not in _FULL or not self._reserved:
                    raise
                self.is_full = True
                self._remove_reserve()
                continue
            self._written += count
            waiting = waiting[count:]
        waiting.release()
        self._buffer = bytearray()

    def close(self) -> None:
        """Flush and close the file, and release the reserve for metadata.yaml."""
        self._remove_reserve()
        self.flush()
        self._file.close()

    def _remove_reserve(self) -> None:
        self._reserved = 0
        self._reserve.unlink(missing_ok=True)
