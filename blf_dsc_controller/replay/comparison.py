# SPDX-License-Identifier: Apache-2.0
"""Bit-for-bit comparison of recorded and replayed messages of the controller."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.topic_messages import TopicMessages
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.messages.codecs import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.samples import learning_of
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    LEARNING,
    MONITOR,
    REFERENCE,
    TRACKING_ERROR,
    Topic,
)
from blf_dsc_controller.replay.outputs import Commands, Outputs
from blf_dsc_controller.run import Floats, Series, Stamps


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


class Comparison(NamedTuple):
    """Result of comparing one topic."""

    topic: str  # name in the bag
    values: int  # numbers compared
    recorded: int  # numbers in the bag that a complete replay would give
    difference: Difference | None
    left_out: str = ''  # what was not compared, and why


def compare(
    content: Content, config: ControllerConfig, outputs: Outputs, gappy: Collection[str]
) -> Iterator[Comparison]:
    """Compare each topic of the controller that the bag holds.

    `gappy` are the names of topics with messages that the recorder missed.

    Raises:
        UnreadableMessageError: a message cannot be decoded.
    """
    messages = content.topics.get(COMMANDS)
    if messages is not None:
        names = _names(config.joints, ['effort'])
        is_gappy = messages.name in gappy
        found = _compare_commands(messages, outputs.commands, names, is_gappy=is_gappy)
        yield _of_the_whole_bag(found, messages, content)
    for topic, replayed in _replayed(config, outputs).items():
        messages = content.topics.get(topic)
        if messages is not None:
            recorded = _recorded(messages, is_vector=topic in (LEARNING, MONITOR))
            found = _compare_series(messages.name, outputs.stamp, recorded, replayed)
            yield _of_the_whole_bag(found, messages, content)


def _of_the_whole_bag(found: Comparison, messages: TopicMessages, content: Content) -> Comparison:
    """Return the comparison, counting the outputs of later controllers as recorded too."""
    count = len(messages.raw)
    whole = found.recorded * content.message_counts[messages.name] // count if count else 0
    return found._replace(recorded=whole)


def _replayed(config: ControllerConfig, outputs: Outputs) -> dict[Topic, Series]:
    """Return the replayed values of every topic with a stamp."""
    errors, reference = (_names(config.joints, JOINT_STATE_FIELDS[:count]) for count in (3, 2))
    stamp, samples = outputs.stamp, outputs.samples
    return {
        TRACKING_ERROR: Series(
            errors, stamp, np.hstack((samples.xi1, samples.xi2, samples.torque))
        ),
        REFERENCE: Series(reference, stamp, np.hstack((samples.qr, samples.dqr))),
        LEARNING: learning_of(config, stamp, samples),
        MONITOR: outputs.monitor,
    }


def _recorded(messages: TopicMessages, *, is_vector: bool) -> Series:
    """Return the values of a vector, or the fields of joint states that are not empty."""
    states = messages.joint_states(messages.layout().names, ())
    if is_vector:
        return states.position
    names = _names(states.names, JOINT_STATE_FIELDS)
    all_of_them = Series(names, states.stamp, states.values.reshape(states.stamp.size, -1))
    filled = [name for name in names if not np.isnan(all_of_them.column(name)).all()]
    return Series(tuple(filled), states.stamp, all_of_them.select(filled))


def _names(joints: Sequence[str], fields: Sequence[str]) -> tuple[str, ...]:
    return tuple(f'{field} of {joint}' for field in fields for joint in joints)


def _compare_commands(
    recorded: TopicMessages, commands: Commands, names: Sequence[str], *, is_gappy: bool
) -> Comparison:
    """Compare commands by their number in the run, since they have no stamp."""
    count = len(recorded.raw)
    due = int(np.argmin(np.append(commands.of_law, values=False)))
    if count < due or is_gappy:
        reason = f'{count} commands for {due} states that the law used, and they have no stamp'
        return Comparison(recorded.name, 0, count * len(names), None, reason)
    values = recorded.arrays(len(names))
    if values is None:
        reason = f'they do not have {len(names)} values each'
        return Comparison(recorded.name, 0, count * len(names), None, reason)
    number = commands.number
    # After a dropped state there may be more replayed torques than commands before the next event.
    later = np.append(np.minimum.accumulate(number[::-1])[::-1][1:], count)
    rows = np.flatnonzero((number < later) & (number < count))
    alike = np.all(_alike(values[number[rows]], commands.torque[rows]), axis=1)
    # Where the states in between are not certain, compare up to the first mismatch.
    exact, k = commands.exact[rows], np.arange(rows.size)
    mismatch = np.maximum.accumulate(np.where(exact | alike, -1, k))
    rows = rows[alike | (mismatch <= np.maximum.accumulate(np.where(exact, k, -1)))]
    left_out = ''
    rest = np.delete(values, number[rows], axis=0)
    # The last command of a node that shuts down normally is zero and belongs to no state.
    if len(rest) > 1 or rest.any():
        left_out = (
            f'{len(rest)} torques that the bag does not determine: out of command, after states '
            'that the middleware dropped, or from the watchdog at the end'
        )
    stamp, torque = commands.stamp[rows], commands.torque[rows]
    compared = values[number[rows]]
    found = _compare(recorded.name, stamp, stamp[:1], names, compared, torque, left_out)
    return found._replace(recorded=values.size) if left_out else found


def _compare_series(topic: str, stamp: Stamps, recorded: Series, replayed: Series) -> Comparison:
    """Compare values with the same name in the samples (N,); NaN between two messages."""
    shared = [name for name in replayed.names if name in recorded.names]
    absent = {*replayed.names, *recorded.names}.difference(shared)
    left_out = [name for name in (*replayed.names, *recorded.names) if name in absent]
    known = np.isin(recorded.stamp, stamp)
    sampled = recorded.stamp[known]
    own = Series(tuple(shared), replayed.stamp, replayed.select(shared)).exact(sampled)
    values = recorded.select(shared)[known]
    found = _compare(topic, sampled, stamp[:1], shared, values, own, ', '.join(left_out))
    return found._replace(recorded=known.size * len(shared))


def _compare(
    topic: str,
    stamp: Stamps,
    start: Stamps,
    names: Sequence[str],
    recorded: Floats,
    replayed: Floats,
    left_out: str,
) -> Comparison:
    """Compare tables (N, names) with the stamps (N,), of a run that began at `start` (1,)."""
    difference = None
    for k, j in np.argwhere(~_alike(recorded, replayed))[:1]:
        time = float((stamp[k] - start[0]) * 1e-9)
        pair = float(recorded[k, j]), float(replayed[k, j])
        difference = Difference(topic, names[j], int(stamp[k]), time, *pair)
    return Comparison(topic, recorded.size, recorded.size, difference, left_out)


def _alike(recorded: Floats, replayed: Floats) -> NDArray[np.bool_]:
    """Where the bits are the same, or both are NaN."""
    bits = np.ascontiguousarray(recorded).view(np.int64)
    equal = bits == np.ascontiguousarray(replayed).view(np.int64)
    return np.asarray(equal | (np.isnan(recorded) & np.isnan(replayed)))
