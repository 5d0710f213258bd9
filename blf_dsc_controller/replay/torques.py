# SPDX-License-Identifier: Apache-2.0
"""The applied torques, from whichever topic of a bag holds them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blf_dsc_controller.bags.batch import array_size, decode_arrays, decode_joint_states
from blf_dsc_controller.bags.content import Content, TopicMessages
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.cdr import JointStateLayout
from blf_dsc_controller.messages.decoders import columns_of
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATE, JOINT_STATES, TRACKING_ERROR
from blf_dsc_controller.replay.states import States
from blf_dsc_controller.run import Floats, Series, Stamps


def applied_torque(
    path: Path, content: Content, states: States, joints: Sequence[str]
) -> tuple[Floats, str]:
    """Torque from each of the n joints' states to the next (N, n) [N m], and its topic.

    In this order: the saturated torque of the controller's telemetry, the commands, the effort of
    the next state.

    Raises:
        BlfDscError: the bag holds none of them.
    """
    if TRACKING_ERROR in content.topics:
        recorded = content.topics[TRACKING_ERROR]
        stamp, values = decode_joint_states(recorded, joints, ('effort',))
        torque = Series(tuple(joints), stamp, values[:, 2]).exact(states.stamp)
        return torque, f'effort of {recorded.name}'
    if COMMANDS in content.topics:
        recorded = content.topics[COMMANDS]
        return _commanded(content, recorded, states, joints), recorded.name
    effort = states.measurement[:, 2 * len(joints) :]
    if np.isnan(effort).all():
        reason = (
            f'{path} does not hold the torques: there is no topic of commands (name it: --map '
            'commands=/its/name) and the effort of the joint states is empty'
        )
        raise BlfDscError(reason)
    last = np.full((1, len(joints)), np.nan)
    return np.vstack([effort[1:], last]), f'effort of {content.topics[JOINT_STATES].name}'


def _commanded(
    content: Content, recorded: TopicMessages, states: States, joints: Sequence[str]
) -> Floats:
    """Command after each state: the k-th, or the last before the next state if counts differ."""
    torque = _values(content, recorded, joints)
    if len(recorded.raw) == states.stamp.size:
        return torque
    received = np.array(content.topics[JOINT_STATES].received, dtype=np.int64)
    stamp, _ = decode_joint_states(content.topics[JOINT_STATES], joints)
    came = np.array(recorded.received, dtype=np.int64)
    of_state = dict(zip(stamp.tolist(), received.tolist(), strict=True))
    moments: Stamps = np.array([of_state[one] for one in states.stamp.tolist()], dtype=np.int64)
    until = np.append(moments[1:], np.iinfo(np.int64).max)
    index = np.searchsorted(came, until) - 1
    held = torque[np.maximum(index, 0)]
    held[index < 0] = np.nan
    return held


def _values(content: Content, recorded: TopicMessages, joints: Sequence[str]) -> Floats:
    """Commands (m, n): by name, or in the order of the joints, or in that of the joint states."""
    if recorded.type == JOINT_STATE:
        return decode_joint_states(recorded, joints, ('effort',))[1][:, 2]
    size = array_size(recorded)
    values = decode_arrays(recorded, size)
    names = JointStateLayout.parse(content.topics[JOINT_STATES].raw[0]).names
    if values is None or size not in (len(joints), len(names)):
        reason = (
            f'{recorded.name} has {size} values, but there are {len(joints)} joints, and '
            f'{len(names)} in the joint states ({", ".join(names)}): their order is not known'
        )
        raise BlfDscError(reason)
    return values if size == len(joints) else values[:, columns_of(joints, names)]
