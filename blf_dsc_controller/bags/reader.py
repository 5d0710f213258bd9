# SPDX-License-Identifier: Apache-2.0
"""A bag as one run: decoded, joints matched by name, samples matched by their stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blf_dsc_controller.bags.batch import decode_arrays, decode_joint_states
from blf_dsc_controller.bags.content import Content, Recorded, read_content
from blf_dsc_controller.bags.errors import UnreadableMessageError
from blf_dsc_controller.bags.rejected_columns import refused
from blf_dsc_controller.messages.cdr import JointStateLayout
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.topics import (
    BOUND,
    COMMANDS,
    JOINT_STATES,
    LEARNING,
    MONITOR,
    REFERENCE,
    TIMING,
    TRACKING_ERROR,
    TRUTH,
    Topic,
)
from blf_dsc_controller.run import Floats, Run, Series, Stamps


def read_run(path: str | Path, namespace: str = '') -> Run:
    """Read a bag.

    The k-th command answers the k-th joint state if there are as many; otherwise the torque is
    that of the tracking error, or else the effort of the next joint state.

    Args:
        path: folder of the bag, or one of its storage files.
        namespace: of the robot to look at, if the bag holds several.

    Raises:
        UnreadableBagError: there is no bag, or it is damaged.
        UnreadableMessageError: a message in it cannot be decoded.
        MissingTopicError: it holds no joint states.
        AmbiguousTopicError: it holds the topics of several robots.
    """
    content = read_content(Path(path), namespace)
    joints = _joints(content)
    states = _decode(content.topics[JOINT_STATES], joints)
    errors = _optional(content, TRACKING_ERROR, joints)
    references = _optional(content, REFERENCE, joints)
    bounds = _optional(content, BOUND, joints)
    learning = _vector(content, LEARNING)
    reference = None if references is None else references.position.exact(states.stamp)
    error = None if errors is None else errors.position.exact(states.stamp)
    if error is None and reference is not None:
        error = states.position.values - reference
    return Run(
        joints=joints,
        stamp=states.stamp,
        received=states.received,
        position=states.position.values,
        velocity=states.values[:, 1],
        torque=_torque(content, states, errors),
        reference=reference,
        error=error,
        bound=None if bounds is None else bounds.position.held(states.stamp),
        torque_limit=None if bounds is None else bounds.effort.held(states.stamp),
        learning=learning,
        truth=_vector(content, TRUTH),
        timing=_vector(content, TIMING),
        monitor=_vector(content, MONITOR),
        message_counts=content.message_counts,
        refused=refused(Path(path), learning, namespace),
    )


@dataclass(frozen=True)
class _Decoded:
    """All messages of one topic, ordered by stamp, one of each stamp."""

    names: tuple[str, ...]
    stamp: Stamps  # (m,) ns
    received: Stamps  # (m,) ns
    values: Floats  # (m, 3, n)

    @property
    def position(self) -> Series:
        return Series(self.names, self.stamp, self.values[:, 0])

    @property
    def effort(self) -> Series:
        return Series(self.names, self.stamp, self.values[:, 2])


def _joints(content: Content) -> tuple[str, ...]:
    """Joints that the controller controls, in its order; all that move if it is not there."""
    for topic in (TRACKING_ERROR, REFERENCE, BOUND, JOINT_STATES):
        if topic in content.topics:
            return _names(content.topics[topic])
    raise AssertionError


def _names(recorded: Recorded) -> tuple[str, ...]:
    try:
        names = JointStateLayout.parse(recorded.raw[0]).names
    except MessageError as error:
        raise UnreadableMessageError(recorded.name, 0, error) from error
    if not names:
        unnamed = MessageError('it names no joint, so its values cannot be told apart')
        raise UnreadableMessageError(recorded.name, 0, unnamed)
    return names


def _decode(recorded: Recorded, names: Sequence[str]) -> _Decoded:
    stamp, values = decode_joint_states(recorded, names, ('position',))
    stamp, order = np.unique(stamp, return_index=True)
    received = np.array(recorded.received, dtype=np.int64)[order]
    return _Decoded(tuple(names), stamp, received, values[order])


def _optional(content: Content, topic: Topic, joints: Sequence[str]) -> _Decoded | None:
    return _decode(content.topics[topic], joints) if topic in content.topics else None


def _vector(content: Content, topic: Topic) -> Series | None:
    if topic not in content.topics:
        return None
    recorded = content.topics[topic]
    return _decode(recorded, _names(recorded)).position


def _torque(content: Content, states: _Decoded, errors: _Decoded | None) -> Floats:
    commands = content.topics.get(COMMANDS)
    if commands is not None and len(commands.raw) == states.stamp.size:
        torque = decode_arrays(commands, len(states.names))
        if torque is not None:
            return torque
    if errors is not None:
        return errors.effort.exact(states.stamp)
    return np.vstack([states.effort.values[1:], np.full(len(states.names), np.nan)])
