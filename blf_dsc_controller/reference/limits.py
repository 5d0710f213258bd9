# SPDX-License-Identifier: Apache-2.0
"""Whether a reference keeps within what the joints may do."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.reference.errors import Excess
from blf_dsc_controller.reference.terms import sampled

_PERIOD = 0.005  # s, between two looks at a reference
_LEAST = 200  # looks, so that a short motion is seen as well
_ROUNDING = 1e-9  # relative: a motion that was made to reach its limit keeps it


class Limits(NamedTuple):
    """What each of the n joints may be asked for."""

    joints: tuple[str, ...]
    lower: np.ndarray  # (n,) rad
    upper: np.ndarray  # (n,) rad
    velocity: np.ndarray  # (n,) rad/s
    acceleration: np.ndarray  # (n,) rad/s^2


def looks(begin: float, end: float) -> np.ndarray:
    """Times from `begin` to `end` [s] close enough to see a motion's largest velocity."""
    return np.linspace(begin, end, max(_LEAST, 1 + int((end - begin) / _PERIOD)))


def excess(vector: np.ndarray, times: np.ndarray, limits: Limits) -> Excess | None:
    """Worst excess of a packed reference at these times (k,) [s]; None if it keeps the limits."""
    qr, dqr, ddqr = sampled(vector, times).transpose(1, 0, 2)
    middle, reach = 0.5 * (limits.upper + limits.lower), 0.5 * (limits.upper - limits.lower)
    worst = None
    for quantity, value, allowed in (
        ('position', qr - middle, reach),
        ('velocity', dqr, limits.velocity),
        ('acceleration', ddqr, limits.acceleration),
    ):
        ratios = np.abs(value) / allowed
        at, i = np.unravel_index(np.argmax(ratios), ratios.shape)
        ratio = float(ratios[at, i])
        if ratio <= 1.0 + _ROUNDING or (worst is not None and ratio <= worst.ratio):
            continue
        shift = float(middle[i]) if quantity == 'position' else 0.0
        asked = float(value[at, i])
        limit = shift + float(np.copysign(allowed[i], asked))
        worst = Excess(limits.joints[i], quantity, shift + asked, limit, float(times[at]), ratio)
    return worst
