# SPDX-License-Identifier: Apache-2.0
"""The messages of a loop of your own, as a run over ROS has them, and where they go."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.topic_recorder import TopicRecorder
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.control.guarded_loop import GuardedLoop
from blf_dsc_controller.control.outputs import Outputs
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateEncoder

Vector = NDArray[np.float64]


class LoopOutputs(Outputs):
    """The outputs of a guarded loop, its bag first."""

    def __init__(self, loop: GuardedLoop, record: str | Path | None) -> None:
        """Record a bag in the folder `record`, which must not exist; None: none.

        Raises BagError if there is such a folder.
        """
        super().__init__()
        self._loop = loop
        joints = loop.guard.config.joints
        self._states = JointStateEncoder(joints)
        self._motors = JointStateEncoder(joints, ('position', 'velocity'))
        self._recorder: TopicRecorder | None = None
        if record is not None:
            self._recorder = TopicRecorder(BagWriter(record, in_background=True))
            self.add(self._recorder)

    def write_state(
        self,
        stamp: int,
        measurement: Vector,
        motors: Vector | None,
        torque: Vector | None,
    ) -> None:
        """Write the messages about a state [q, dq, effort] (3 n,), which got this torque (n,).

        `motors` are positions and velocities (2, n).
        """
        if not self:
            return
        state = self._states.encode(stamp, *measurement.reshape(3, -1))
        self.write(stamp, topics.JOINT_STATES, state)
        if torque is not None:
            self.write(stamp, *self._loop.telemetry.command(torque))
        for message in self._loop.messages(torque):
            self.write(stamp, *message)
        self._write_events(stamp)
        if motors is not None:
            raw = self._motors.encode(stamp, *motors)
            self.write(stamp, topics.MOTOR_STATES, raw)

    def write_end(self, torque: Vector | None) -> None:
        """Write a torque (n,) that no state asked for, and the events."""
        if not self:
            return
        stamp = max(self._loop.guard.journal.stamp, 0)
        if torque is not None:
            self.write(stamp, *self._loop.telemetry.command(torque))
        self._write_events(stamp)

    def close(self) -> None:
        """End the bag."""
        if self._recorder is not None:
            self.end(self._recorder, self._recorder.close)
            self._recorder = None

    def _write_events(self, stamp: int) -> None:
        for message in self._loop.guard.journal.take():
            self.write(stamp, *message)
