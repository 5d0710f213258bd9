# SPDX-License-Identifier: Apache-2.0
"""A lock that processes hold one at a time; it ends with the process that holds it.

`filelock` has more, but rosdep knows no key for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # such as on Windows
    LOCKS = False
else:
    LOCKS = True

WAITS = 'blf_dsc_controller:wait'
"""Event of numba when a process begins to wait for a kernel; its data is the kernel's name."""

_PATIENCE = 600.0  # s: a process may have been stopped while it holds the lock
_POLL = 0.05  # s


class FileLock:
    """A lock by a file, which is created.

    Where no file can be created or locked, nobody is locked out: then several may do the same work.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None

    def acquire(self, announce: Callable[[], object]) -> None:
        """Wait until no other process holds the lock, at most ten minutes, and hold it.

        `announce` is called once if another one holds it.
        """
        if self._file is not None or not LOCKS:
            return
        with suppress(OSError):  # read-only or full
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._path.open('ab')
        end = time.monotonic() + _PATIENCE
        waits = False
        while self._file is not None and time.monotonic() < end:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if not waits:
                    announce()
                waits = True
                time.sleep(_POLL)
            else:
                return

    def release(self) -> None:
        """Let the next process have the lock."""
        if self._file is not None:
            self._file.close()
            self._file = None
