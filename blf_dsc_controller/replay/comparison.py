# SPDX-License-Identifier: Apache-2.0
"""Bit-for-bit comparison of the messages of a replayed controller with those in a bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.sources import BagMessage
from blf_dsc_controller.bags.topic_messages import (
    JointStates,
    TopicMessages,
    UnreadableMessageError,
)
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.law.telemetry import DECIMATION, ControllerTelemetry, Message, Monitor
from blf_dsc_controller.messages.codecs import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.topics import (
    BOUND,
    COMMANDS,
    COMPUTE_TIME,
    FLOAT64_MULTI_ARRAY,
    LEARNING,
    MONITOR,
    REFERENCE,
    TRACKING_ERROR,
    Topic,
)
from blf_dsc_controller.run import Floats, Stamps
from blf_dsc_controller.supervision.guard import Guard

_BLOCK = 4096  # messages compared at once
_COMPARED = {  # by their order, number or stamp; fields
    COMMANDS: (2,),
    TRACKING_ERROR: (0, 1, 2),
    REFERENCE: (0, 1),
    LEARNING: (0,),
    MONITOR: (0,),
    BOUND: (0, 2),
}


class Difference(NamedTuple):
    """The first number of a topic that differs."""

    topic: str
    field: str
    stamp: int  # ns
    time: float  # s since the first state
    recorded: float
    replayed: float

    def __str__(self) -> str:
        return (
            f'{self.time:.6f} s (stamp {self.stamp} ns), {self.topic}, {self.field}: '
            f'recorded {self.recorded!r}, replayed {self.replayed!r}'
        )


@dataclass
class Comparison:
    """Result of comparing one topic."""

    topic: str  # name in the bag
    recorded: int  # numbers in the bag that a complete replay would give
    values: int = 0  # numbers compared
    difference: Difference | None = None
    largest: float = 0.0  # difference of two numbers; infinite if only one of them is finite
    left_out: str = ''  # what was not compared, and why

    def add(
        self, stamp: Stamps, start: int, names: Sequence[str], recorded: Floats, replayed: Floats
    ) -> None:
        """Compare tables (N, names) with the stamps (N,) of a run that began at `start`."""
        self.values += recorded.size
        bits = np.ascontiguousarray(recorded).view(np.int64)
        unlike = bits != np.ascontiguousarray(replayed).view(np.int64)
        unlike &= ~(np.isnan(recorded) & np.isnan(replayed))
        if not unlike.any():
            return
        with np.errstate(invalid='ignore', over='ignore'):
            sizes = np.abs(recorded[unlike] - replayed[unlike])
        self.largest = max(self.largest, float(np.nan_to_num(sizes, nan=np.inf).max()))
        if self.difference is None:
            k, j = np.argwhere(unlike)[0]
            pair = float(recorded[k, j]), float(replayed[k, j])
            time = (int(stamp[k]) - start) * 1e-9
            self.difference = Difference(self.topic, names[j], int(stamp[k]), time, *pair)


class ReplayedMessages:
    """What a guard's node would have published.

    Attributes:
        count, safe_torques: number of samples of the law, and of torques that are not the law's.
        first, last: stamps [ns] of its first and last sample; -1 before the first.
        topics: messages of each topic, received at the stamp of their state.
    """

    def __init__(self, guard: Guard) -> None:
        self._guard, self._joints = guard, guard.config.joints
        self._estimates = estimate_names(guard.config)
        self._telemetry = ControllerTelemetry(self._joints, self._estimates, 1)
        self.count = self.safe_torques = 0
        self.first = self.last = -1
        self._bound = b''
        self._sent: Counter[Topic] = Counter()
        self.topics = {topic: TopicMessages(topic.resolved, topic.type) for topic in _COMPARED}

    def _add(self, stamp: int, message: Message, number: int = 0) -> None:
        topic, raw = message
        self._sent[topic] += 1
        added = BagMessage(topic.resolved, stamp, raw, number or self._sent[topic])
        self.topics[topic].add(added)

    def add_sample(self, stamp: int) -> None:
        """Add the last sample of the law, for the state with this stamp [ns]."""
        guard, controller = self._guard, self._guard.controller
        sample = controller.sample
        if self.first < 0:
            self.first = stamp
        self.last, self.count = stamp, self.count + 1
        if controller.samples == 1:
            self._monitor = Monitor(self._joints, self._estimates, controller.settings)
            self._bound = b''
        if sample.bound.tobytes() != self._bound:
            self.add_bound(stamp, sample.bound)
        for message in self._telemetry.sample(stamp, sample, 0.0):
            self._add(stamp, message)
        if (controller.samples - 1) % DECIMATION == 0:
            ratio = guard.samples.ratio
            self._add(stamp, self._monitor.message(stamp, sample, ratio, sample.bound))

    def add_bound(self, stamp: int, bound: Floats) -> None:
        """Add a bound [rad], published with this stamp [ns]."""
        self._bound = bound.tobytes()
        limit = self._guard.controller.settings.torque_limit
        self._add(stamp, self._telemetry.bound(stamp, bound, limit))

    def add_command(self, stamp: int, torque: Floats, *, is_answer: bool, is_certain: bool) -> None:
        """Add a commanded torque (n,) [N m] after a state with this stamp [ns].

        `is_answer`: it answers a message. One that is not certain is not compared.
        """
        guard = self._guard
        self.safe_torques += not guard.has_sample
        if is_answer and not guard.has_sample:
            self._sent[TRACKING_ERROR] += not is_certain
            if is_certain:
                self._add(stamp, self._telemetry.answer(stamp, torque))
        if is_certain:
            self._add(stamp, self._telemetry.command(torque), guard.journal.commands)

    @property
    def duration(self) -> float:
        """Time from the first sample of the law to the last [s]."""
        return (self.last - self.first) * 1e-9

    def compare(self, content: Content, answers: JointStates) -> Iterator[Comparison]:
        """Yield the comparison with each topic in a bag; `answers` are those of tracking errors."""
        for topic, fields in _COMPARED.items():
            messages = content.topics.get(topic)
            self.topics[topic].decode()
            if messages is not None and topic in (LEARNING, MONITOR):
                yield self._compare_vectors(messages, self.topics[topic])
            elif messages is not None:
                result = Comparison(messages.name, messages.size * len(self._joints) * len(fields))
                try:
                    self._compare_joints(topic, messages, answers, result)
                except UnreadableMessageError as error:
                    result.left_out = f'{error}'
                yield result

    def _compare_vectors(self, messages: TopicMessages, own: TopicMessages) -> Comparison:
        """Compare values of the same name and stamp."""
        recorded = messages.vectors().by_stamp()
        replayed = own.vectors().by_stamp() if own.size else recorded.select(slice(0))
        shared = [name for name in replayed.names if name in recorded.names]
        shared = [name for name in shared if name != COMPUTE_TIME]
        result = Comparison(messages.name, recorded.size * len(shared))
        both = dict.fromkeys((*replayed.names, *recorded.names))
        result.left_out = ', '.join(name for name in both if name not in shared)
        pair = recorded.of(shared), replayed.of(shared)
        self._compare(result, shared, *pair, (0,), (recorded.stamp, replayed.stamp))
        return result

    def _compare_joints(
        self, topic: Topic, messages: TopicMessages, answers: JointStates, result: Comparison
    ) -> None:
        """Compare values of the same joints: by stamp, by sequence, or by order."""
        fields, joints = _COMPARED[topic], self._joints
        recorded = answers if topic is TRACKING_ERROR else _of_joints(messages, joints)
        if not self.topics[topic].size:
            return
        replayed = _of_joints(self.topics[topic], joints)
        keys = np.arange(1, recorded.size + 1), replayed.sequence
        if topic is REFERENCE:
            recorded, replayed = recorded.by_stamp(), replayed.by_stamp()
            keys = recorded.stamp, replayed.stamp
        elif topic is COMMANDS and recorded.sequence.any():
            keys = recorded.sequence, replayed.sequence
            if (np.diff(keys[0]) <= 0).any():
                result.left_out = 'they are of several publishers'
                return
        elif topic is COMMANDS and recorded.size < answers.size:  # of another recorder
            result.left_out = 'some are missing, and they have neither stamps nor numbers'
            return
        names = [f'{JOINT_STATE_FIELDS[k]} of {joint}' for k in fields for joint in joints]
        self._compare(result, names, recorded, replayed, fields, keys)
        unreached = (result.recorded - result.values) // len(joints)
        if topic is COMMANDS and unreached:
            # The last command of a node that shuts down normally is zero and belongs to no state.
            if unreached == 1 and not recorded.field(2, slice(-1, None)).any():
                result.recorded -= len(joints)
            else:
                result.left_out = f'{unreached} torques that the replay does not reach'

    def _compare(
        self,
        result: Comparison,
        names: Sequence[str],
        recorded: JointStates,
        replayed: JointStates,
        fields: Sequence[int],
        keys: tuple[Stamps, Stamps],
    ) -> None:
        """Compare the messages with the same key; those with different stamps differ."""
        index = np.minimum(np.searchsorted(*keys), keys[0].size - 1)
        known = np.flatnonzero(keys[0][index] == keys[1])
        recorded, replayed = recorded.select(index[known]), replayed.select(known)
        stamp, has_moved = replayed.received, recorded.stamp != replayed.stamp
        for begin in range(0, known.size, _BLOCK):
            rows = slice(begin, begin + _BLOCK)
            theirs, own = (
                np.hstack([states.field(k, rows) for k in fields])
                for states in (recorded, replayed)
            )
            own[has_moved[rows]] = np.inf
            result.add(stamp[rows], self.first, names, theirs, own)


def _of_joints(messages: TopicMessages, joints: Sequence[str]) -> JointStates:
    if messages.type == FLOAT64_MULTI_ARRAY:
        return messages.arrays(range(len(joints)))
    return messages.joint_states(joints, ())
