# SPDX-License-Identifier: Apache-2.0
"""Outputs of a guarded controller, state by state, as arrays."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.law.state import Sample
from blf_dsc_controller.messages.samples import columns_of
from blf_dsc_controller.messages.telemetry import DECIMATION, Monitor
from blf_dsc_controller.run import Floats, Series, Stamps
from blf_dsc_controller.supervision.guard import Guard


class Commands(NamedTuple):
    """M replayed torques in the order in which they were commanded."""

    stamp: Stamps  # (M,) ns, of the last joint state before each
    torque: Floats  # (M, n) N m
    of_law: NDArray[np.bool_]  # (M,) torques of the law; the others are safe torques
    exact: NDArray[np.bool_]  # (M,) whether the same states led to it as in the recorded run
    number: NDArray[np.intp]  # (M,) of the recorded command


class Outputs:
    """Samples, monitor and torques of a guard."""

    def __init__(self, guard: Guard, states: int) -> None:
        """Allocate the samples of this number of states."""
        self._guard = guard
        self._joints, self._estimates = guard.config.joints, estimate_names(guard.config)
        self._stamps: list[int] = []  # ns, of the samples
        self._rows = np.empty((states, guard.controller.sample_vector.size))
        self._monitor: Monitor | None = None
        self._monitored: list[tuple[int, list[float]]] = []  # ns, values
        self._commands: list[tuple[int, Floats, bool, bool]] = []  # as in Commands
        self._offsets = [(0, 0)]  # number of a torque, and its number in the bag

    def add_sample(self, stamp: int) -> None:
        """Add the last sample of the law, for the state with this stamp [ns]."""
        guard, controller = self._guard, self._guard.controller
        self._rows[len(self._stamps)] = controller.sample_vector
        self._stamps.append(stamp)
        if controller.samples == 1 or self._monitor is None:
            self._monitor = Monitor(self._joints, self._estimates, controller.settings)
        if (controller.samples - 1) % DECIMATION == 0:
            sample = controller.sample
            values = self._monitor.values(stamp, sample, guard.samples.ratio, sample.bound)
            self._monitored.append((stamp, values))

    def add_command(self, stamp: int, torque: Floats, *, is_exact: bool) -> None:
        """Add a commanded torque (n,) [N m] after a state with this stamp [ns]."""
        of_law = self._guard.has_sample
        self._commands.append((stamp, torque.copy(), of_law, of_law or is_exact))

    def count_from(self, own: int, recorded: int) -> None:
        """Match the torques from number `own` on with the commands from number `recorded` on."""
        self._offsets.append((own, recorded))

    @property
    def last(self) -> int:
        """Stamp of the last sample [ns], -1 if there is none."""
        return self._stamps[-1] if self._stamps else -1

    @property
    def stamp(self) -> Stamps:
        """Stamps of the samples (N,) [ns]."""
        return np.array(self._stamps, dtype=np.int64)

    @property
    def samples(self) -> Sample:
        """Columns of the law's telemetry samples, each (N, its length)."""
        return columns_of(self._rows[: len(self._stamps)], self._guard.controller.settings)

    @property
    def monitor(self) -> Series:
        """Values of the monitor."""
        names = () if self._monitor is None else self._monitor.names
        stamp = np.array([stamp for stamp, _ in self._monitored], dtype=np.int64)
        values = np.array([values for _, values in self._monitored])
        return Series(names, stamp, values.reshape(stamp.size, len(names)))

    @cached_property
    def commands(self) -> Commands:
        """All commanded torques."""
        count = len(self._commands)
        number = np.arange(count)
        for own, recorded in self._offsets:
            number[own:] = np.arange(recorded, recorded + count - own)
        torque = np.array([one[1] for one in self._commands])
        return Commands(
            np.array([one[0] for one in self._commands], dtype=np.int64),
            torque.reshape(count, len(self._joints)),
            np.array([one[2] for one in self._commands], dtype=np.bool_),
            np.array([one[3] for one in self._commands], dtype=np.bool_),
            number,
        )
