# SPDX-License-Identifier: Apache-2.0
"""Torques applied to the arm, as recorded in a bag."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.topic_messages import ALL, JointStates, TopicMessages
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATE, JOINT_STATES, TRACKING_ERROR
from blf_dsc_controller.run import Floats, Rows


class TorqueError(BlfDscError):
    """The torques of a bag are unknown."""


class AppliedTorque(NamedTuple):
    """The torque from each of N states to the next, as efforts."""

    source: str  # topic
    efforts: JointStates  # (N,)

    def at(self, rows: Rows = ALL) -> Floats:
        """Return the torque after these states (m, n) [N m]; NaN where unknown."""
        return self.efforts.field(2, rows)


def applied_torque(content: Content, states: JointStates) -> AppliedTorque:
    """Return the first available of these, for states that are ordered by stamp.

    Commands, if there is one for each state; the saturated torque of the controller's telemetry;
    commands; the effort of the next state.

    Raises:
        TorqueError: the bag holds none of them, or commands in an unknown order.
    """
    commands, errors = content.topics.get(COMMANDS), content.topics.get(TRACKING_ERROR)
    if commands is not None and (errors is None or commands.size == states.size):
        return _commanded(content, commands, states)
    if errors is not None:
        telemetry = errors.joint_states(states.names, ('effort',)).by_stamp()
        return AppliedTorque(f'effort of {errors.name}', telemetry.at_stamps(states.stamp))
    found = next_effort(states, f'effort of {content.topics[JOINT_STATES].name}')
    if np.isnan(found.at(slice(0, 1000))).all():
        raise TorqueError(
            f'{content.path} does not hold the torques: there is no command topic (map it: '
            '--map commands=/its/name) and the effort of the joint states is empty'
        )
    return found


def next_effort(states: JointStates, source: str = '') -> AppliedTorque:
    """Return the effort measured with the next state; unknown for the last one."""
    return AppliedTorque(source, states.select(np.append(np.arange(1, states.size), -1)))


def _commanded(content: Content, commands: TopicMessages, states: JointStates) -> AppliedTorque:
    """Return the command after each state: k-th, or last before the next if counts differ."""
    efforts = _by_joint(content, commands, states.names)
    if efforts.size != states.size:
        until = np.append(states.received[1:], np.iinfo(np.int64).max)
        index = np.searchsorted(np.maximum.accumulate(efforts.received), until) - 1
        efforts = efforts.select(index)
    return AppliedTorque(commands.name, efforts)


def _by_joint(content: Content, commands: TopicMessages, joints: tuple[str, ...]) -> JointStates:
    """Return commands by name; without names, in the order of `joints` or of the joint states."""
    if commands.type == JOINT_STATE:
        return commands.joint_states(joints, ('effort',))
    size = commands.layout().arrays[0].size
    states = content.topics[JOINT_STATES].layout()
    if size == len(joints):
        return commands.arrays(range(size))
    if size == len(states.names):
        return commands.arrays(states.indices_of(joints))
    raise TorqueError(
        f'{commands.name} has {size} values, but there are {len(joints)} joints, and '
        f'{len(states.names)} in the joint states ({", ".join(states.names)}): their order is '
        'not known'
    )
