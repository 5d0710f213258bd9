# SPDX-License-Identifier: Apache-2.0
"""Numbers that a replay publishes beside those of the bag, topic by topic."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.topic_messages import JointStates, TopicMessages
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JOINT_STATE_FIELDS
from blf_dsc_controller.replay.rerun import Difference, Rerun
from blf_dsc_controller.run import Floats, Stamps

_BLOCK = 4096  # messages compared at once
_COMPARED = {  # topic: fields
    topics.COMMANDS: (2,),
    topics.TRACKING_ERROR: (0, 1, 2),
    topics.REFERENCE: (0, 1),
    topics.MONITOR: (0,),
    topics.BOUND: (0, 2),
    topics.EXTERNAL_TORQUE: (2,),
}
_BY_STAMP = (topics.REFERENCE, topics.MONITOR, topics.EXTERNAL_TORQUE)


@dataclass
class Comparison:
    """Result of comparing one topic."""

    topic: str  # name in the bag
    recorded: int  # numbers in the bag that a complete replay would give
    values: int = 0  # numbers compared
    difference: Difference | None = None
    # difference of two numbers; infinite if only one of them is finite
    largest: float = 0.0
    left_out: str = ''  # what was not compared, and why
    missing: int = 0  # messages that the replay gives and the bag does not hold

    def add(
        self,
        stamp: Stamps,
        start: int,
        names: Sequence[str],
        recorded: Floats,
        replayed: Floats,
    ) -> None:
        """Compare tables (N, names) of stamps (N,), of a run that began at `start`."""
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
            self.difference = Difference(
                self.topic, names[j], int(stamp[k]), time, *pair
            )


def compared(
    content: Content, run: Rerun, answers: JointStates, joints: Sequence[str]
) -> Iterator[Comparison]:
    """Yield the comparison of each topic in a bag.

    `answers` are those of tracking errors.
    """
    for topic, fields in _COMPARED.items():
        messages = content.topics.get(topic)
        own = run.topics.get(topic)
        if messages is None:
            if own is not None:
                lacking = 'the bag holds none of its messages'
                yield Comparison(topic.resolved, 0, left_out=lacking, missing=own.size)
            continue
        result = Comparison(messages.name, messages.size * len(joints) * len(fields))
        try:
            if own is not None:
                _fill(result, topic, messages, own, answers, joints, run)
        except BlfDscError as error:  # unreadable, or in an unknown order
            result.left_out = f'{error}'
        yield result


def _fill(
    result: Comparison,
    topic: topics.Topic,
    messages: TopicMessages,
    own: TopicMessages,
    answers: JointStates,
    joints: Sequence[str],
    run: Rerun,
) -> None:
    """Compare the messages of the same stamp or number, and add what is found to `result`.

    Those that have other stamps differ.

    Raises:
        BlfDscError: messages are unreadable, or in an unknown order.
    """
    fields = _COMPARED[topic]
    shared, others = _names(messages, own)
    result.left_out = ', '.join(others)
    result.recorded = messages.size * len(shared) * len(fields)
    recorded = answers
    if topic is not topics.TRACKING_ERROR:
        recorded = messages.joint_states(shared, ())
    recorded, replayed, result.missing = _matched(
        topic, recorded, own.joint_states(shared, ()), answers.size, run.answers
    )
    has_moved = recorded.stamp != replayed.stamp
    names = _labels(topic, shared, joints)
    for begin in range(0, replayed.size, _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        theirs = _table(recorded, rows, fields)
        ours = _table(replayed, rows, fields)
        ours[has_moved[rows]] = np.inf
        result.add(replayed.received[rows], run.first, names, theirs, ours)
    if topic is topics.COMMANDS:
        unreached = (result.recorded - result.values) // len(joints)
        if unreached:
            result.left_out = f'{unreached} torques that the replay does not reach'


def _names(messages: TopicMessages, own: TopicMessages) -> tuple[list[str], list[str]]:
    """Return the names that both have, but for the computation time, and all others."""
    theirs, ours = messages.joint_names(), own.joint_names()
    shared = [name for name in ours if name in theirs and name != topics.COMPUTE_TIME]
    others = [name for name in dict.fromkeys((*ours, *theirs)) if name not in shared]
    return shared, others


def _table(states: JointStates, rows: slice, fields: Sequence[int]) -> Floats:
    """Return some rows of fields of messages, beside each other (rows, fields * names)."""
    return np.hstack([states.field(k)[rows] for k in fields])


def _labels(topic: topics.Topic, shared: list[str], joints: Sequence[str]) -> list[str]:
    """Return what the numbers of a message are called, in their order."""
    if topic is topics.MONITOR:
        return shared
    labels = shared if topic is topics.EXTERNAL_TORQUE else joints
    return [
        f'{JOINT_STATE_FIELDS[k]} of {label}'
        for k in _COMPARED[topic]
        for label in labels
    ]


def _matched(
    topic: topics.Topic,
    recorded: JointStates,
    replayed: JointStates,
    answers: int,
    in_order: int,
) -> tuple[JointStates, JointStates, int]:
    """Return the recorded messages and their replays, and how many replays have none.

    They are those of a stamp or number that occurs in both.

    Of the `answers`, only the first `in_order` have a known order.
    """
    if topic in _BY_STAMP:
        recorded = recorded.by_stamp()
        replayed = replayed.by_stamp()
        keys = recorded.stamp
        wanted = replayed.stamp
    else:
        keys = _numbers(topic, recorded, max(answers, replayed.size))
        wanted = replayed.sequence
    index = np.minimum(np.searchsorted(keys, wanted), keys.size - 1)
    is_known = keys[index] == wanted
    if topic is topics.TRACKING_ERROR:
        is_known[in_order:] = False
    known = np.flatnonzero(is_known)
    missing = replayed.size - known.size
    return recorded.select(index[known]), replayed.select(known), missing


def _numbers(topic: topics.Topic, recorded: JointStates, least: int) -> Stamps:
    """Return the numbers of messages among those of their publisher.

    It sent at least so many.  BlfDscError if they are unknown.
    """
    sequence = recorded.sequence
    numbered = topic in (topics.COMMANDS, topics.TRACKING_ERROR) and sequence.any()
    if not numbered:
        if topic is topics.COMMANDS and recorded.size < least:  # of another recorder
            raise BlfDscError(
                'some are missing, and they have neither stamps nor numbers'
            )
        return np.arange(1, recorded.size + 1)
    if (np.diff(sequence) > 0).all():
        return sequence
    if topic is topics.COMMANDS:
        raise BlfDscError('they are of several publishers')
    return np.arange(1, recorded.size + 1)
