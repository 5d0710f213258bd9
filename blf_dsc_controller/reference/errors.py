# SPDX-License-Identifier: Apache-2.0
"""Why a motion is refused; every error carries the data it speaks of."""

from __future__ import annotations

from typing import NamedTuple

from blf_dsc_controller.errors import BlfDscError

_PARAMETERS = {
    'position': 'limits.position_lower and limits.position_upper',
    'velocity': 'limits.velocity',
    'acceleration': 'limits.acceleration',
}
_UNITS = {'position': 'rad', 'velocity': 'rad/s', 'acceleration': 'rad/s^2'}


class Excess(NamedTuple):
    """A joint that a motion takes past one of its limits: where it does so the most."""

    joint: str
    quantity: str  # position, velocity or acceleration
    value: float  # asked for
    limit: float  # allowed
    time: float  # s
    ratio: float  # of value and limit, counted from the middle of what is allowed

    def __str__(self) -> str:
        """Joint, quantity and figures in words."""
        unit = _UNITS[self.quantity]
        return (
            f'the {self.quantity} of joint {self.joint!r} would be {self.value:.6g} {unit} at '
            f't = {self.time:.6g} s, past its limit of {self.limit:.6g} {unit}'
        )

    @property
    def remedy(self) -> str:
        """The parameters that say how far it may go."""
        return _PARAMETERS[self.quantity]


class MotionError(BlfDscError):
    """A motion that is not made."""


class ReferenceLimitError(MotionError):
    """The reference itself goes past a limit, wherever the arm is."""

    def __init__(self, excess: Excess) -> None:
        self.excess = excess
        super().__init__(
            f'the reference goes past the limits of the arm: {excess}; ask for less, or raise '
            f'{excess.remedy}'
        )


class ApproachError(MotionError):
    """No way to the reference keeps within the limits."""

    def __init__(self, excess: Excess, longest: float) -> None:
        self.excess = excess
        self.longest = longest
        super().__init__(
            f'no motion of at most {longest:g} s from here to the reference keeps within the '
            f'limits of the arm: in the one that comes closest {excess}; start closer and at rest, '
            f'or raise {excess.remedy} or approach.longest'
        )


class TrajectoryError(MotionError):
    """A trajectory that was sent is not followed; the message lists every reason found."""

    def __init__(self, reasons: list[str]) -> None:
        self.reasons = reasons
        super().__init__('trajectory refused: ' + '; '.join(reasons))


class ExcitationError(MotionError):
    """No reference was found that keeps the limits."""

    def __init__(self, starts: int) -> None:
        self.starts = starts
        super().__init__(
            f'no reference was found, in {starts} searches, that keeps positions, velocities, '
            'accelerations and torques within their limits: allow a larger share of the torque, '
            'widen limits, or search from more starts'
        )
