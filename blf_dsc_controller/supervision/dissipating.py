# SPDX-License-Identifier: Apache-2.0
"""The velocity by which a stop takes energy out of a motion, and puts none in.

A torque -D v of the velocity v behind the low pass of a stop is late.  On a joint that is
lighter than assumed, or behind a spring, it drives the motion for a part of each half wave,
until `Swing` has found that.  So v is limited to what a quicker velocity w shows,

    min(w, 0) - c <= v <= max(w, 0) + c

where c is what noise and steps of the sensor explain of w: against the motion it is no more
than that, and else no more than the motion itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.supervision.last_state import FAST, LastState

Vector = NDArray[np.float64]

_LEAST = 0.05  # rad/s
_SIGMAS = 3.0
_STEPS = 2.0


def dissipating(last: LastState, noise: Vector, resolution: Vector) -> Vector:
    """Return the velocity (n,) [rad/s] to damp.

    `noise` (n,) [rad^2] is the mean square of the noise of positions, `resolution` (n,)
    [rad] their steps.
    """
    unsure = np.maximum(_SIGMAS * np.sqrt(noise), _STEPS * resolution)
    c = np.maximum(_LEAST, unsure / FAST)
    w = last.fast
    v: Vector = np.clip(last.slow, np.minimum(w, 0.0) - c, np.maximum(w, 0.0) + c)
    return v
