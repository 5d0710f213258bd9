# SPDX-License-Identifier: Apache-2.0
"""Messages of the controller for each sample, as (topic, bytes).

The nodes publish them; the offline loop writes them into a bag.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from operator import attrgetter

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.tool_bound import tool_of
from blf_dsc_controller.law.state import Sample
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
    WrenchEncoder,
)
from blf_dsc_controller.messages.named_values import external_names, monitored
from blf_dsc_controller.messages.topics import Message
from blf_dsc_controller.tool.tip_wrench import TipWrench


class ControllerTelemetry:
    """Messages of the controller of n joints; `estimates` are the names of theta^ (m,).

    Reference and monitor are sent with every `telemetry.decimation`-th sample, from the
    first one on, and so is the bound while it narrows; one that widens is sent at once.
    """

    def __init__(self, config: ControllerConfig, estimates: Sequence[str]) -> None:
        joints = config.joints
        parts = monitored(config, estimates)
        names = [
            what + joint for what in (topics.RATIO, topics.DISTANCE) for joint in joints
        ]
        self._tool = tool_of(config)
        of_tool = topics.TOOL if self._tool else ()
        names += [*chain.from_iterable(parts.values()), *of_tool, topics.COMPUTE_TIME]
        self._command = Float64MultiArrayEncoder(len(joints))
        self._reference = JointStateEncoder(joints, ('position', 'velocity'))
        self._error = JointStateEncoder(joints)
        self._bound = JointStateEncoder(joints, ('position', 'effort'))
        self._monitor = JointStateEncoder(names, ('position',))
        self._external = self._wrench = None
        if config.contact.enabled:
            self._external = JointStateEncoder(external_names(joints), ('effort',))
            if config.model == 'urdf' and config.robot.tip:
                self._wrench = WrenchEncoder(config.robot.tip)
                self._tip = TipWrench(config.robot.chain(joints))
        self._parts = attrgetter(*parts)
        self._decimation = config.telemetry.decimation
        self.restart()

    def restart(self) -> None:
        """Send everything with the next sample, as with the first one."""
        self._samples, self._slowest = 0, 0.0
        self._sent = np.empty(0)  # bound

    def command(self, torque: np.ndarray) -> Message:
        """Encode the commanded torque (n,) [N m]."""
        return topics.COMMANDS, self._command.encode(torque)

    def bound(self, stamp: int, bound: np.ndarray, torque_limit: np.ndarray) -> Message:
        """Encode the bound k_c (n,) [rad] on the tracking error and the torque limit (n,) [N m]."""
        self._sent = np.array(bound)
        return topics.BOUND, self._bound.encode(
            stamp, position=bound, effort=torque_limit
        )

    def answer(self, stamp: int, torque: np.ndarray) -> Message:
        """Encode a torque (n,) [N m] that is not the law's; the tracking errors are NaN.

        `stamp` [ns] is that of the joint state, or of the last readable one.
        """
        unknown = np.full(torque.size, np.nan)
        return topics.TRACKING_ERROR, self._error.encode(
            stamp, unknown, unknown, torque
        )

    def sample(
        self,
        stamp: int,
        sample: Sample,
        torque_limit: np.ndarray,
        ratio: np.ndarray,
        compute_time: float,
        *,
        subscribed: bool = True,
    ) -> Iterator[Message]:
        """Yield the messages for a joint state: its stamp [ns] and telemetry sample.

        `ratio` is the largest |xi1| / k_c so far (n,). Of the times of updates,
        `compute_time` [s], the largest since the last message is sent. The tracking
        errors come with every sample, if they are `subscribed`: they tell a replay
        which states were used.
        """
        is_due = self._samples % self._decimation == 0
        self._samples += 1
        self._slowest = max(compute_time, self._slowest)  # NaN: not measured
        bound = sample.bound
        if bound.tobytes() != self._sent.tobytes() and (
            is_due or (bound > self._sent).any()
        ):
            yield self.bound(stamp, bound, torque_limit)
        if subscribed:
            error = self._error.encode(stamp, sample.xi1, sample.xi2, sample.torque)
            yield topics.TRACKING_ERROR, error
        if is_due:
            yield topics.REFERENCE, self._reference.encode(stamp, sample.qr, sample.dqr)
            distance = bound - np.abs(sample.xi1)
            of_tool = np.empty(0)
            if self._tool is not None:
                of_tool = self._tool.errors(sample.qr, sample.xi1, bound)
            values = np.concatenate(
                (ratio, distance, *self._parts(sample), of_tool, (self._slowest,))
            )
            yield topics.MONITOR, self._monitor.encode(stamp, values)
            self._slowest = 0.0
            yield from self._contact(stamp, sample)

    def _contact(self, stamp: int, sample: Sample) -> Iterator[Message]:
        """Yield the torque from outside, and the wrench where `robot.tip` says at which link."""
        if self._external is None:
            return
        torque, interval = sample.external, sample.external_interval
        effort = np.concatenate((torque, interval))
        yield topics.EXTERNAL_TORQUE, self._external.encode(stamp, effort=effort)
        if self._wrench is not None:
            wrench = self._tip.of(sample.qr + sample.xi1, torque, interval)
            yield topics.EXTERNAL_WRENCH, self._wrench.encode(stamp, wrench)
