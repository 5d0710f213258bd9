# SPDX-License-Identifier: Apache-2.0
"""What the plant says of its state: its part of `/diagnostics`."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.node import Node

from blf_dsc_controller.nodes.diagnostics import ERROR, OK, STALE, WARN, Board
from sim_plant.command_input import Reception


class PlantStatus:
    """Publishes the state of the plant.

    Args:
        node: that tells.
        joints: names of the joints.
    """

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self._board = Board(node, joints)
        self._stale = 0
        self._rejected = 0

    def report(self, phase: str, reception: Reception, late_steps: int) -> None:
        """Publish diagnostics; what happened since the last report counts.

        Args:
            phase: running, waiting, or the lifecycle state.
            reception: torques that came.
            late_steps: steps taken before their torque had come.
        """
        values = {
            'commands of a wrong length': reception.wrong_length,
            'commands that were not finite': reception.not_finite,
            'steps with a torque that was too old': reception.stale_steps,
            'late steps': late_steps,
        }
        level, message = self._verdict(phase, reception)
        self._stale, self._rejected = reception.stale_steps, reception.rejected
        self._board.report([self._board.status('torque', level, message, values)])

    def _verdict(self, phase: str, reception: Reception) -> tuple[bytes, str]:
        if phase == 'waiting':
            return WARN, 'braked: waiting for the first torque'
        if phase != 'running':
            return STALE, phase
        if reception.stale_steps > self._stale:
            return ERROR, 'the last torque is too old (actuator.command_timeout): not applied'
        if reception.rejected > self._rejected:
            return WARN, reception.complaint
        return OK, 'running'
