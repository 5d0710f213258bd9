# SPDX-License-Identifier: Apache-2.0
"""Torque and excitation of the reference, followed exactly with the initial estimate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.batch import free_inertias, inertia_matrices, regressors_at
from blf_dsc_controller.compiled.layout import pack
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.prediction import rows_along
from blf_dsc_controller.law.settings import FILTERED, Settings
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled

Floats = NDArray[np.float64]

_POINTS = 400  # along the reference
_LONGEST = 120.0  # s of the reference
_FINE = 0.1  # time constants of the regressor's filter between two points of a window ...
_WINDOW_POINTS = 400  # ... which has at least this many
_WINDOWS = 8  # windows that begin within the length of one


class ReferenceLoad(NamedTuple):
    """Torque and inertia of the reference, followed exactly with the initial estimate."""

    torque: Floats  # largest magnitude (n,), N m
    inertia: Floats  # M along the reference, where positive definite (k, n, n), kg m^2

    def rate(self, settings: Settings) -> float:
        """Return the largest eigenvalue of M^-1 K_p + omega_v, 1/s."""
        Kp = np.diag(settings.Kp)[np.newaxis]  # numpy 1 reads a lone matrix as vectors
        roots = np.linalg.eigvals(np.linalg.solve(self.inertia, Kp))
        return float(np.abs(roots).max(initial=0.0)) + settings.damping_rate

    @property
    def free_inertia(self) -> Floats:
        """Smallest inertia (n,) of each joint with the others free, kg m^2."""
        least: Floats = free_inertias(self.inertia).min(axis=0, initial=np.inf)
        return least

    def damping(self, settings: Settings) -> Floats:
        """Return the smallest damping (n,) of each joint with the others free, N m s/rad."""
        rate = settings.damping_rate
        damped = rate * self.free_inertia if rate > 0.0 else 0.0
        return settings.Kp + damped


def reference_load(config: ControllerConfig, settings: Settings) -> ReferenceLoad:
    """Evaluate the dynamics along the reference, over its slowest period."""
    model, P = settings.model, settings.initial_estimate[: settings.p]
    moments = np.linspace(0.0, horizon(config), _POINTS, endpoint=False)
    q, dq, ddq = np.moveaxis(sampled(reference_of(config), moments), 1, 0)
    torque = np.abs(regressors_at(model, q, dq, dq, ddq) @ P).max(axis=0)
    M = inertia_matrices(model, P, q)
    return ReferenceLoad(torque, M[np.linalg.eigvalsh(M)[:, 0] > 0.0])


def windows_along(config: ControllerConfig, settings: Settings) -> Floats:
    """Return Phi (21) (k, m, m) of windows along the exactly followed reference, with filters.

    The first is full after tau_d + T_a, as in the controller; the last ends a slowest period later.
    """
    learning = config.learning
    step = learning.window / max(_WINDOW_POINTS, learning.window * learning.filter_pole / _FINE)
    step = max(step, config.sample_time)
    window, start = round(learning.window / step), round(settings.learning_start / step)
    times = np.arange(start + round(horizon(config) / step) + 1) * step
    motion = sampled(reference_of(config), times)
    rows = rows_along(settings, pack(settings), times, motion)
    if settings.prediction == FILTERED:
        gain = 1.0 - np.exp(-learning.filter_pole * step)
        first, second = np.zeros((2, settings.n, settings.m))
        for row in rows:
            first += gain * (row - first)
            second += gain * (first - second)
            row[:] = second
    found = []
    for end in range(start, times.size, max(1, window // _WINDOWS)):
        X = rows[end - window + 1 : end + 1].reshape(-1, settings.m)
        found.append(X.T @ X / window)
    return np.array(found)


def horizon(config: ControllerConfig) -> float:
    """Return the time [s] that covers the whole reference, at most `_LONGEST`."""
    if config.reference.type == 'waypoints':
        return min(max(config.reference.times), _LONGEST)
    frequencies = [w for w in config.reference.frequency if w > 0.0]
    return min(float(2.0 * np.pi / min(frequencies, default=1.0)), _LONGEST)
