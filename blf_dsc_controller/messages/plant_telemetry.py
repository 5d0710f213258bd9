# SPDX-License-Identifier: Apache-2.0
"""Messages of the plant: joint states, truth, timing and its clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateEncoder, encode_clock
from blf_dsc_controller.messages.named_values import disturbance_names
from blf_dsc_controller.messages.topics import Message

_DECIMATION = 10  # samples from one message of the plant's truth to the next


class PlantTelemetry:
    """Messages of the plant of n joints and p true parameters.

    Joint states have the names `published`, by default the joints; other joints stay at
    0.
    """

    def __init__(
        self,
        joints: Sequence[str],
        parameters: Sequence[str],
        published: Sequence[str] = (),
    ) -> None:
        names = tuple(published) or tuple(joints)
        true_state = [
            what + joint
            for what in (topics.POSITION, topics.VELOCITY)
            for joint in joints
        ]
        self._joint_states = JointStateEncoder(names)
        self._motors = JointStateEncoder(joints, ('position', 'velocity'))
        self._places = [names.index(joint) for joint in joints]
        self._published = np.zeros((3, len(names)))
        self._truth = JointStateEncoder(
            (*parameters, *disturbance_names(joints), *true_state), ('position',)
        )
        self._timing = JointStateEncoder(
            (topics.LATENCY, topics.LATENESS, topics.LATE_STEPS), ('position',)
        )

    def joint_states(self, stamp: int, measurement: np.ndarray) -> Message:
        """Encode measured [q, dq, applied torque of the last interval] (3 n,)."""
        self._published[:, self._places] = measurement.reshape(3, -1)
        return topics.JOINT_STATES, self._joint_states.encode(stamp, *self._published)

    def states(
        self,
        sample: int,
        stamp: int,
        measurement: np.ndarray,
        motors: np.ndarray | None,
        truth: Callable[[], np.ndarray],
    ) -> Iterator[Message]:
        """Yield the messages about a sample of this number.

        `motors` are their positions and velocities (2, n), where these are measured; `truth`
        returns the true [P, tau_dist, q, dq] (p + 3 n,).
        """
        if motors is not None:
            yield topics.MOTOR_STATES, self._motors.encode(stamp, *motors)
        yield self.joint_states(stamp, measurement)
        if sample % _DECIMATION == 0:
            yield topics.TRUTH, self._truth.encode(stamp, truth())

    def timing(
        self, stamp: int, latency: float, lateness: float, late_steps: int
    ) -> Message:
        """Encode the real-time performance of the step up to this sample [s, s, count]."""
        return topics.TIMING, self._timing.encode(
            stamp, (latency, lateness, late_steps)
        )

    def clock(self, stamp: int) -> Message:
        """Encode the plant's time [ns] for /clock."""
        return topics.CLOCK, encode_clock(stamp)
