# SPDX-License-Identifier: Apache-2.0
"""The disturbance columns D: what the learning estimates beside P.

    tau_dist = D d,    D = [ I | diag(dq) | diag(tanh(dq / v_c)) | I sin(w t) | I cos(w t) | ... ]

as far as each block is switched on.  The coefficients d are estimated with P; (22)-(24) instead
subtract the estimate d^3 from the torque, which hides the parameter error behind it.
"""

from math import cos, sin, tanh

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law.settings import Settings


@inner
def set_block(rest: np.ndarray, at: int, i: int, value: float) -> None:
    """Entry (i, i) of the block that starts at column `at`; the others of its row are zero."""
    for k in range(rest.shape[0]):
        rest[i, at + k] = 0.0
    rest[i, at + i] = value


@inner
def fill(settings: Settings, t: float, dq: np.ndarray, rest: np.ndarray) -> None:
    """Fill columns p.. of `rest` (n, m) with D at time t [s] and velocity dq (n,) [rad/s]."""
    n = settings.n
    for i in range(n):
        at = settings.p
        if settings.bias == 1:
            set_block(rest, at, i, 1.0)
            at += n
        if settings.viscous == 1:
            set_block(rest, at, i, dq[i])
            at += n
        if settings.coulomb == 1:
            set_block(rest, at, i, tanh(dq[i] / settings.coulomb_velocity))
            at += n
        for k in range(settings.tones):
            set_block(rest, at, i, sin(settings.frequencies[k] * t))
            set_block(rest, at + n, i, cos(settings.frequencies[k] * t))
            at += 2 * n
