# SPDX-License-Identifier: Apache-2.0
"""The limits of a motion, and their violations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.reference.terms import sampled

_PERIOD = 0.005  # s, between two checked samples
_LEAST = 200  # samples, for short motions
_MOST = 1_000_000  # samples, for very long ones
_ROUNDING = 1e-9  # relative, for motions that just reach a limit


class Violation(NamedTuple):
    """The largest violation of a limit by a motion."""

    joint: str
    quantity: str  # position, velocity or acceleration
    value: float
    limit: float
    time: float  # s
    ratio: float  # value over limit; positions are relative to the middle of their range

    def __str__(self) -> str:
        """Describe the violation: joint, quantity, value and limit with their unit."""
        unit = {'position': 'rad', 'velocity': 'rad/s', 'acceleration': 'rad/s^2'}[self.quantity]
        return (
            f'the {self.quantity} of joint {self.joint!r} would be {self.value:.6g} {unit} at '
            f't = {self.time:.6g} s, past its limit of {self.limit:.6g} {unit}'
        )

    @property
    def parameters(self) -> str:
        """The configuration parameters that set this limit."""
        if self.quantity == 'position':
            return 'limits.position_lower and limits.position_upper'
        return f'limits.{self.quantity}'


class MotionError(BlfDscError):
    """No motion keeps the limits; `violation` is that of the best motion found."""

    def __init__(self, message: str, violation: Violation | None = None) -> None:
        self.violation = violation
        super().__init__(message)


def check_times(begin: float, end: float) -> np.ndarray:
    """Return times from `begin` to `end` [s], dense enough to catch the largest velocity."""
    count = 1 + (end - begin) / _PERIOD
    return np.linspace(begin, end, int(min(max(_LEAST, count), _MOST)))


def worst_violation(
    vector: np.ndarray, times: np.ndarray, config: ControllerConfig
) -> Violation | None:
    """Return the largest violation by a packed reference at times (k,) [s], or None."""
    qr, dqr, ddqr = sampled(vector, times).transpose(1, 0, 2)
    limits = config.limits
    lower, upper = np.array((limits.position_lower, limits.position_upper))
    middle, reach = 0.5 * (upper + lower), 0.5 * (upper - lower)
    worst = None
    for quantity, value, allowed in (
        ('position', qr - middle, reach),
        ('velocity', dqr, np.array(limits.velocity)),
        ('acceleration', ddqr, np.array(limits.acceleration)),
    ):
        ratios = np.abs(value) / allowed
        at, i = np.unravel_index(np.argmax(ratios), ratios.shape)
        ratio = float(ratios[at, i])
        if ratio <= 1.0 + _ROUNDING or (worst is not None and ratio <= worst.ratio):
            continue
        shift = float(middle[i]) if quantity == 'position' else 0.0
        reached = float(value[at, i])
        limit = shift + float(np.copysign(allowed[i], reached))
        time = float(times[at])
        worst = Violation(config.joints[i], quantity, shift + reached, limit, time, ratio)
    return worst
