# SPDX-License-Identifier: Apache-2.0
"""Torque, inertia and excitation along the reference, by the initial estimate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import free_inertias, inertia_matrices, regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled

Floats = NDArray[np.float64]

_POINTS = 400  # along the reference
_LONGEST = 120.0  # s of the reference


class ReferenceLoad(NamedTuple):
    """Torque, inertia and excitation along the reference."""

    torque: Floats  # largest magnitude (n,), N m
    inertia: Floats  # M, where positive definite (k, n, n), kg m^2
    excitation: Floats  # mean of H^T H (p, p)

    def rate(self, settings: Settings) -> float:
        """Return the largest eigenvalue of M^-1 K_p + omega_v, 1/s."""
        # numpy 1 reads a lone matrix as vectors
        Kp = np.diag(settings.feedback.gain)[np.newaxis]
        roots = np.linalg.eigvals(np.linalg.solve(self.inertia, Kp))
        return float(np.abs(roots).max(initial=0.0)) + settings.feedback.damping_rate

    @property
    def free_inertia(self) -> Floats:
        """Smallest inertia (n,) of each joint with the others free, kg m^2."""
        least: Floats = free_inertias(self.inertia).min(axis=0, initial=np.inf)
        return least

    def damping(self, settings: Settings) -> Floats:
        """Return the smallest damping (n,) [N m s/rad], with the other joints free."""
        rate = settings.feedback.damping_rate
        damped = rate * self.free_inertia if rate > 0.0 else 0.0
        return settings.feedback.gain + damped


def reference_load(config: ControllerConfig, settings: Settings) -> ReferenceLoad:
    """Evaluate the dynamics along the reference, over its slowest period."""
    model = settings.model
    P = settings.initial_estimate[: settings.p]
    q, dq, ddq = along(config, _POINTS)
    H = regressors_at(model, q, dq, dq, ddq)
    M = inertia_matrices(model, P, q)
    return ReferenceLoad(
        torque=np.abs(H @ P).max(axis=0),
        inertia=M[np.linalg.eigvalsh(M)[:, 0] > 0.0],
        excitation=np.einsum('kni,knj->ij', H, H) / _POINTS,
    )


def along(config: ControllerConfig, count: int) -> Floats:
    """Return q, dq, ddq (3, k, n) over the whole reference, at most `_LONGEST`."""
    frequencies = [w for w in config.reference.frequency if w > 0.0]
    end = 2.0 * np.pi / min(frequencies, default=1.0)
    if config.reference.type == 'waypoints':
        end = max(config.reference.times)
    times = np.linspace(0.0, min(end, _LONGEST), count, endpoint=False)
    return np.moveaxis(sampled(reference_of(config), times), 1, 0)
