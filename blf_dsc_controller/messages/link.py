# SPDX-License-Identifier: Apache-2.0
"""Messages between a loop and a process beside it, over a non-blocking socket.

What the other side does not take is kept, up to a limit, and then dropped: message by
message, so that those that arrive are whole.
"""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Iterator
from time import monotonic

_HEAD = struct.Struct('<BI')  # kind, and size of the content in bytes
_MOST = 8 << 20  # bytes that wait: some seconds of messages
_PIECE = 1 << 16  # bytes read at once


class Link:
    """One end of a connection; a message has a kind (0 to 255) and a content.

    Attributes:
        lost: messages that were dropped, since the other side did not take them.
        broken: whether the other side has ended.
    """

    def __init__(self, end: socket.socket, most: int = _MOST) -> None:
        """Take over a connected stream socket, with at most `most` waiting bytes."""
        end.settimeout(0.0)
        self.lost = 0
        self.broken = False
        self._end = end
        self._most = most
        self._out = bytearray()
        self._in = bytearray()

    def put(self, kind: int, content: bytes) -> None:
        """Send a message with the next `flush`, or drop it."""
        if self.broken:
            return
        if len(self._out) + len(content) > self._most:
            self.lost += 1
            return
        self._out += _HEAD.pack(kind, len(content))
        self._out += content

    def flush(self) -> bool:
        """Send what the other side accepts now; return whether nothing waits."""
        while self._out and not self.broken:
            try:
                sent = self._end.send(self._out)
            except BlockingIOError:
                return False
            except OSError:
                self.broken = True
                break
            del self._out[:sent]
        return True

    def messages(self) -> Iterator[tuple[int, bytes]]:
        """Yield the kind and the content of what has arrived."""
        self._receive()
        while len(self._in) >= _HEAD.size:
            kind, size = _HEAD.unpack_from(self._in)
            end = _HEAD.size + size
            if len(self._in) < end:
                return
            content = bytes(self._in[_HEAD.size : end])
            del self._in[:end]
            yield kind, content

    def wait(self, seconds: float) -> None:
        """Wait until something arrives, for this time at most; not for a loop."""
        if not self.broken:
            select.select([self._end], [], [], seconds)

    def drain(self, patience: float) -> None:
        """Wait until all is sent, for this time [s] at most; not for a loop."""
        end = monotonic() + patience
        while not self.flush() and (left := end - monotonic()) > 0.0:
            select.select([], [self._end], [], left)

    def close(self, patience: float = 0.0) -> None:
        """End the connection after all is sent, or after the patience [s]."""
        self.drain(patience)
        self._end.close()

    def _receive(self) -> None:
        while not self.broken:
            try:
                piece = self._end.recv(_PIECE)
            except BlockingIOError:
                return
            except OSError:
                piece = b''
            self._in += piece
            self.broken = not piece
