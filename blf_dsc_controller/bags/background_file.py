# SPDX-License-Identifier: Apache-2.0
"""A file that is written in a thread of its own: a loop must not wait for a disk.

The thread needs Python's lock for microseconds at each flush: what takes long, the
writing, is done without it.
"""

from __future__ import annotations

from pathlib import Path
from queue import SimpleQueue
from threading import Thread

from blf_dsc_controller.bags.sources import BagError

_MOST = 256 << 20  # bytes that wait for the disk: minutes of a loop at 1 kHz


class BackgroundFile:
    """A new file; what is written leaves with the next `flush`.

    An error is raised once, by the next call; nothing is written from then on.
    """

    def __init__(self, path: Path, most: int = _MOST) -> None:
        """Open a new file; at most `most` bytes wait for the disk.

        Raises:
            FileExistsError: there is such a file.
        """
        self._file = path.open('xb', buffering=0)
        self.closed = False
        self._most = most
        self._taken = 0  # bytes
        self._done = 0
        self._pieces: list[bytes] = []
        self._queue: SimpleQueue[bytes | None] = SimpleQueue()
        self._error: Exception | None = None
        self._has_failed = False  # and said so
        self._thread = Thread(target=self._run, name='disk', daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> int:
        """Keep data until the next `flush`; return their size.

        Raises:
            OSError: earlier ones could not be written, such as on a full disk.
            BagError: the disk is too slow.
        """
        self._raise_error()
        size = len(data)
        if not self._has_failed:
            self._pieces.append(bytes(data))
        self._taken += size
        return size

    def tell(self) -> int:
        """Return how many bytes were written."""
        return self._taken

    def flush(self) -> None:
        """Let the thread write what was kept.

        Raises:
            OSError, BagError: as `write`.
        """
        if self.closed:
            return
        if self._error is None and self._taken - self._done > self._most:
            self._error = BagError(
                f'{self._most >> 20} MB wait for the disk, which is too slow: record elsewhere'
            )
        self._raise_error()
        if self._pieces:
            self._queue.put(b''.join(self._pieces))
            self._pieces.clear()

    def close(self) -> None:
        """Wait until everything is written.

        Raises:
            OSError, BagError: as `write`.
        """
        if self.closed:
            return
        try:
            self.flush()
        finally:
            self.abandon()
            self._thread.join()
        self._raise_error()

    def abandon(self) -> None:
        """Take nothing more, and do not wait for what is not written yet."""
        self.closed = True
        self._queue.put(None)

    def _raise_error(self) -> None:
        if self._error is not None and not self._has_failed:
            self._has_failed = True
            self._pieces.clear()
            raise self._error

    def _run(self) -> None:
        try:
            while (data := self._queue.get()) is not None:
                left = memoryview(data)
                while left:
                    left = left[self._file.write(left) :]
                self._done += len(data)
        except OSError as error:
            self._error = error
        finally:
            self._file.close()
