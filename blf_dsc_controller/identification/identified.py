# SPDX-License-Identifier: Apache-2.0
"""An identified arm: its values with their covariance, and the score of its model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.ripple import Ripples
from blf_dsc_controller.identification.stiffness import Compliance
from blf_dsc_controller.identification.values import Parts, indices, parts
from blf_dsc_controller.identification.windows import Carried
from blf_dsc_controller.run import Floats

IDLE = 0.01
"""Of the largest torque, that of a joint that hardly needs one: most of it is noise."""


class Score(NamedTuple):
    """Torques of R windows, and errors on those held back, of a model fitted to the others.

    The models are the URDF, the corrected URDF, and all values.
    """

    time: Floats  # (R,) of the windows, s
    measured: Floats  # (R, n) torque, N m or N
    predicted: Floats  # (3, R, n) by the models
    errors: Floats  # (3, n) rms on the windows held back
    torque: Floats  # (n,) rms likewise
    held_back: tuple[float, float]  # s, from, to

    @property
    def total(self) -> Floats:
        """Errors (3,) of all joints together [% of the rms torque]."""
        squares = np.sum(self.errors**2, axis=1) / np.sum(self.torque**2)
        return np.asarray(100.0 * np.sqrt(squares))

    @property
    def shares(self) -> Floats:
        """Errors (n,) of all values over the torque of the joint, or the least that counts."""
        least = IDLE * self.torque.max()
        return np.asarray(self.errors[2] / np.maximum(self.torque, least))


class Identified(NamedTuple):
    """An identified arm of n bodies; values are ordered as in `Parts`."""

    source: str  # of the torques
    duration: float  # s
    chain: Chain
    parameters: BaseParameters
    prior: Prior  # of the values
    values: Floats  # (17 n + 14,) from all windows in motion
    covariance: Floats  # (17 n + 14, 17 n + 14) given the recording
    left_out: Floats  # (kinds, n) rms torque of what the model leaves out, N m or N
    # (2, n) damping and friction of the corrected URDF, which has no more terms
    dynamics: Floats
    score: Score
    alone: Floats  # (n,) rms errors on the same windows of fits to each joint alone
    distances: Floats  # (n,) at which contacts slide, rad or m; 0: at once
    widths: dict[str, float]  # times the prior's, by group
    outside: tuple[str, ...]  # joints that were mostly outside of their range, in words
    still: tuple[str, ...]  # joints that did not move
    reversed: tuple[str, ...]  # joints whose efforts had the opposite sign
    lasting: Floats  # (n,) correlation length of the residual, s
    rest: float  # s in which no joint moves, which were left out
    clipped: Floats  # (n,) share of the windows in which its torque is clipped
    # share of the URDF's gravity in that of the values; NaN if it would hardly show
    gravity: float
    inertia: float  # share of its other inertial torque, likewise
    other: str  # what explains the torques far better, as a sentence; empty: nothing
    carried: Carried | None  # when the arm carried the load that was weighed
    # of gears, if positions of motors and links are known
    compliance: Compliance | None
    ripples: tuple[Ripples, ...]  # (n,) of the torque

    @property
    def joints(self) -> list[str]:
        """Names of the joints."""
        return [joint.name for joint in self.chain.joints]

    @property
    def parts(self) -> Parts:
        """Parts of the values."""
        return parts(self.values)

    @property
    def deviations(self) -> Parts:
        """Standard deviations of the values."""
        return parts(np.sqrt(np.diag(self.covariance)))

    @property
    def load(self) -> tuple[Floats, Floats]:
        """Mass [kg] and centre (x, y, z) [m] in the tip of the load, and their deviations."""
        at = indices(len(self.chain.joints)).load[:4]
        C = self.covariance[np.ix_(at, at)]
        return mass_and_centre(self.values[at], C, self.chain.tip_placement)


def mass_and_centre(
    values: Floats, covariance: Floats, T: Floats
) -> tuple[Floats, Floats]:
    """Return mass [kg] and centre (x, y, z) [m] in the frame T, and their deviations.

    `values` are mass and first moments (4,) [kg, kg m].
    """
    R = T[:3, :3]
    shift = T[:3, 3]
    m = values[0]
    centre = values[1:] / m
    # c = R^T (h / m - shift):  dc = R^T (dh - (h / m) dm) / m
    J = np.eye(4)
    J[1:] = R.T @ np.column_stack((-centre, np.eye(3))) / m
    deviations = np.sqrt(np.diag(J @ covariance @ J.T))
    return np.append(m, R.T @ (centre - shift)), deviations
