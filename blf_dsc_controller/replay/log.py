# SPDX-License-Identifier: Apache-2.0
"""What a replayed controller says, as the node would publish it: its law's samples, all torques."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.messages.monitor import Monitor
from blf_dsc_controller.messages.telemetry import DECIMATION
from blf_dsc_controller.replay.law import Replayed, replayed_of
from blf_dsc_controller.run import Floats, Stamps
from blf_dsc_controller.supervision.guard import Guard


class Log:
    """Grows with each joint state.

    Args:
        config: of the controller.
        guard: the controller.
        most: joint states that there can be.

    Attributes:
        numbers: of the joint states that the law answered.
        monitored: messages of the monitor, by their place among these.
        last: stamp of the last joint state that the law answered [ns]; -1 before the first.
    """

    def __init__(self, config: ControllerConfig, guard: Guard, most: int) -> None:
        self.numbers: list[int] = []
        self.monitored: dict[int, bytes] = {}
        self.last = -1
        self._config = config
        self._guard = guard
        self._monitor: Monitor | None = None
        self._rows = np.empty((most, guard.controller.sample_vector.size))
        self._torque = np.empty((most, guard.controller.settings.n))
        self._stamp = np.empty(most, dtype=np.int64)
        self._of_law = np.zeros(most, dtype=np.bool_)
        self._torques = 0

    @property
    def torques(self) -> int:
        """How many have been commanded."""
        return self._torques

    def answered(self, number: int, stamp: int, torque: Floats) -> None:
        """Take note of the law's answer to a joint state."""
        controller = self._guard.controller
        row = len(self.numbers)
        self._rows[row] = controller.sample_vector
        self.numbers.append(number)
        self.last = stamp
        self._of_law[self._torques] = True
        self.commanded(stamp, torque)
        samples = controller.samples
        if samples == 1 or self._monitor is None:
            names = estimate_names(self._config)
            self._monitor = Monitor(self._config.joints, names, controller.settings)
        if (samples - 1) % DECIMATION == 0:
            told = controller.sample
            message = self._monitor.message(stamp, told, self._guard.ratio, told.bound)
            self.monitored[row] = message[1]

    def commanded(self, stamp: int, torque: Floats | None) -> None:
        """Take note of a torque; None is none."""
        if torque is not None:
            self._torque[self._torques] = torque
            self._stamp[self._torques] = stamp
            self._torques += 1

    def replayed(self) -> Replayed:
        """What the law told."""
        rows = self._rows[: len(self.numbers)]
        return replayed_of(self._config, rows, self._guard.controller.settings)

    def commands(self) -> tuple[Stamps, Floats, np.ndarray]:
        """Stamps (M,) [ns], torques (M, n) [N m], and which of them are the law's (M,)."""
        count = self._torques
        return self._stamp[:count], self._torque[:count], self._of_law[:count]
