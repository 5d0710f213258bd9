# SPDX-License-Identifier: Apache-2.0
"""Torques applied to the arm, as recorded in a bag."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.columns import ALL, Rows
from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.topic_messages import JointStates, TopicMessages
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATE, JOINT_STATES, TRACKING_ERROR
from blf_dsc_controller.run import Floats, Stamps


class TorqueError(BlfDscError):
    """The torques of a bag are unknown."""


class AppliedTorque(NamedTuple):
    """The torque from each of N states to the next, in a table."""

    source: str  # topic
    table: JointStates
    field: int
    columns: Rows
    row: Stamps  # (N,) row of the table for each state; -1 if unknown

    def at(self, rows: Rows = ALL) -> Floats:
        """Return the torque after these states (m, n) [N m]; NaN where unknown."""
        row = self.row[rows]
        values = self.table.field(self.field, np.maximum(row, 0), self.columns)
        values[row < 0] = np.nan
        return values


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
        stamp, wanted = telemetry.stamp, states.stamp
        index = np.minimum(np.searchsorted(stamp, wanted), stamp.size - 1)
        index[stamp[index] != wanted] = -1
        return AppliedTorque(f'effort of {errors.name}', telemetry, 2, ALL, index)
    found = next_effort(states, f'effort of {content.topics[JOINT_STATES].name}')
    if np.isnan(found.at(slice(0, 1000))).all():
        raise TorqueError(
            f'{content.path} does not hold the torques: there is no command topic (map it: '
            '--map commands=/its/name) and the effort of the joint states is empty'
        )
    return found


def next_effort(states: JointStates, source: str = '') -> AppliedTorque:
    """Return the effort measured with the next state; unknown for the last one."""
    index = np.append(np.arange(1, states.size), -1)
    return AppliedTorque(source, states, 2, ALL, index)


def _commanded(content: Content, commands: TopicMessages, states: JointStates) -> AppliedTorque:
    """Return the command after each state: k-th, or last before the next if counts differ."""
    table, field, columns = _by_joint(content, commands, states.names)
    index = np.arange(states.size)
    if table.size != states.size:
        until = np.append(states.received[1:], np.iinfo(np.int64).max)
        index = np.searchsorted(np.maximum.accumulate(table.received), until) - 1
    return AppliedTorque(commands.name, table, field, columns, index)


def _by_joint(
    content: Content, commands: TopicMessages, joints: tuple[str, ...]
) -> tuple[JointStates, int, Rows]:
    """Return commands as a table, a field and columns: by name, or in the order of `joints`.

    Without names they may also be in the order of the joint states.
    """
    if commands.type == JOINT_STATE:
        return commands.joint_states(joints, ('effort',)), 2, ALL
    size = commands.layout().arrays[0].size
    table = commands.arrays(size)
    states = content.topics[JOINT_STATES].layout()
    if table is None or size not in (len(joints), len(states.names)):
        raise TorqueError(
            f'{commands.name} has {size} values, but there are {len(joints)} joints, and '
            f'{len(states.names)} in the joint states ({", ".join(states.names)}): their order is '
            'not known'
        )
    return table, 0, ALL if size == len(joints) else np.array(states.columns_of(joints))
