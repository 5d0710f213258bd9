# SPDX-License-Identifier: Apache-2.0
"""All messages of a topic at once: where they differ in stamp and numbers alone, without a loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.content import Recorded
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

_STAMP_SIZE = 8
_FEWEST = 8  # messages, below which the loop is as good


def decode_joint_states(
    recorded: Recorded,
    names: Sequence[str],
    required: Sequence[str] = ('position', 'velocity'),
) -> tuple[Stamps, Floats]:
    """Stamps (N,) [ns] and [position, velocity, effort] (N, 3, n) of the n `names`, as recorded.

    Raises:
        UnreadableMessageError: a message cannot be decoded; it tells which and why.
    """
    decoder = JointStateDecoder(names, required)
    stamp = np.empty(len(recorded.raw), dtype=np.int64)
    values = np.empty((len(recorded.raw), 3 * len(names)))
    alike = _alike(recorded, names, required)
    if alike is not None:
        return alike
    for k, raw in enumerate(recorded.raw):
        try:
            stamp[k] = decoder.decode(raw)
        except MessageError as error:
            raise UnreadableMessageError(recorded.name, k, error) from error
        values[k] = decoder.values
    return stamp, values.reshape(len(recorded.raw), 3, len(names))


def decode_arrays(recorded: Recorded, size: int) -> Floats | None:
    """Values (N, size) of Float64MultiArrays, None if one of them is of another size.

    Raises:
        UnreadableMessageError: a message cannot be decoded; it tells which and why.
    """
    alike = _alike_arrays(recorded, size)
    if alike is not None:
        return alike
    decoder = Float64MultiArrayDecoder(size)
    values = np.empty((len(recorded.raw), size))
    for k, raw in enumerate(recorded.raw):
        try:
            if decoder.decode(raw) != size:
                return None
        except MessageError as error:
            raise UnreadableMessageError(recorded.name, k, error) from error
        values[k] = decoder.data
    return values


def array_size(recorded: Recorded) -> int:
    """Number of values in the first message of Float64MultiArrays.

    Raises:
        UnreadableMessageError: it cannot be decoded.
    """
    try:
        return ArrayLayout.parse(recorded.raw[0]).data.size
    except MessageError as error:
        raise UnreadableMessageError(recorded.name, 0, error) from error


def _alike(
    recorded: Recorded, names: Sequence[str], required: Sequence[str]
) -> tuple[Stamps, Floats] | None:
    """Decode messages that are alike but for their numbers; None if they are not."""
    first, count = recorded.raw[0], len(recorded.raw)
    if count < _FEWEST or len(set(map(len, recorded.raw))) > 1:
        return None
    try:
        layout = JointStateLayout.parse(first)
        JointStateDecoder(names, required).decode(first)
    except MessageError:
        return None
    table = np.frombuffer(b''.join(recorded.raw), np.uint8).reshape(count, -1)
    fixed = np.ones(len(first), dtype=bool)
    fixed[STAMP_OFFSET : STAMP_OFFSET + _STAMP_SIZE] = False
    for doubles in layout.arrays:
        fixed[doubles.offset : doubles.offset + 8 * doubles.size] = False
    if (table[:, fixed] != table[0, fixed]).any():
        return None
    order = layout.byte_order
    seconds = _column(table, STAMP_OFFSET, order + 'i4').astype(np.int64)
    nanoseconds = _column(table, STAMP_OFFSET + 4, order + 'u4')
    columns = [layout.names.index(name) for name in names]
    values = np.stack([_doubles(table, one, order, columns) for one in layout.arrays], axis=1)
    return seconds * NANOSECONDS + nanoseconds, values


def _alike_arrays(recorded: Recorded, size: int) -> Floats | None:
    """Decode arrays that are alike but for their numbers; None if they are not."""
    first, count = recorded.raw[0], len(recorded.raw)
    if count < _FEWEST or len(set(map(len, recorded.raw))) > 1:
        return None
    try:
        layout = ArrayLayout.parse(first)
    except MessageError:
        return None
    if layout.data.size != size or size == 0:
        return None
    table = np.frombuffer(b''.join(recorded.raw), np.uint8).reshape(count, -1)
    if (table[:, : layout.data.offset] != table[0, : layout.data.offset]).any():
        return None
    return _doubles(table, layout.data, layout.byte_order, list(range(size)))


def _column(table: NDArray[np.uint8], at: int, kind: str) -> NDArray[np.int64]:
    return np.ascontiguousarray(table[:, at : at + 4]).view(kind)[:, 0].astype(np.int64)


def _doubles(
    table: NDArray[np.uint8], doubles: Doubles, byte_order: str, columns: list[int]
) -> Floats:
    if doubles.size == 0:
        return np.full((table.shape[0], len(columns)), np.nan)
    block = table[:, doubles.offset : doubles.offset + 8 * doubles.size]
    values = np.ascontiguousarray(block).view(byte_order + 'f8')
    return values[:, columns].astype(np.float64)
