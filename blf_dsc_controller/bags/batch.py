# SPDX-License-Identifier: Apache-2.0
"""All messages of a topic decoded at once, without a loop where they differ only in numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.content import TopicMessages
from blf_dsc_controller.bags.errors import UnreadableMessageError
from blf_dsc_controller.messages.cdr import (
    NANOSECONDS,
    STAMP_OFFSET,
    ArrayLayout,
    Doubles,
    JointStateLayout,
)
from blf_dsc_controller.messages.decoders import Float64MultiArrayDecoder, JointStateDecoder
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.run import Floats, Stamps

_FEWEST = 8  # messages, below which the loop is as fast

_T = TypeVar('_T')


def decode_joint_states(
    messages: TopicMessages,
    names: Sequence[str],
    required: Sequence[str] = ('position', 'velocity'),
) -> tuple[Stamps, Floats]:
    """Stamps (N,) [ns] and [position, velocity, effort] (N, 3, n) of the n `names`.

    Raises:
        UnreadableMessageError: a message cannot be decoded.
    """
    decoder = JointStateDecoder(names, required)
    next(_decoded(messages, decoder.decode))
    layout = JointStateLayout.parse(messages.raw[0])
    order = layout.byte_order
    extents = [(array.offset, 8 * array.size) for array in layout.arrays]
    table = _table(messages.raw, [(STAMP_OFFSET, 8), *extents])
    if table is not None:
        seconds = _column(table, STAMP_OFFSET, order + 'i4')
        nanoseconds = _column(table, STAMP_OFFSET + 4, order + 'u4')
        columns = [layout.names.index(name) for name in names]
        arrays = [_doubles(table, array, order, columns) for array in layout.arrays]
        return seconds * NANOSECONDS + nanoseconds, np.stack(arrays, axis=1)
    stamp = np.empty(len(messages.raw), dtype=np.int64)
    values = np.empty((len(messages.raw), 3, len(names)))
    for k, stamp_k in enumerate(_decoded(messages, decoder.decode)):
        stamp[k] = stamp_k
        values[k].flat = decoder.values
    return stamp, values


def decode_arrays(messages: TopicMessages, size: int) -> Floats | None:
    """Values (N, size) of Float64MultiArrays, None if one of them has another size.

    Raises:
        UnreadableMessageError: a message cannot be decoded.
    """
    order, data = next(_decoded(messages, ArrayLayout.parse))
    if data.size != size:
        return None
    table = _table(messages.raw, [(data.offset, 8 * size)])
    if table is not None:
        return _doubles(table, data, order, list(range(size)))
    decoder = Float64MultiArrayDecoder(size)
    values = np.empty((len(messages.raw), size))
    for k, got in enumerate(_decoded(messages, decoder.decode)):
        if got != size:
            return None
        values[k] = decoder.data
    return values


def joint_names(messages: TopicMessages) -> tuple[str, ...]:
    """Names in the first of some joint states; UnreadableMessageError if there are none."""
    names = next(_decoded(messages, JointStateLayout.parse)).names
    if not names:
        unnamed = MessageError('it names no joint, so its values cannot be told apart')
        raise UnreadableMessageError(messages.name, 0, unnamed)
    return names


def array_size(messages: TopicMessages) -> int:
    """Number of values in the first of some Float64MultiArrays."""
    return next(_decoded(messages, ArrayLayout.parse)).data.size


def _decoded(messages: TopicMessages, decode: Callable[[bytes], _T]) -> Iterator[_T]:
    for k, raw in enumerate(messages.raw):
        try:
            yield decode(raw)
        except MessageError as error:
            raise UnreadableMessageError(messages.name, k, error) from error


def _table(raw: Sequence[bytes], numbers: Sequence[tuple[int, int]]) -> NDArray[np.uint8] | None:
    """Messages as rows of bytes, None if they differ elsewhere than in `numbers` (offset, size)."""
    if len(raw) < _FEWEST or len(set(map(len, raw))) > 1:
        return None
    table = np.frombuffer(b''.join(raw), np.uint8).reshape(len(raw), -1)
    fixed = np.ones(table.shape[1], dtype=bool)
    for offset, size in numbers:
        fixed[offset : offset + size] = False
    return None if (table[:, fixed] != table[0, fixed]).any() else table


def _column(table: NDArray[np.uint8], offset: int, kind: str) -> NDArray[np.int64]:
    return np.ascontiguousarray(table[:, offset : offset + 4]).view(kind)[:, 0].astype(np.int64)


def _doubles(
    table: NDArray[np.uint8], array: Doubles, byte_order: str, columns: list[int]
) -> Floats:
    if array.size == 0:
        return np.full((table.shape[0], len(columns)), np.nan)
    block = table[:, array.offset : array.offset + 8 * array.size]
    values = np.ascontiguousarray(block).view(byte_order + 'f8')
    return values[:, columns].astype(np.float64)
