# SPDX-License-Identifier: Apache-2.0
"""Sums of sinusoids, with the derivatives the laws ask for.

qr_i += offset_i + sum_k amplitude_ik cos(frequency_k t + phase_k)
"""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.views import part

if TYPE_CHECKING:
    from collections.abc import Sequence


def sinusoids_content(
    offset: Sequence[float],
    amplitude: Sequence[float],
    frequency: Sequence[float],
    phase: Sequence[float],
) -> np.ndarray:
    """Pack a sum of cosines for `sinusoids`.

    Args:
        offset: (n,) [rad].
        amplitude: (n * tones,) [rad], all tones of the first joint first.
        frequency: (tones,) [rad/s].
        phase: (tones,) [rad].
    """
    tones = float(len(frequency))
    return np.array((tones, *offset, *frequency, *phase, *amplitude), dtype=np.float64)


@inner
def sinusoids(vector: np.ndarray, at: int, n: int, i: int, t: float) -> tuple[float, float, float]:
    """Joint i of n at time t [s] of the sum that is packed from entry `at` on: q, q', q''."""
    tones = int(vector[at])
    offset = part(vector, at + 1, (n,))
    frequency = part(vector, at + 1 + n, (tones,))
    phase = part(vector, at + 1 + n + tones, (tones,))
    amplitude = part(vector, at + 1 + n + 2 * tones, (n, tones))
    position = offset[i]
    velocity = 0.0
    acceleration = 0.0
    for k in range(tones):
        angle = frequency[k] * t + phase[k]
        rate = frequency[k] * amplitude[i, k]
        position += amplitude[i, k] * cos(angle)
        velocity -= rate * sin(angle)
        acceleration -= rate * frequency[k] * cos(angle)
    return position, velocity, acceleration
