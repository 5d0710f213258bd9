# SPDX-License-Identifier: Apache-2.0
"""Compact storage of one topic's messages, which differ in few bytes within a block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

BLOCK = 4096  # messages


class _Block(NamedTuple):
    first: bytes
    places: NDArray[np.intp]  # (k,) of the bytes that differ
    values: NDArray[np.uint8]  # (BLOCK, k)


class PackedMessages(Sequence[bytes]):
    """Append-only list of messages that stores the bytes common to a block once.

    Joint states need a third of the memory, since names and lengths are the same in all of them.
    """

    def __init__(self, messages: Iterable[bytes] = ()) -> None:
        self._blocks: list[_Block | list[bytes]] = []
        self._last: list[bytes] = []
        self._unpacked: tuple[int, list[bytes]] = (-1, [])
        for raw in messages:
            self.append(raw)

    def append(self, raw: bytes) -> None:
        """Append a message."""
        self._last.append(raw)
        if len(self._last) == BLOCK:
            self._blocks.append(_pack(self._last))
            self._last = []

    def __len__(self) -> int:
        return BLOCK * len(self._blocks) + len(self._last)

    @overload
    def __getitem__(self, index: int) -> bytes: ...
    @overload
    def __getitem__(self, index: slice) -> list[bytes]: ...
    def __getitem__(self, index: int | slice) -> bytes | list[bytes]:
        chosen = range(len(self))[index]
        if isinstance(chosen, int):
            return self._block(chosen // BLOCK)[chosen % BLOCK]
        return [self._block(k // BLOCK)[k % BLOCK] for k in chosen]

    def __iter__(self) -> Iterator[bytes]:
        for number in range(len(self._blocks) + 1):
            yield from self._block(number)

    def _block(self, number: int) -> list[bytes]:
        if number == len(self._blocks):
            return self._last
        if number != self._unpacked[0]:
            self._unpacked = (number, _unpack(self._blocks[number]))
        return self._unpacked[1]


def _pack(messages: list[bytes]) -> _Block | list[bytes]:
    size = len(messages[0])
    if any(len(raw) != size for raw in messages):
        return messages
    table = np.frombuffer(b''.join(messages), np.uint8).reshape(-1, size)
    places = np.flatnonzero((table != table[0]).any(axis=0))
    return _Block(messages[0], places, table[:, places])


def _unpack(block: _Block | list[bytes]) -> list[bytes]:
    if isinstance(block, list):
        return block
    size = len(block.first)
    table = np.tile(np.frombuffer(block.first, np.uint8), (BLOCK, 1))
    table[:, block.places] = block.values
    joined = table.tobytes()
    return [joined[at : at + size] for at in range(0, len(joined), size)]
