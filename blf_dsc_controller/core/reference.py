# SPDX-License-Identifier: Apache-2.0
"""Reference trajectories qr(t), with the derivatives the laws ask for."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from blf_dsc_controller.core.borrowed import part
from blf_dsc_controller.core.kernel import inner

if TYPE_CHECKING:
    from collections.abc import Sequence


def sinusoids_vector(
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
    counts = (float(len(offset)), float(len(frequency)))
    return np.array((*counts, *offset, *frequency, *phase, *amplitude), dtype=np.float64)


@inner
def sinusoids(
    vector: np.ndarray, t: float, qr: np.ndarray, dqr: np.ndarray, ddqr: np.ndarray
) -> None:
    """qr_i = offset_i + sum_k amplitude_ik cos(frequency_k t + phase_k), and two derivatives."""
    n = int(vector[0])
    tones = int(vector[1])
    offset = part(vector, 2, (n,))
    frequency = part(vector, 2 + n, (tones,))
    phase = part(vector, 2 + n + tones, (tones,))
    amplitude = part(vector, 2 + n + 2 * tones, (n, tones))
    for i in range(n):
        qr[i] = offset[i]
        dqr[i] = 0.0
        ddqr[i] = 0.0
        for k in range(tones):
            angle = frequency[k] * t + phase[k]
            rate = frequency[k] * amplitude[i, k]
            qr[i] += amplitude[i, k] * cos(angle)
            dqr[i] -= rate * sin(angle)
            ddqr[i] -= rate * frequency[k] * cos(angle)
