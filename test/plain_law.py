# SPDX-License-Identifier: Apache-2.0
"""The law in plain numpy, as a control engineer would write it, sharing nothing with the package.

It is the tests' oracle, and the law of every peer in benchmark/ that is only a
simulator.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigvalsh
from scipy.optimize import brentq
from symbols import by_symbol

R = 9.8  # 1/s^2, g / l1 of Section IV


def dynamics(P, r, q, dq):
    """Return M, C, G of the two-link arm."""
    c = P[2] * np.sin(q[1])
    coupling = P[2] * np.cos(q[1])
    M = np.array(
        [[P[0] + P[1] + 2.0 * coupling, P[1] + coupling], [P[1] + coupling, P[1]]]
    )
    C = np.array([[-c * dq[1], -c * (dq[0] + dq[1])], [c * dq[0], 0.0]])
    outer = P[2] * r * np.cos(q[0] + q[1])
    return M, C, np.array([P[0] * r * np.cos(q[0]) + outer, outer])


def regressor(r, q, dq, v, a):
    """Return H of Section IV, with cos q1 in its first gravity term."""
    c2 = np.cos(q[1])
    s2 = np.sin(q[1])
    c12 = np.cos(q[0] + q[1])
    coriolis = s2 * (dq[1] * v[0] + (dq[0] + dq[1]) * v[1])
    return np.array(
        [
            [
                a[0] + r * np.cos(q[0]),
                a[0] + a[1],
                c2 * (2 * a[0] + a[1]) - coriolis + r * c12,
            ],
            [0.0, a[0] + a[1], c2 * a[0] + s2 * dq[0] * v[0] + r * c12],
        ]
    )


class PlainLaw:
    """The law as it is written, with settings by the paper's symbols."""

    def __init__(self, settings):
        self.gains = g = by_symbol(settings)
        self.theta = settings.initial_estimate.copy()
        self.d3 = np.zeros(2)
        self.tau = np.zeros(2)
        self.held = np.zeros(2)  # of the demand, by the rate limit
        self.alpha2 = None
        self.previous = None
        self.ring = np.zeros((g.window, 2, settings.m + 1))
        self.total = np.zeros((settings.m + 1, settings.m + 1))
        self.rows = 0
        self.latched = None
        self.samples = 0
        self.pole1 = self.pole2 = np.zeros((2, settings.m + 1))

    def bound(self, t):
        """Return k(t) and its derivative."""
        g = self.gains
        wider = (g.initial_bound - g.bound) * np.exp(-g.funnel_rate * t)
        return g.bound + wider, -g.funnel_rate * wider

    def barrier_torque(self, xi1, t):
        """Return tau_c of (16) with its weight, a straight line beyond the knee."""
        g = self.gains
        k, _ = self.bound(t)
        edge = np.minimum(np.abs(xi1), g.knee / g.bound * k)
        inside = g.weight * edge / np.cos(np.pi * edge**2 / (2.0 * k**2)) ** 2
        return -np.sign(xi1) * (inside + g.slope_limit * (np.abs(xi1) - edge))

    def virtual_control(self, xi1, dqr, t):
        """Return beta2 of (18) with (15) as printed, which needs a nonzero error."""
        g = self.gains
        k, dk = self.bound(t)
        s = np.pi * xi1**2 / (2.0 * k**2)
        tau_aux = -g.K * k**2 / (xi1 * np.pi) * np.sin(s) * np.cos(s)
        return np.where(np.abs(xi1) < k, tau_aux, 0.0) - g.mu * xi1 + dqr + xi1 * dk / k

    def virtual_slope(self, xi1, t):
        """Return the derivative of beta2 by the error, which is not zero."""
        g = self.gains
        k, dk = self.bound(t)
        s = np.pi * xi1**2 / (2.0 * k**2)
        inside = g.K * k**2 / (np.pi * xi1**2) * np.sin(s) * np.cos(s)
        inside = inside - g.K * np.cos(2.0 * s)
        return np.where(np.abs(xi1) < k, inside, 0.0) - g.mu + dk / k

    def momentum_regressors(self, t, q, dq):
        """Return Yp and [Yr | D], with the columns D of the disturbance."""
        r, g = self.gains.model.r, self.gains
        c2 = np.cos(q[1])
        s2 = np.sin(q[1])
        c12 = np.cos(q[0] + q[1])
        both = dq[0] + dq[1]
        Yp = np.array([[dq[0], both, c2 * (dq[0] + both)], [0.0, both, c2 * dq[0]]])
        Yr = np.array(
            [[r * np.cos(q[0]), 0.0, r * c12], [0.0, 0.0, s2 * dq[0] * both + r * c12]]
        )
        columns = [np.eye(2)] * g.bias + [np.diag(dq)] * g.viscous
        columns += [
            np.eye(2) * f(w * t) for w in g.frequencies for f in (np.sin, np.cos)
        ]
        return Yp, np.column_stack([Yr, *columns])

    def learn(self, t, dt, q, dq, dqr, applied):
        """Filter the row of the last interval into the window.

        When due, latch the window.
        """
        g = self.gains
        Yp, Yr = self.momentum_regressors(t, q, dq)
        if self.previous is not None:
            X = (Yr + self.previous[1]) / 2.0
            X[:, :3] += (Yp - self.previous[0]) / dt
            pole = 1.0 - np.exp(-g.pole * dt)
            self.pole1 = self.pole1 + pole * (
                np.column_stack([X, applied]) - self.pole1
            )
            self.pole2 = self.pole2 + pole * (self.pole1 - self.pole2)
            if self.samples % g.row_interval == 0:
                slow = (
                    np.abs(dqr) / np.hypot(dqr, g.motion_scale)
                    if g.motion_scale
                    else np.ones(2)
                )
                self.push((g.row_weight * slow)[:, None] * self.pole2)
            if self.samples % g.interval == 0 and t >= g.learning_start:
                self.latch_if_excited()
        self.previous = Yp, Yr

    def push(self, row):
        """Replace the oldest row of the window."""
        oldest = self.ring[self.rows % len(self.ring)]
        self.total = self.total + row.T @ row - oldest.T @ oldest
        self.ring[self.rows % len(self.ring)] = row
        self.rows += 1

    def latch_if_excited(self):
        """Latch the window if it is excited, by (21), (22), (26), (27), with a prior's pull."""
        g = self.gains
        mean = self.total / min(self.rows, g.window)
        Phi = mean[:-1, :-1] + g.prior_weight * g.information
        b = mean[:-1, -1] + g.prior_weight * g.information @ g.initial_estimate
        if eigvalsh(Phi, g.information)[0] >= g.sigma:
            self.latched = Phi, b

    def adapt(self, dt, q, H, xi2, *, saturated):
        """Update by (20), its sign corrected and projected in the Gamma metric, and by (30)."""
        g = self.gains
        v = np.zeros(g.m)
        if self.latched is not None:
            Phi, b = self.latched
            eps = b - Phi @ self.theta
            v += g.kappa * np.linalg.solve(Phi + g.rho * g.information, eps)
        tracking = np.zeros(g.m)
        if not saturated:
            tracking[:3] = -(g.variance * (H.T @ xi2))[:3]
            rate = g.gamma * (xi2 + g.eta * self.d3)
            if g.follows_inertia:
                Yp, _ = self.momentum_regressors(0.0, q, rate / g.joint_inertia)
                rate = Yp @ g.initial_estimate[:3]
            self.d3 = self.d3 - dt * rate
        v = g.Gamma * (v + tracking)
        by_tracking = self.theta + dt * g.Gamma * tracking
        w = self.theta[:3].copy()
        if w @ w >= g.radius**2 * (1.0 - 1e-12) and w @ v[:3] > 0.0:
            v[:3] -= g.Gamma[:3] * w * (w @ v[:3]) / (w @ (g.Gamma[:3] * w))
        self.theta = np.clip(self.theta + dt * v, g.least, g.most)
        w = self.theta[:3].copy()
        gain = np.array(g.Gamma[:3])
        if np.linalg.norm(w) > g.radius:
            # Nearest point of the ball, from the multiplier that puts it on the sphere.
            out = lambda nu: np.linalg.norm(w / (1.0 + nu * gain)) - g.radius  # noqa: E731
            self.theta[:3] = w / (1.0 + brentq(out, 0.0, 1e9, xtol=1e-18) * gain)
        if self.latched is not None:
            self.d3 = self.d3 - H @ (self.theta - by_tracking)

    def update(self, t, dt, qr, dqr, ddqr, measurement):
        """Return the torque (28); the caller sets `tau`, the last one sent.

        What is learned acts along the reference.
        """
        g = self.gains
        q, dq, _ = np.reshape(measurement, (3, 2)).copy()
        self.xi1 = xi1 = q - qr
        beta2 = self.virtual_control(xi1, dqr, t)
        if self.alpha2 is None:
            self.alpha2 = beta2
        known = np.zeros(2)
        if g.known_rate:
            known = ddqr + self.virtual_slope(xi1, t) * (dq - dqr)
        lagging = (self.alpha2 - beta2) * np.exp(-dt / g.time_constant)
        following = beta2 + lagging + dt * known
        dalpha2 = (following - self.alpha2) / dt
        self.xi2 = xi2 = dq - self.alpha2
        self.learn(t, dt, q, dq, dqr, self.tau)
        r, P0 = g.model.r, g.initial_estimate[:3]
        barrier = self.barrier_torque(xi1, t)
        v, a = (dqr, ddqr) if g.decoupled else (self.alpha2, dalpha2)
        damped = a - g.damping_rate * xi2
        if g.follows_inertia:
            damped = damped + barrier / g.joint_inertia
            barrier = np.zeros(2)
        H = regressor(r, q, dq, v, damped)
        H_r = np.zeros((2, g.m))
        H_r[:, :3] = regressor(r, qr, dqr, dqr, ddqr)
        if g.viscous:
            ahead = dqr + (1.5 * dt + 0.5 * g.lag) * ddqr
            H_r[:, 3 + 2 * g.bias :][:, :2] = np.diag(ahead)
        demand = (
            barrier
            - g.d2 * np.abs(xi1) * np.clip(xi2 / 0.01, -1.0, 1.0)
            - g.Kp * xi2
            + H @ P0
            - H_r[:, :3] @ P0
            + H_r @ self.theta
            + self.d3
        )
        torque = np.clip(demand, -g.torque_limit, g.torque_limit)
        if self.samples:
            step = np.where(g.rate_limit > 0.0, g.rate_limit * dt, np.inf)
            left = self.held - np.clip(self.held, -0.5 * step, 0.5 * step)
            slowed = np.clip(torque - left, self.tau - step, self.tau + step)
            self.held, torque = torque - slowed, slowed
        self.adapt(dt, q, H_r, xi2, saturated=np.any(torque != demand))
        self.disturbance = self.d3 + H_r[:, 3:] @ self.theta[3:]
        self.alpha2 = following
        self.samples += 1
        return torque
