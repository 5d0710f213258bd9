# SPDX-License-Identifier: Apache-2.0
"""Noise and steps of the positions of an arm that another controls."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.compiled.layout import size_of, view_of
from blf_dsc_controller.law import sensor
from blf_dsc_controller.supervision.reading import Reading

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
    """Noise and steps of the positions of an arm, measured as the law does.

    Attributes:
        state: noise and steps of the positions.
    """

    def __init__(self, n: int) -> None:
        self._lengths = _Lengths(n)
        self._vector = np.zeros(_state_size(self._lengths))
        self.state = _state_of(self._vector, self._lengths)
        self._reading = np.zeros(2 * n)  # with velocities, of which nobody asks

    def take(self, reading: Reading) -> None:
        """Take a trusted reading, whose gap the readings have taken note of."""
        if reading.gap == 0.0:
            return
        self._reading[: reading.q.size] = reading.q
        _measure(self._lengths, self._vector, reading.gap, self._reading)
