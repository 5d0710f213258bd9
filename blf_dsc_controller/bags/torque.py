# SPDX-License-Identifier: Apache-2.0
"""Torques applied to the arm, as recorded in a bag."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.topic_messages import JointStates, TopicMessages
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATE, JOINT_STATES, TRACKING_ERROR
from blf_dsc_controller.run import Floats


class TorqueError(BlfDscError):
    """The torques of a bag are unknown."""


def applied_torque(content: Content, states: JointStates) -> tuple[Floats, str]:
    """Return the torque from each state to the next (N, n) [N m], and its topic.

    The first available of: commands, if there is one for each state; the saturated torque of the
    controller's telemetry; commands; the effort of the next state.

    Raises:
        TorqueError: the bag holds none of them, or commands in an unknown order.
    """
    commands, errors = content.topics.get(COMMANDS), content.topics.get(TRACKING_ERROR)
    if commands is not None and (errors is None or len(commands.raw) == states.stamp.size):
        return _commanded(content, commands, states), commands.name
    if errors is not None:
        telemetry = errors.joint_states(states.names, ('effort',)).by_stamp()
        return telemetry.effort.exact(states.stamp), f'effort of {errors.name}'
    effort = next_effort(states)
    if np.isnan(effort).all():
        raise TorqueError(
            f'{content.path} does not hold the torques: there is no command topic (map it: '
            '--map commands=/its/name) and the effort of the joint states is empty'
        )
    return effort, f'effort of {content.topics[JOINT_STATES].name}'


def next_effort(states: JointStates) -> Floats:
    """Return the effort (N, n) measured with the next state; NaN for the last one."""
    return np.vstack([states.values[1:, 2], np.full((1, len(states.names)), np.nan)])


def _commanded(content: Content, commands: TopicMessages, states: JointStates) -> Floats:
    """Return the command after each state: k-th, or last before the next if counts differ."""
    torque = _by_joint(content, commands, states.names)
    if len(torque) == states.stamp.size:
        return torque
    until = np.append(states.received[1:], np.iinfo(np.int64).max)
    index = np.searchsorted(commands.received, until) - 1
    held = torque[np.maximum(index, 0)]
    held[index < 0] = np.nan
    return held


def _by_joint(content: Content, commands: TopicMessages, joints: Sequence[str]) -> Floats:
    """Return commands (m, n): by name, or in the order of `joints` or of the joint states."""
    if commands.type == JOINT_STATE:
        return commands.joint_states(joints, ('effort',)).values[:, 2]
    size = commands.layout().arrays[0].size
    values = commands.arrays(size)
    states = content.topics[JOINT_STATES].layout()
    if values is None or size not in (len(joints), len(states.names)):
        raise TorqueError(
            f'{commands.name} has {size} values, but there are {len(joints)} joints, and '
            f'{len(states.names)} in the joint states ({", ".join(states.names)}): their order is '
            'not known'
        )
    return values if size == len(joints) else values[:, states.columns_of(joints)]
