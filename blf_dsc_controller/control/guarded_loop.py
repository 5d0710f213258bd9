# SPDX-License-Identifier: Apache-2.0
"""The guarded law for each joint state: a torque, and the messages about it.

The node publishes these messages, `ArmController` gives them to its outputs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.control.outputs import Outputs
from blf_dsc_controller.control.telemetry import ControllerTelemetry
from blf_dsc_controller.factory.estimate import estimate_names
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import Message
from blf_dsc_controller.supervision.guard import Guard

Vector = NDArray[np.float64]


class GuardedLoop:
    """The guarded law of one arm with its telemetry.

    Who has one asks `guard.update` for the torque, sends it, and only then calls `guard.perceive`
    and encodes the messages: both may take longer than the drives should wait.

    Attributes:
        guard: the law between its checks.
        telemetry: encoders of the messages.
        estimates: names of the entries of theta^.
        outputs: where the messages of a loop of your own go, as those of a run over ROS.
    """

    def __init__(
        self,
        config: ControllerConfig,
        steady: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        """Compile the law; `steady` and `wall` are the clocks [ns]."""
        self.guard = Guard(config, steady, wall)
        self.estimates = estimate_names(config)
        self.telemetry = ControllerTelemetry(config, self.estimates)
        self.outputs = Outputs()
        self._states = JointStateEncoder(config.joints)
        self._motors = JointStateEncoder(config.joints, ('position', 'velocity'))

    def retune(self, config: ControllerConfig) -> Message | None:
        """Apply a configuration; return the bound by it, after the first sample of the law."""
        guard = self.guard
        guard.retune(config)
        if guard.reference.last_stamp < 0:
            return None
        bound = guard.controller.bound_at(guard.reference.time)
        limit = guard.controller.settings.torque.limit
        return self.telemetry.bound(guard.journal.stamp, bound, limit)

    def messages(
        self, torque: Vector | None, *, errors_wanted: bool = True
    ) -> Iterator[Message]:
        """Yield the messages about the last state, answered by `torque` (n,) [N m].

        They are the telemetry of the law's sample, or the answer of a safe torque.  The
        tracking errors are left out unless they are wanted; the command is not among
        them.
        """
        guard = self.guard
        if guard.has_sample:
            controller = guard.controller
            if controller.samples == 1:
                self.telemetry.restart()
            yield from self.telemetry.sample(
                guard.reference.last_stamp,
                controller.sample,
                controller.settings.torque.limit,
                guard.samples.ratio,
                guard.compute_time,
                subscribed=errors_wanted,
            )
        elif torque is not None and errors_wanted:
            yield self.telemetry.answer(guard.journal.stamp, torque)

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
        if not self.outputs:
            return
        write = partial(self.outputs.write, stamp)
        write(
            topics.JOINT_STATES,
            self._states.encode(stamp, *measurement.reshape(3, -1)),
        )
        if torque is not None:
            write(*self.telemetry.command(torque))
        for message in self.messages(torque):
            write(*message)
        self._write_events(stamp)
        if motors is not None:
            write(topics.MOTOR_STATES, self._motors.encode(stamp, *motors))

    def write_end(self, torque: Vector | None) -> None:
        """Write a torque (n,) that no state asked for, and the events."""
        if not self.outputs:
            return
        stamp = max(self.guard.journal.stamp, 0)
        if torque is not None:
            self.outputs.write(stamp, *self.telemetry.command(torque))
        self._write_events(stamp)

    def _write_events(self, stamp: int) -> None:
        for message in self.guard.journal.take():
            self.outputs.write(stamp, *message)
