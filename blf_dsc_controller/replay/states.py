# SPDX-License-Identifier: Apache-2.0
"""The joint states of a bag that the controller answered, as it took them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from blf_dsc_controller.bags.batch import decode_joint_states
from blf_dsc_controller.bags.content import Content, TopicMessages
from blf_dsc_controller.bags.errors import UnreadableMessageError
from blf_dsc_controller.messages.decoders import JointStateDecoder
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.topics import JOINT_STATES, LEARNING, REFERENCE, TRACKING_ERROR
from blf_dsc_controller.run import Floats, Stamps

_TOLD_OF_EACH = (TRACKING_ERROR, REFERENCE, LEARNING)


@dataclass(frozen=True)
class States:
    """N answered states of n joints.

    Attributes:
        stamp: (N,) [ns], increasing.
        measurement: [q (n,) rad, dq (n,) rad/s, torque of the last interval (n,) N m] (N, 3 n).
        passed_over: states that were not answered: repeated, or overtaken by the next.
        lost: stamp [ns] of the first state that was answered but is not in the bag; the law's
            state cannot be told from there on, and the states end before it.
    """

    stamp: Stamps
    measurement: Floats
    passed_over: int = 0
    lost: int | None = None

    def until(self, stamp: int) -> States:
        """The states before a stamp [ns]."""
        kept = self.stamp < stamp
        return replace(self, stamp=self.stamp[kept], measurement=self.measurement[kept])

    @property
    def time(self) -> Floats:
        """Time since the first state (N,) [s], as the controller counts it."""
        return np.asarray((self.stamp - self.stamp[0]) * 1e-9)

    @property
    def duration(self) -> float:
        """Time from the first state to the last [s]."""
        return float(self.time[-1]) if self.stamp.size else 0.0


def answered_states(
    content: Content, joints: Sequence[str], required: Sequence[str] = ('position', 'velocity')
) -> States:
    """Take the answered states from a bag; all of them, if its telemetry does not tell which.

    Args:
        content: of the bag.
        joints: the n names that they have in the bag.
        required: fields that the controller asks for.

    Raises:
        UnreadableMessageError: a state cannot be decoded, or a joint is not in it.
    """
    stamp, values = decode_joint_states(content.topics[JOINT_STATES], joints, required)
    increasing = stamp > np.maximum.accumulate(np.concatenate([[-1], stamp[:-1]]))
    told = told_stamps(content)
    kept = increasing if told is None else increasing & np.isin(stamp, told)
    lost = None
    if told is not None:
        absent = np.setdiff1d(told, stamp)
        lost = int(absent[0]) if absent.size else None
    if lost is not None:
        kept &= stamp < lost
    passed_over = int(np.count_nonzero(~kept)) if lost is None else 0
    return States(stamp[kept], values[kept].reshape(-1, 3 * len(joints)), passed_over, lost)


def told_stamps(content: Content) -> Stamps | None:
    """Stamps of the states that the controller tells of; one topic may have what another lost."""
    told = [
        decode_joint_states(content.topics[topic], (), ())[0]
        for topic in _TOLD_OF_EACH
        if topic in content.topics
    ]
    return np.unique(np.concatenate(told)) if told else None


@dataclass(frozen=True)
class Arrivals:
    """Every joint state of a bag as it came, also those that nobody can use.

    Attributes:
        stamp: of each [ns]; 0 where the message cannot be read.
        measurement: (N, 3 n) as in `States`.
        errors: why a message cannot be read, by its number.
        received: when the recorder got each [ns].
    """

    stamp: list[int]
    measurement: Floats
    errors: Mapping[int, MessageError]
    received: list[int]


def arrivals(
    content: Content, joints: Sequence[str], required: Sequence[str], until: int
) -> Arrivals:
    """Take the joint states that the recorder received before `until` [ns].

    Raises:
        UnreadableMessageError: not one of them can be read.
    """
    recorded = content.topics[JOINT_STATES]
    count = bisect_left(recorded.received, until)
    taken = replace(recorded, received=recorded.received[:count], raw=recorded.raw[:count])
    try:
        stamp, values = decode_joint_states(taken, joints, required)
    except UnreadableMessageError:
        return _one_by_one(taken, joints, required)
    return Arrivals(stamp.tolist(), values.reshape(count, -1), {}, taken.received)


def _one_by_one(
    recorded: TopicMessages, joints: Sequence[str], required: Sequence[str]
) -> Arrivals:
    decoder = JointStateDecoder(joints, required)
    stamp = [0] * len(recorded.raw)
    measurement = np.zeros((len(recorded.raw), 3 * len(joints)))
    errors: dict[int, MessageError] = {}
    for k, raw in enumerate(recorded.raw):
        try:
            stamp[k] = decoder.decode(raw)
            measurement[k] = decoder.values
        except MessageError as error:
            errors[k] = error
    if len(errors) == len(recorded.raw):
        raise UnreadableMessageError(recorded.name, 0, errors[0])
    return Arrivals(stamp, measurement, errors, recorded.received)
