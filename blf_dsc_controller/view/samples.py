# SPDX-License-Identifier: Apache-2.0
"""The newest values of a loop's topics, of which snapshots are made."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.factory.estimate import estimate_names
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.named_values import external_names
from blf_dsc_controller.messages.topics import Topic
from blf_dsc_controller.run import Floats
from blf_dsc_controller.view.model_error import ModelError
from blf_dsc_controller.view.newest import check_positions, newest
from blf_dsc_controller.view.snapshot import Snapshot

STREAMS = (
    topics.JOINT_STATES,
    topics.TRACKING_ERROR,
    topics.BOUND,
    topics.MONITOR,
    topics.TRUTH,
    topics.EXTERNAL_TORQUE,
)
"""Topics whose values are shown."""

_FIGURES = (  # of the monitor, after the estimates
    *topics.TOOL,
    *topics.LOAD,
    topics.LAMBDA_MIN,
    topics.CONTACT[0],
    topics.LATCHED,
)
_OUTDATED = 500_000_000  # ns


class Samples:
    """The newest values of the topics of one controller.

    Attributes:
        sampled: stamp of the last tracking error [ns]; -1 before the first.
    """

    def __init__(
        self, config: ControllerConfig, pass_over: Callable[[MessageError], None]
    ) -> None:
        """Take those of a configured controller; `pass_over` gets what is wrong with others."""
        self.sampled = -1
        self._pass_over = pass_over
        estimates, joints = estimate_names(config), config.joints
        names = (
            *[joints] * 3,
            (*estimates, *_FIGURES),
            estimates,
            external_names(joints),
        )
        self._names = dict(zip(STREAMS, names, strict=True))
        self._values = {
            topic: np.full((3, len(of)), np.nan) for topic, of in self._names.items()
        }
        self._first_truth = self._values[topics.TRUTH][0]
        self._model_error = ModelError(config)

    @property
    def latched(self) -> float:
        """Whether an excited window is latched, 0 or 1; NaN if it is not known."""
        return float(self._values[topics.MONITOR][0][-1])

    def take(self, streams: Mapping[Topic, Sequence[bytes]]) -> int | None:
        """Take the newest message of each topic.

        Return the stamp [ns] of the joint state; None: there was none.
        """
        stamps: dict[Topic, int] = {}
        for topic, messages in streams.items():
            try:
                found = newest(messages, self._names[topic])
                if found is None:  # those of a gripper, for instance
                    continue
                at, values = found
                if topic is topics.JOINT_STATES:
                    check_positions(self._names[topic], values[0])
            except MessageError as error:
                self._pass_over(error)
            else:
                stamps[topic], self._values[topic] = at, values
        self.sampled = max(stamps.get(topics.TRACKING_ERROR, -1), self.sampled)
        stamp = stamps.get(topics.JOINT_STATES)
        if stamp is not None and stamp - self.sampled > _OUTDATED:
            for topic in (topics.TRACKING_ERROR, topics.EXTERNAL_TORQUE):
                self._values[topic] = np.nan * self._values[topic]  # no law is running
        if np.isnan(self._first_truth).all():
            self._first_truth = self._values[topics.TRUTH][0]
        return stamp

    def snapshot(self, time: float) -> Snapshot:
        """Return the newest values of all topics, at a time [s] after the last snapshot."""
        position, velocity, effort = self._values[topics.JOINT_STATES]
        error, _, torque = self._values[topics.TRACKING_ERROR]
        truth = self._values[topics.TRUTH][0]
        monitor = self._values[topics.MONITOR][0]
        external, interval = np.split(self._values[topics.EXTERNAL_TORQUE][2], 2)
        estimate, tool, rest = np.split(
            monitor, [truth.size, truth.size + len(topics.TOOL)]
        )
        *load, lambda_min, contact, _ = rest.tolist()
        return Snapshot(
            time=time,
            position=position,
            error=error,
            bound=self._values[topics.BOUND][0],
            torque=effort if np.isnan(torque).any() else torque,
            estimate=estimate,
            truth=truth,
            lambda_min=lambda_min,
            squares=self._model_error.squares(
                time, position, velocity, estimate, truth
            ),
            load=load,
            loaded=self._is_loaded(truth),
            tool=tool.tolist(),
            external=external,
            interval=interval,
            touched=bool(contact > 0.0),
        )

    def _is_loaded(self, truth: Floats) -> bool:
        """Whether the true parameters differ from the first ones."""
        return bool((np.abs(truth - self._first_truth) > 0.0).any())
