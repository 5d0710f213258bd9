# SPDX-License-Identifier: Apache-2.0
"""Noise and steps of the positions of an arm that another controls."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.compiled.layout import size_of, view_of
from blf_dsc_controller.law import sensor
from blf_dsc_controller.supervision.recent_motion import is_gap

Array = NDArray[np.float64]


class _Lengths(NamedTuple):
    n: int


_state_of, _state_size = view_of(sensor.State), size_of(sensor.State)


@kernel
def _measure(
    lengths: _Lengths, vector: np.ndarray, dt: float, reading: np.ndarray
) -> None:
    state = _state_of(vector, lengths)
    sensor.measure_noise(state, dt, reading)
    state.readings[0] += 1.0


class SensorNoise:
    """What the positions of an arm show of their sensor, as the law measures it.

    Attributes:
        noise: mean square (n,) [rad^2] of the noise of positions.
        resolution: steps (n,) [rad] of positions.
    """

    def __init__(self, n: int) -> None:
        self._lengths = _Lengths(n)
        self._vector = np.zeros(_state_size(self._lengths))
        self._state = _state_of(self._vector, self._lengths)
        self._reading = np.zeros(2 * n)  # with velocities, of which nobody asks
        self.noise: Array = self._state.noise[:n]
        self.resolution: Array = self._state.resolution

    def take(self, q: Array, elapsed: float, period: float) -> None:
        """Take positions q (n,) [rad], `elapsed` [s] after the last, usually a `period` [s].

        Those that are repeated or not finite are left out.
        """
        if elapsed < 0.0 or is_gap(elapsed, period):
            sensor.restart(self._state)
        if elapsed == 0.0 or not np.isfinite(q).all():
            return
        self._reading[: q.size] = q
        _measure(self._lengths, self._vector, elapsed, self._reading)
