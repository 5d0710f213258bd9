# SPDX-License-Identifier: Apache-2.0
"""Messages of one topic of a bag, decoded in bulk where they differ only in numbers."""

from __future__ import annotations

from array import array
from collections.abc import MutableSequence, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.packed_messages import BLOCK, PackedMessages
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.messages.cdr import (
    Layout,
    MessageError,
    MissingJointError,
    array_layout,
    joint_state_layout,
)
from blf_dsc_controller.messages.codecs import Decoder, Float64MultiArrayDecoder, JointStateDecoder
from blf_dsc_controller.messages.topics import FLOAT64_MULTI_ARRAY
from blf_dsc_controller.run import Floats, Series, Stamps


class UnreadableMessageError(BagError):
    """A message of a bag that cannot be decoded."""

    def __init__(self, topic: str, index: int, error: MessageError) -> None:
        reason = str(error)
        if isinstance(error, MissingJointError):
            reason = (
                f'{error.fact}: the bag is from another robot, or its joints have other names: '
                f'--map {error.joint}=ITS_NAME'
            )
        super().__init__(f'message {index + 1} of {topic} cannot be read: {reason}')


class JointStates(NamedTuple):
    """N states of n joints, or N vectors of n named values in `position`."""

    names: tuple[str, ...]
    stamp: Stamps  # (N,) ns
    received: Stamps  # (N,) ns
    values: Floats  # (N, 3, n) position, velocity, effort; NaN where empty

    def select(self, rows: NDArray[np.generic]) -> JointStates:
        """Return the states of these rows."""
        return JointStates(self.names, self.stamp[rows], self.received[rows], self.values[rows])

    def by_stamp(self) -> JointStates:
        """Return the states ordered by stamp, one per stamp."""
        if (self.stamp[1:] > self.stamp[:-1]).all():
            return self
        return self.select(np.unique(self.stamp, return_index=True)[1])

    @property
    def position(self) -> Series:
        """Positions, or named values."""
        return Series(self.names, self.stamp, self.values[:, 0])

    @property
    def velocity(self) -> Series:
        """Velocities."""
        return Series(self.names, self.stamp, self.values[:, 1])

    @property
    def effort(self) -> Series:
        """Efforts."""
        return Series(self.names, self.stamp, self.values[:, 2])


@dataclass
class TopicMessages:
    """All messages of one topic, undecoded, in order of reception."""

    name: str
    type: str = ''
    received: MutableSequence[int] = field(default_factory=lambda: array('q'))  # ns
    raw: PackedMessages | list[bytes] = field(default_factory=PackedMessages)

    def joint_states(
        self,
        names: Sequence[str],
        required: Sequence[str] = ('position', 'velocity'),
        errors: dict[int, MessageError] | None = None,
    ) -> JointStates:
        """Decode sensor_msgs/JointState.

        Messages that cannot be decoded are added to `errors` by index; their values are zero.

        Raises:
            UnreadableMessageError: a message cannot be decoded and `errors` is None.
        """
        stamp, values = self._decode(JointStateDecoder(names, required), errors)
        received = np.array(self.received, dtype=np.int64)
        return JointStates(tuple(names), stamp, received, values.reshape(stamp.size, 3, len(names)))

    def vectors(self) -> Series:
        """Decode named values, sent as positions of sensor_msgs/JointState, ordered by stamp.

        Raises:
            UnreadableMessageError: a message cannot be decoded.
        """
        names = self.joint_names()
        stamp, values = self._decode(JointStateDecoder(names, ('position',)), size=len(names))
        received = np.array(self.received, dtype=np.int64)
        return JointStates(names, stamp, received, values[:, np.newaxis]).by_stamp().position

    def arrays(self, size: int) -> Floats | None:
        """Decode Float64MultiArrays as values (N, size); None if one of them has another size.

        Raises:
            UnreadableMessageError: a message cannot be decoded.
        """
        sizes, values = self._decode(Float64MultiArrayDecoder(size))
        return values if (sizes == size).all() else None

    def layout(self) -> Layout:
        """Return the layout of the first message; UnreadableMessageError if it has none."""
        find = array_layout if self.type == FLOAT64_MULTI_ARRAY else joint_state_layout
        try:
            return find(self.raw[0])
        except MessageError as error:
            raise UnreadableMessageError(self.name, 0, error) from error

    def of_joints(self, joints: Sequence[str]) -> TopicMessages:
        """Return the messages without those of only other joints, which the controller ignores.

        All are returned if none would be left.

        Raises:
            BagError: all have the same stamp.
        """
        errors: dict[int, MessageError] = {}
        stamp, _ = self._decode(JointStateDecoder(joints, ()), errors)
        foreign = {
            k
            for k, error in errors.items()
            if isinstance(error, MissingJointError) and error.is_foreign(joints)
        }
        stamps = np.delete(stamp, list(errors))
        if stamps.size > 1 and (stamps == stamps[0]).all():
            raise BagError(
                f'all {stamps.size} messages of {self.name} have the stamp {stamps[0]} ns: each '
                'needs a unique stamp, so the driver has to set header.stamp'
            )
        kept = [k for k in range(stamp.size) if k not in foreign]
        if len(kept) in (0, stamp.size):
            return self
        received, raw = [self.received[k] for k in kept], [self.raw[k] for k in kept]
        return replace(self, received=received, raw=raw)

    def name_lists(self) -> list[tuple[str, ...]]:
        """Return the different lists of names in the messages; those that are cut off are skipped.

        Only one of the messages that begin alike is decoded.

        Raises:
            UnreadableMessageError: the first message cannot be decoded.
        """
        first = self.layout()
        begin = slice(first.begin, first.arrays[0].size_offset)
        found: dict[tuple[bytes, bytes], tuple[str, ...]] = {}
        for raw in self.raw:
            beginning = raw[:2], raw[begin]
            if beginning not in found:
                with suppress(MessageError):
                    found[beginning] = joint_state_layout(raw).names
        return list(found.values())

    def joint_names(self) -> tuple[str, ...]:
        """Return the longest list of names in a message; UnreadableMessageError if it is empty."""
        names = max(self.name_lists(), key=len)
        if not names:
            unnamed = MessageError('it names no joint, so its values cannot be assigned to joints')
            raise UnreadableMessageError(self.name, 0, unnamed)
        return names

    def _decode(
        self,
        decoder: Decoder,
        errors: dict[int, MessageError] | None = None,
        size: int | None = None,
    ) -> tuple[NDArray[np.int64], Floats]:
        """Return the result of `decoder` per message, and all or the first `size` of its values."""
        count = len(self.raw)
        returned = np.zeros(count, dtype=np.int64)
        values = np.zeros((count, decoder.values[:size].size))
        for begin in range(0, count, BLOCK):
            rows = slice(begin, begin + BLOCK)
            block = self.raw[rows]
            with suppress(MessageError):
                at_once = decoder.decode_all(block)
                if at_once is not None:
                    returned[rows], values[rows] = at_once[0], at_once[1][:, :size]
                    continue
            for k, raw in enumerate(block, begin):
                try:
                    returned[k] = decoder.decode(raw)
                    values[k] = decoder.values[:size]
                except MessageError as error:
                    if errors is None:
                        raise UnreadableMessageError(self.name, k, error) from error
                    errors[k] = error
        return returned, values
