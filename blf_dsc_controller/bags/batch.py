# SPDX-License-Identifier: Apache-2.0
"""All messages of a topic decoded at once, without a loop where they differ only in numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from blf_dsc_controller.bags.content import TopicMessages
from blf_dsc_controller.bags.errors import UnreadableMessageError
from blf_dsc_controller.messages.cdr import MessageError, array_layout, joint_state_layout
from blf_dsc_controller.messages.codecs import Float64MultiArrayDecoder, JointStateDecoder
from blf_dsc_controller.run import Floats, Stamps

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
    shape = len(messages.raw), 3, len(names)
    at_once = decoder.decode_all(messages.raw)
    if at_once is not None:
        return at_once[0], at_once[1].reshape(shape)
    stamp, values = np.empty(shape[0], dtype=np.int64), np.empty(shape)
    for k, stamp_k in enumerate(_decoded(messages, decoder.decode)):
        stamp[k] = stamp_k
        values[k].flat = decoder.values
    return stamp, values


def decode_arrays(messages: TopicMessages, size: int) -> Floats | None:
    """Values (N, size) of Float64MultiArrays, None if one of them has another size.

    Raises:
        UnreadableMessageError: a message cannot be decoded.
    """
    decoder = Float64MultiArrayDecoder(size)
    if next(_decoded(messages, decoder.decode)) != size:
        return None
    at_once = decoder.decode_all(messages.raw)
    if at_once is not None:
        return at_once
    values = np.empty((len(messages.raw), size))
    for k, got in enumerate(_decoded(messages, decoder.decode)):
        if got != size:
            return None
        values[k] = decoder.values
    return values


def joint_names(messages: TopicMessages) -> tuple[str, ...]:
    """Names in the first of some joint states; UnreadableMessageError if there are none."""
    names = next(_decoded(messages, joint_state_layout)).names
    if not names:
        unnamed = MessageError('it names no joint, so its values cannot be told apart')
        raise UnreadableMessageError(messages.name, 0, unnamed)
    return names


def array_size(messages: TopicMessages) -> int:
    """Number of values in the first of some Float64MultiArrays."""
    return next(_decoded(messages, array_layout)).arrays[0].size


def _decoded(messages: TopicMessages, decode: Callable[[bytes], _T]) -> Iterator[_T]:
    for k, raw in enumerate(messages.raw):
        try:
            yield decode(raw)
        except MessageError as error:
            raise UnreadableMessageError(messages.name, k, error) from error
