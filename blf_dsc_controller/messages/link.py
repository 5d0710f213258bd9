# SPDX-License-Identifier: Apache-2.0
"""Messages between a loop and a process beside it, over a non-blocking socket.

What the other side does not take is kept, up to a limit, and then dropped: message by
message, so that those that arrive are whole.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import subprocess
from collections.abc import Iterator, Mapping
from time import monotonic
from typing import Any

from blf_dsc_controller import child

_HEAD = struct.Struct('<BI')  # kind, and size of the content in bytes
_MOST = 8 << 20  # bytes that wait: some seconds of messages
_PIECE = 1 << 16  # bytes read at once
_POLL = 0.1  # s


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

    def all_messages(self) -> Iterator[tuple[int, bytes]]:
        """Yield what arrives until the other side ends, likewise; not for a loop."""
        while not self.broken:
            self.wait(_POLL)
            yield from self.messages()

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


class LinkedProcess(Link):
    """A process that runs `main` of a module of this package, and this end of a link to it.

    Its first argument is the other end: see `link_of`.

    Attributes:
        process: it.
    """

    def __init__(
        self,
        module: str,
        *arguments: str,
        variables: Mapping[str, str] | None = None,
        **options: Any,
    ) -> None:
        """Start it, with environment variables and options of `subprocess.Popen`."""
        ours, theirs = socket.socketpair()
        with theirs:
            self.process = subprocess.Popen(
                [*child.running_module(module), f'{theirs.fileno()}', *arguments],
                pass_fds=[theirs.fileno()],
                env={**(variables or {}), **os.environ, **child.places()},
                **options,
            )
        super().__init__(ours)

    def await_end(self, patience: float) -> bool:
        """Wait for the end of the process, and kill it after the patience [s].

        Return whether it has ended by itself.
        """
        try:
            self.process.wait(patience)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return False
        return True


def link_of(argument: str, most: int = _MOST) -> Link:
    """Return the link of a `LinkedProcess`, in that process, by its first argument."""
    return Link(socket.socket(fileno=int(argument)), most)
