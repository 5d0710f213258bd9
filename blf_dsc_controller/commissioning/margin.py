# SPDX-License-Identifier: Apache-2.0
"""The modulus margin of measured arms with the law, by its gains.

With responses G_y, G_v and the law's C_y, C_v (`arms.linear_loop`) the loop, cut at the
torques of all joints, is L = C_y G_y + C_v G_v, and the modulus margin is the least
singular value of I + L over the frequencies, less what noise may make of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import JointGains, linear
from blf_dsc_controller.arms.linear_loop import (
    SLOWEST,
    Joints,
    Loop,
    Timing,
    law_responses,
)
from blf_dsc_controller.commissioning.response import DEVIATIONS, Response

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

BARELY = 0.1
"""Modulus margin, noise not counted, with which an arm nearly oscillates."""


class Margin(NamedTuple):
    """A modulus margin, and where it is least."""

    value: float
    frequency: float  # Hz
    posture: int
    joint: int  # with the largest part in it


class SingularValues(NamedTuple):
    """The least singular value of I + L in one posture, at f frequencies."""

    least: Floats  # (f,)
    doubt: Floats  # (f,), what noise may take from it
    direction: Complex  # (f, n), of the torques that it belongs to

    def margin(
        self,
        frequency: Floats,
        counts: NDArray[np.bool_],
        posture: int,
        *,
        noise: bool = True,
    ) -> Margin:
        """Return the margin over the frequencies (f,) [Hz] that count.

        The `noise` is counted against it or not; `posture` is the number of this one.
        """
        left = np.where(counts, self.least - noise * self.doubt, np.inf)
        at = int(left.argmin())
        joint = int(np.abs(self.direction[at]).argmax())
        return Margin(float(left[at]), float(frequency[at]), posture, joint)


def singular_values(
    L: Complex, dL: Floats, shared: NDArray[np.bool_]
) -> SingularValues:
    """Return the least singular values of I + L (f, n, n).

    `dL` (f, n, n) are the standard deviations of L, and `shared` as in `Response`.
    """
    left, values, right = np.linalg.svd(np.eye(L.shape[-1]) + L)
    # u^H (I + L) v changes by u^H dL v; what two share changes in both at once
    parts = np.abs(left[:, :, -1, None]) * dL * np.abs(right[:, -1, None, :])
    both = parts + np.swapaxes(parts, 1, 2)
    squares = np.where(shared, 0.5 * both**2, parts**2)
    doubt = DEVIATIONS * np.sqrt(squares.sum(axis=(1, 2)))
    return SingularValues(values[:, -1], np.asarray(doubt), right[:, -1].conj())


class Loops(NamedTuple):
    """Measured arms in k postures, and the law by its gains."""

    responses: Sequence[Response]
    inertia: Floats  # (n,) kg m^2, the largest of each joint
    sample_time: float  # s

    def singular_values(self, gains: JointGains) -> list[SingularValues]:
        """Return the least singular values of I + L in each posture."""
        return [self._singular_values(each, gains) for each in self.responses]

    def margin(self, gains: JointGains, *, noise: bool = True) -> Margin:
        """Return the margin of gains, `noise` counted against it or not."""
        margins = []
        for k, (response, values) in enumerate(
            zip(self.responses, self.singular_values(gains), strict=True)
        ):
            counts = response.seen & (response.frequency >= SLOWEST)
            margins.append(values.margin(response.frequency, counts, k, noise=noise))
        return min(margins)

    def _singular_values(self, response: Response, gains: JointGains) -> SingularValues:
        C_y, C_v = self.law(response, gains)
        L = C_y @ response.position + C_v @ response.velocity
        position, velocity = response.deviations()
        dL = np.abs(C_y) @ position + np.abs(C_v) @ velocity
        return singular_values(L, dL, response.shared)

    def law(self, response: Response, gains: JointGains) -> tuple[Complex, Complex]:
        """Return C_y [N m/rad] and C_v [N m s/rad] (f, n, n) at the frequencies of a response."""
        s: Complex = np.asarray(2j * np.pi * response.frequency, complex)
        feedback = linear(gains, self.inertia, 1)
        C_y, C_v = (each[0] for each in law_responses(feedback, self.sample_time, s))
        return C_y, C_v


class RigidArm(NamedTuple):
    """Rigid joints without friction, the others held: what inertias and lags alone bear."""

    inertias: Floats  # (n,) kg m^2, the least of each joint
    timing: Timing

    def margin(self, gains: JointGains, inertia: Floats) -> float:
        """Return the modulus margin of gains; 0 if a loop is unstable.

        `inertia` (n,) [kg m^2] is the largest of each joint.
        """
        nothing = np.zeros(len(inertia))
        M = np.diag(self.inertias)[None]
        joints = Joints(motors=nothing, viscous=nothing)
        return Loop(M, joints, self.timing, linear(gains, inertia, 1)).margin().value
