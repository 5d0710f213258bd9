# SPDX-License-Identifier: Apache-2.0
"""The recommended law in numpy, as a control engineer would write it: matrices and `@`.

The peers that bring their own simulator run this law; only the package and the C reference have it
compiled.
"""

from __future__ import annotations

from typing import cast

import numpy as np

from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.law.settings import Settings


class NumpyLaw:
    """The law (28) with composite learning, at a fixed sample time.

    Args:
        settings: of the law, under the package's names.
        sample_time: T [s].
    """

    def __init__(self, settings: Settings, sample_time: float) -> None:
        s = self.s = settings
        self.T = sample_time
        self.theta = settings.initial_estimate.copy()
        self.d3 = np.zeros(s.n)
        self.tau = np.zeros(s.n)
        self.alpha2: np.ndarray | None = None
        self.previous: tuple[np.ndarray, np.ndarray] | None = None
        self.poles = np.zeros((2, s.n, s.m + 1))
        self.ring = np.zeros((s.window, s.n, s.m + 1))
        self.total = np.zeros((s.m + 1, s.m + 1))
        self.samples = 0
        self.latched: tuple[np.ndarray, np.ndarray] | None = None
        self.pole = 1.0 - np.exp(-s.pole * sample_time)
        self.gravity = cast('TwoLink', settings.model).r
        self.share = 1.0 - np.exp(-sample_time / s.time_constant)

    def update(
        self, t: float, qr: np.ndarray, dqr: np.ndarray, q: np.ndarray, dq: np.ndarray
    ) -> np.ndarray:
        """Torque (n,) [N m] for a state and its reference."""
        s = self.s
        xi1 = q - qr
        ratio = xi1 / s.bound
        barrier_part = np.where(np.abs(ratio) < 1.0, 0.5 * s.K * xi1 * np.sinc(ratio**2), 0.0)
        beta2 = dqr - barrier_part - s.mu * xi1
        if self.alpha2 is None:
            self.alpha2 = beta2
        dalpha2 = self.share * (beta2 - self.alpha2) / self.T
        xi2 = dq - self.alpha2
        self._learn(t, q, dq)
        H = self._regressor(q, dq, self.alpha2, dalpha2)
        edge = np.minimum(np.abs(xi1), s.knee)
        barrier = np.sign(xi1) * (
            s.weight * edge / np.cos(0.5 * np.pi * (edge / s.bound) ** 2) ** 2
            + s.slope_limit * (np.abs(xi1) - edge)
        )
        demand = H @ self.theta[: s.p] + self.d3 - s.Kp * xi2 - barrier
        self.tau = np.clip(demand, -s.torque_limit, s.torque_limit)
        self._adapt(H, xi2, saturated=bool((self.tau != demand).any()))
        self.alpha2 = self.alpha2 + self.share * (beta2 - self.alpha2)
        self.samples += 1
        return self.tau

    def _regressor(self, q: np.ndarray, dq: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        r = self.gravity
        c2, s2, c12 = np.cos(q[1]), np.sin(q[1]), np.cos(q[0] + q[1])
        coriolis = s2 * (dq[1] * v[0] + (dq[0] + dq[1]) * v[1])
        return np.array(
            [
                [a[0] + r * np.cos(q[0]), a[0] + a[1], c2 * (2 * a[0] + a[1]) - coriolis + r * c12],
                [0.0, a[0] + a[1], c2 * a[0] + s2 * dq[0] * v[0] + r * c12],
            ]
        )

    def _momentum(self, q: np.ndarray, dq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = self.gravity
        c2, s2, c12 = np.cos(q[1]), np.sin(q[1]), np.cos(q[0] + q[1])
        both = dq[0] + dq[1]
        Yp = np.array([[dq[0], both, c2 * (dq[0] + both)], [0.0, both, c2 * dq[0]]])
        Yr = np.array(
            [
                [r * np.cos(q[0]), 0.0, r * c12, 1.0, 0.0],
                [0.0, 0.0, s2 * dq[0] * both + r * c12, 0.0, 1.0],
            ]
        )
        return Yp, Yr

    def _learn(self, t: float, q: np.ndarray, dq: np.ndarray) -> None:
        s = self.s
        Yp, Yr = self._momentum(q, dq)
        if self.previous is not None:
            X = (Yr + self.previous[1]) / 2.0
            X[:, : s.p] += (Yp - self.previous[0]) / self.T
            row = np.column_stack((X, self.tau))
            self.poles[0] += self.pole * (row - self.poles[0])
            self.poles[1] += self.pole * (self.poles[0] - self.poles[1])
            slot = (self.samples - 1) % s.window
            old = self.ring[slot]
            self.total += self.poles[1].T @ self.poles[1] - old.T @ old
            self.ring[slot] = self.poles[1]
            if self.samples % s.interval == 0 and t >= s.learning_start:
                self._look()
        self.previous = Yp, Yr

    def _look(self) -> None:
        m = self.s.m
        mean = self.total / min(self.samples, self.s.window)
        if np.linalg.eigvalsh(mean[:m, :m])[0] >= self.s.sigma:
            self.latched = mean[:m, :m].copy(), mean[:m, m].copy()

    def _adapt(self, H: np.ndarray, xi2: np.ndarray, *, saturated: bool) -> None:
        s = self.s
        rate = np.zeros(s.m)
        if self.latched is not None:
            Phi, b = self.latched
            rate = s.kappa * np.linalg.solve(Phi + s.rho * np.eye(s.m), b - Phi @ self.theta)
        if not saturated:
            rate[: s.p] -= H.T @ xi2
            self.d3 = self.d3 - self.T * s.gamma * xi2
        self.theta = self.theta + self.T * s.Gamma * rate
        norm = np.linalg.norm(self.theta[: s.p])
        if norm > s.radius:
            self.theta[: s.p] *= s.radius / norm
