# SPDX-License-Identifier: Apache-2.0
"""The law of an arm from a URDF in plain numpy: the tests' oracle.

It is written from doc/theory.md, learning.md and stability.md, and from the docstrings that they
name.  The regressors are pinocchio's.  Change detection is off.
"""

from __future__ import annotations

import re
from math import exp

import numpy as np
import pinocchio
from symbols import by_symbol

STRIBECK_VELOCITY = 0.1  # rad/s
ENTRIES = ('m', 'm*cx', 'm*cy', 'm*cz', 'Ixx', 'Ixy', 'Iyy', 'Ixz', 'Iyz', 'Izz')


class PlainArm:
    """Regressors of base parameters by name, from the torques of pinocchio's regressor.

    C(q, dq) v is bilinear in dq and v: it follows from c(q, dq) = C(q, dq) dq.
    """

    def __init__(self, model, names):
        self.model = model
        self.data = model.createData()
        self.columns = []  # of pinocchio's regressor, for each name
        self.rotors = []  # a name's place, and its joint
        for k, name in enumerate(names):
            entry, number = re.fullmatch(r'(.*?)(\d+)', name).groups()
            joint = int(number) - 1
            if entry == 'rotor':
                self.columns.append(0)
                self.rotors.append((k, joint))
            else:
                self.columns.append(10 * joint + ENTRIES.index(entry))

    def whole(self, q, dq, ddq):
        """Return the regressor of M ddq + c(q, dq) + G, with a rotor on each joint."""
        full = pinocchio.computeJointTorqueRegressor(self.model, self.data, q, dq, ddq)
        found = full[:, self.columns]
        for k, joint in self.rotors:
            found[:, k] = 0.0
            found[joint, k] = ddq[joint]
        return found

    def at_rate(self, q, dq):
        """Return the regressors of c(q, dq) + G and of G."""
        nothing = np.zeros(len(q))
        return self.whole(q, dq, nothing), self.whole(q, nothing, nothing)

    def coriolis(self, q, dq, v, known=None):
        """Return the regressor of C(q, dq) v + G; `known` is that of `at_rate`, if it is."""
        first, gravity = known or self.at_rate(q, dq)
        nothing = np.zeros(len(q))
        both = self.whole(q, dq + v, nothing)
        second = self.whole(q, v, nothing)
        return 0.5 * (both - first - second + gravity) + gravity

    def regressor(self, q, dq, v, a):
        """Return H: H P = M a + C(q, dq) v + G."""
        nothing = np.zeros(len(q))
        inertial = self.whole(q, nothing, a) - self.whole(q, nothing, nothing)
        return inertial + self.coriolis(q, dq, v)

    def momentum_regressors(self, q, dq):
        """Return Yp and Yr: Yp P = M dq, Yr P = G - C^T dq."""
        n = len(q)
        nothing = np.zeros(n)
        known = self.at_rate(q, dq)
        _, gravity = known
        Yr = gravity.copy()
        for k, unit in enumerate(np.eye(n)):
            Yr[k] -= dq @ (self.coriolis(q, dq, unit, known) - gravity)
        return self.whole(q, nothing, dq) - gravity, Yr


def lag(state, target, gain):
    """Return a first-order lag one step on."""
    return state + gain * (target - state)


def dead_zone(x, band):
    """Return by how much x is outside of [-band, band]."""
    return np.sign(x) * np.maximum(np.abs(x) - band, 0.0)


class Reversals:
    """Coulomb and Stribeck friction of all joints from reversals, and what is used of it."""

    def __init__(self, gains, coulomb):
        g = self.gains = gains
        n = g.n
        self.of = slice(coulomb, coulomb + n)
        self.c0 = g.initial_estimate[self.of].copy()
        self.f = np.sqrt(g.residual_floor / n) / g.row_weight
        self.k = np.zeros(n)
        self.past = np.zeros((n, 2, 3))  # of [[ss, sb, se], [sb, bb, be]]
        self.latest = np.zeros((n, 2, 3))
        self.recent = np.zeros((n, 3))  # p int s_h^2, e_h^2 and 1, faded in 0.1 s
        self.usual = np.zeros((n, 2))  # p int e_h^2 and 1 away from reversals, in 4 s
        self.around = np.zeros((n, 2))  # and around the present reversal
        self.c1 = self.c0.copy()
        self.c2 = self.c0.copy()
        self.delta = np.zeros(n)
        self.least = np.zeros(n)
        self.most = np.zeros(n)
        self.direction = np.zeros(n)
        self.moving = np.zeros(n, bool)
        self.poles = np.zeros((3, n, 2))  # [s b] now, and behind either pole
        self.high = np.zeros((2, n, 3))
        self.age = 0.0

    def shapes(self, velocity):
        """Return s and b (n, 2)."""
        s = np.tanh(velocity / self.gains.coulomb_velocity)
        return np.stack([s, s * np.exp(-((velocity / STRIBECK_VELOCITY) ** 2))], axis=1)

    def compensation(self, theta, velocity):
        """Return C(v) s(v): the value nearest to c_0 among those that the evidence allows."""
        c = theta[self.of]
        claims = (self.c1 - c, self.c2 - c, self.delta, self.least, self.most)
        levels = np.array([c, *(c + dead_zone(claim, self.f) for claim in claims)])
        g = 1.0 + self.k * np.exp(-((velocity / STRIBECK_VELOCITY) ** 2))
        C = np.clip(self.c0, levels.min(axis=0) * g, levels.max(axis=0) * g)
        return C * np.tanh(velocity / self.gains.coulomb_velocity)

    def follow_motion(self, velocity):
        """Begin delta anew where a joint has reversed, and the sums where it begins to."""
        s = np.tanh(velocity / self.gains.coulomb_velocity)
        moving = np.abs(s) > 0.9
        for i in np.flatnonzero(moving & (s * self.direction <= 0.0)):
            self.direction[i] = np.sign(s[i])
            self.least[i] = min(self.least[i], self.delta[i])
            self.most[i] = max(self.most[i], self.delta[i])
            self.delta[i] = 0.0
        for i in np.flatnonzero(self.moving & ~moving):
            self.close(i)
        self.moving = moving

    def observe(self, step, velocity):
        """Add a step of d^3 by the tracking error to delta, until the velocity crosses zero."""
        is_before = velocity * self.direction > 0.0
        self.delta += np.where(is_before, step * self.direction, 0.0)

    def energy(self, i):
        """Return p int (g s)_h^2 dt of the present reversal."""
        weights = np.array([1.0, self.k[i]])
        return weights @ self.latest[i, :, :2] @ weights

    def counted(self, i):
        """Return how much the present reversal counts: 0 until it shows its friction."""
        energy = self.energy(i)
        if energy <= 0.0:
            return 0.0
        torque = np.array([1.0, self.k[i]]) @ self.latest[i, :, 2]
        misfit = self.around[i, 0] - torque**2 / energy
        if self.usual[i, 1] > 0.0:
            misfit -= 2.0 * self.around[i, 1] * self.usual[i, 0] / self.usual[i, 1]
        pull = 0.015 * self.f[i] ** 2 / self.gains.variance[self.of][i]
        c = (self.past[i, 0, 2] + pull * self.c0[i]) / (self.past[i, 0, 0] + pull)
        allowed = (0.5 * self.f[i]) ** 2 + (2.0 * c) ** 2
        share = allowed / (allowed + max(0.0, misfit) / energy)
        return share if share * energy > 0.05 else 0.0

    def close(self, i):
        """Add the present reversal to the past ones, if it has shown its friction."""
        share = self.counted(i)
        if share == 0.0:
            return
        total = self.past[i, 0, 0] + share * self.latest[i, 0, 0]
        if total > 1.0:
            self.past[i] *= max(0.0, 1.0 - (total - 1.0) / self.past[i, 0, 0])
        self.past[i] += share * self.latest[i]
        self.latest[i] = 0.0
        self.around[i] = 0.0
        c, k = self.solution(i)
        apart = dead_zone(np.array([self.c1[i], self.c2[i]]) - c, self.f[i])
        if apart[0] * apart[1] > 0.0:
            level = 0.5 * (self.c1[i] + self.c2[i])
            self.past[i, :, 2] = self.past[i, :, :2] @ [level, level * k]

    def add_around(self, i, products, dt):
        """Add p (s_h^2, e_h^2, 1) dt to what is around the reversal, or else to the usual."""
        was_near = self.recent[i, 0] > 0.004
        self.recent[i] = exp(-dt / 0.1) * self.recent[i] + products
        if self.recent[i, 0] <= 0.004:
            self.usual[i] = exp(-dt / 4.0) * self.usual[i] + products[1:]
        else:
            self.around[i] += products[1:] if was_near else self.recent[i, 1:]

    def solution(self, i):
        """Return c and k by all sums."""
        g = self.gains
        pull = 0.015 * self.f[i] ** 2 / g.variance[self.of][i]
        sums = self.past[i] + self.counted(i) * self.latest[i]
        A = sums[:, :2] + np.diag([pull, 0.1 * pull])
        B = sums[:, 2] + np.array([pull * self.c0[i], 0.0])
        c, extra = np.linalg.solve(A, B)
        k = np.clip(extra / c, 0.0, 1.0) if c > 0.0 else float(extra > 0.0)
        g_of = np.array([1.0, k])
        return (g_of @ B) / (g_of @ A @ g_of), k

    def filter(self, dq, pole):
        """Pass the shapes of the measured velocity through the poles of the row."""
        now = self.shapes(dq)
        mean = 0.5 * (now + self.poles[0])
        self.poles[0] = now
        self.poles[1] = lag(self.poles[1], mean, pole)
        self.poles[2] = lag(self.poles[2], self.poles[1], pole)

    def measure(self, row, theta, dt, *, latched):
        """Add the unweighted row, `dt` after the one before it."""
        g = self.gains
        self.age = self.age + dt if latched else 0.0
        others = theta.copy()
        x = np.zeros((g.n, 3))
        x[:, :2] = self.poles[2]
        for i in range(g.n):
            others[self.of] = theta[self.of]
            others[self.of.start + i] = 0.0
            x[i, 2] = row[i, -1] - row[i, :-1] @ others
        gain = 1.0 - exp(-g.pole * dt)
        if self.age <= g.learning_start - g.window * dt:
            self.high[0] = x
            self.high[1] = 0.0
            return
        for k in range(2):
            self.high[k] = lag(self.high[k], x, gain)
            x = x - self.high[k]
        for i in range(g.n):
            was_shown = self.counted(i) > 0.0
            self.latest[i] += g.pole * dt * np.outer(x[i, :2], x[i])
            self.add_around(
                i, g.pole * dt * np.array([x[i, 0] ** 2, x[i, 2] ** 2, 1.0]), dt
            )
            if self.counted(i) == 0.0:
                continue
            if not was_shown:
                self.c2[i] = self.c1[i]
                self.least[i] = 0.0
                self.most[i] = 0.0
            energy = self.energy(i)
            c = np.array([1.0, self.k[i]]) @ self.latest[i, :, 2] / energy
            self.c1[i] = np.clip(c, g.least[self.of][i], g.most[self.of][i])


class PlainUrdfLaw:
    """The law (28) with learning, in the order of 'One sample, in order'."""

    def __init__(self, settings, arm):
        g = self.gains = by_symbol(settings)
        n = g.n
        m = g.m
        self.arm = arm
        self.theta = g.initial_estimate.copy()
        self.d3 = np.zeros(n)
        self.alpha2 = None
        self.tau = np.zeros(n)  # the whole torque of the last interval, as far as known
        self.added = np.zeros(n)
        self.late = None
        self.samples = 0
        self.previous = None
        self.pole1 = np.zeros((n, m + 1))
        self.pole2 = np.zeros((n, m + 1))
        self.rows = []
        self.latched = None
        self.active = np.ones(m, bool)
        self.is_checked = False
        self.direction = np.full(m, 1.0 / np.sqrt(m))
        self.viscous = slice(g.p, g.p + n)
        self.reversals = Reversals(g, g.p + n)
        loads = n * g.load_friction
        self.load = slice(g.p + 2 * n, g.p + 2 * n + loads)
        self.ripple = slice(self.load.stop, g.m)
        self.gear_torque = np.zeros(n)

    # Learning

    def ripple_at(self, q):
        """Return the columns of the ripple at this position."""
        n = self.gains.n
        blocks = [np.zeros((n, 0))]
        for cycles in self.gains.ripple_cycles:
            blocks += [np.diag(np.sin(cycles * q)), np.diag(np.cos(cycles * q))]
        return np.hstack(blocks)

    def load_friction_at(self, velocity):
        """Return the columns of friction that grows with the load, if there are any."""
        g = self.gains
        rubs = np.abs(self.gear_torque) * np.tanh(velocity / g.coulomb_velocity)
        return np.diag(rubs)[:, : g.n * g.load_friction]

    def add_row(self, dt, q, dq, dqr, applied):
        """Filter the row of the last interval, and put every k-th into the window."""
        g = self.gains
        Yp, Yr = self.arm.momentum_regressors(q, dq)
        columns = np.diag(dq), np.diag(np.tanh(dq / g.coulomb_velocity))
        ripple = self.ripple_at(q - 0.5 * g.lag * dq)
        load = self.load_friction_at(dq)
        now = Yp, np.column_stack([Yr, *columns, load, ripple])
        pole = 1.0 - exp(-g.pole * dt)
        if self.samples:
            late = 1.0 - exp(-dt / (0.5 * g.lag))
            if self.late is None:
                self.late = [applied, applied]
            self.late[0] = lag(self.late[0], applied, late)
            self.late[1] = lag(self.late[1], self.late[0], late)
            X = 0.5 * (now[1] + self.previous[1])
            X[:, : g.p] += (Yp - self.previous[0]) / dt
            row = np.column_stack([X, self.late[1]])
            self.pole1 = lag(self.pole1, row, pole)
            self.pole2 = lag(self.pole2, self.pole1, pole)
        self.previous = now
        self.reversals.filter(dq, pole)
        if self.samples and self.samples % g.row_interval == 0:
            weight = g.row_weight * np.abs(dqr) / np.hypot(dqr, g.motion_scale)
            self.rows.append(weight[:, None] * self.pole2)
            del self.rows[: -g.window]
            self.reversals.measure(
                self.pole2,
                self.theta,
                g.row_interval * dt,
                latched=self.latched is not None,
            )

    def excitation(self, iterations):
        """Return lambda_min of the window; keep its Phi, b without rejected columns."""
        g = self.gains
        R = g.information
        rows = np.concatenate(self.rows)
        mean = rows.T @ rows / len(self.rows)
        Phi = mean[:-1, :-1] + g.prior_weight * R
        b = mean[:-1, -1] + g.prior_weight * R @ g.initial_estimate
        for j in np.flatnonzero(~self.active):
            Phi[j] = 0.0
            Phi[:, j] = 0.0
            Phi[j, j] = 1.0
            b[j] = 0.0
        self.window = Phi, b
        inverse = np.linalg.inv(Phi + g.rho * R)
        for _ in range(iterations):
            self.direction = inverse @ (R @ self.direction)
            self.direction /= np.sqrt(self.direction @ R @ self.direction)
        x = self.direction / np.sqrt(self.direction @ R @ self.direction)
        return x @ Phi @ x

    def restart(self):
        """Begin the inverse iteration from the first direction."""
        self.direction = np.full(self.gains.m, 1.0 / np.sqrt(self.gains.m))

    def reject_columns(self):
        """Reject columns until the rest of a window that excites the parameters is excited."""
        g = self.gains
        self.active[g.p :] = False
        self.restart()
        is_excited = self.excitation(60) >= g.sigma
        self.active[g.p :] = True
        self.is_checked = is_excited
        while is_excited:
            self.restart()
            if self.excitation(60) >= g.sigma or not self.active[g.p :].any():
                return
            strength = np.abs(self.direction) * self.active
            self.active[g.p + np.argmax(strength[g.p :])] = False
        self.restart()

    def check_window(self, t):
        """Latch the window if it is full and excited."""
        g = self.gains
        is_full = len(self.rows) == g.window and t >= g.learning_start
        cursor = self.written % g.window
        wraps = cursor * g.row_interval < g.interval
        is_due = not self.is_checked or (wraps and not self.active.all())
        if is_full and is_due:
            self.reject_columns()
        if self.excitation(4) >= g.sigma and is_full:
            self.latched = self.window

    # Torque

    def barrier_torque(self, xi1, t):
        """Return tau_c of (16), a straight line beyond the knee."""
        g = self.gains
        k = g.bound + (g.initial_bound - g.bound) * np.exp(-g.funnel_rate * t)
        edge = np.minimum(np.abs(xi1), g.knee / g.bound * k)
        inside = g.weight * edge / np.cos(np.pi * edge**2 / (2.0 * k**2)) ** 2
        return -np.sign(xi1) * (inside + g.slope_limit * (np.abs(xi1) - edge))

    def virtual_control(self, xi1, dqr, t):
        """Return beta2 of (15), (18)."""
        g = self.gains
        wider = (g.initial_bound - g.bound) * np.exp(-g.funnel_rate * t)
        k = g.bound + wider
        inside = np.where(np.abs(xi1) < k, np.sinc(xi1**2 / k**2), 0.0)
        return (
            dqr
            - 0.5 * g.K * xi1 * inside
            - g.mu * xi1
            - g.funnel_rate * wider / k * xi1
        )

    def virtual_slope(self, xi1, t):
        """Return minus the derivative of beta2 by xi1."""
        g = self.gains
        wider = (g.initial_bound - g.bound) * np.exp(-g.funnel_rate * t)
        x = np.pi * (xi1 / (g.bound + wider)) ** 2
        inside = np.where(x < np.pi, 2.0 * np.cos(x) - np.sinc(x / np.pi), 0.0)
        return 0.5 * g.K * inside + g.mu + g.funnel_rate * wider / (g.bound + wider)

    def model_motion(self, dqr, ddqr, dalpha2, xi2, barrier):
        """Return v and a of the model: with the feedback that acts through the inertia."""
        g = self.gains
        if g.decoupled:
            return dqr, ddqr
        a = dalpha2 - g.damping_rate * xi2
        if g.follows_inertia:
            a = a + barrier / g.joint_inertia
        return self.alpha2, a

    def update(self, t, dt, qr, dqr, ddqr, measurement):
        """Return the command for a measurement; all is in the order of the page."""
        g = self.gains
        p = g.p
        q, dq, _ = np.reshape(measurement, (3, g.n)).copy()
        added = self.gravity_of_drives(q)
        applied = self.tau + 0.5 * (self.added + added)
        self.added = added
        xi1 = q - qr
        beta2 = self.virtual_control(xi1, dqr, t)
        known = np.zeros(g.n)
        if g.known_rate:
            late = 0.5 * g.lag * ddqr
            beta2 = beta2 - late
            known = ddqr - self.virtual_slope(xi1, t) * (dq - dqr + late)
        if self.alpha2 is None:
            self.alpha2 = beta2
        share = 1.0 - exp(-dt / g.time_constant)
        dalpha2 = share * (beta2 - self.alpha2) / dt + known
        xi2 = dq - self.alpha2
        barrier = self.barrier_torque(xi1, t)
        v, a = self.model_motion(dqr, ddqr, dalpha2, xi2, barrier)
        H = self.arm.regressor(q, dq, v, a)
        H_r = np.zeros((g.n, g.m))
        H_r[:, :p] = self.arm.regressor(qr, dqr, dqr, ddqr)
        lead = 1.5 * dt + 0.5 * g.lag
        ahead = dqr + lead * ddqr
        H_r[:, self.viscous] = np.diag(ahead)
        self.gear_torque = H_r[:, :p] @ self.theta[:p]
        H_r[:, self.load] = self.load_friction_at(ahead)
        there = qr + lead * dqr + 0.5 * lead**2 * ddqr
        H_r[:, self.ripple] = self.ripple_at(there)
        coulomb = self.reversals.compensation(self.theta, ahead)
        self.reversals.follow_motion(ahead)
        self.add_row(dt, q, dq, dqr, applied)
        self.written = self.samples // g.row_interval
        if self.rows and self.samples % g.interval == 0:
            self.check_window(t)
        P0 = g.initial_estimate[:p]
        demand = (
            (0.0 if g.follows_inertia else barrier)
            - g.d2 * np.abs(xi1) * np.clip(xi2 / 0.01, -1.0, 1.0)
            - g.Kp * xi2
            + H @ P0
            - H_r[:, :p] @ P0
            + H_r @ self.theta
            + coulomb
            + self.d3
        )
        low = np.maximum(-g.torque_limit, added - g.torque_limit)
        high = np.minimum(g.torque_limit, added + g.torque_limit)
        torque = np.clip(demand, low, high)
        is_cut = np.any(torque != demand)
        self.adapt(dt, q, H_r, xi2, ahead, coulomb, is_cut=is_cut)
        self.alpha2 = self.alpha2 + share * (beta2 - self.alpha2) + dt * known
        self.samples += 1
        self.tau = torque - added
        self.xi1 = xi1
        self.xi2 = xi2
        return self.tau

    def gravity_of_drives(self, q):
        """Return what the drives add to the command: the gravity of the URDF, or nothing."""
        if self.gains.drive == 0:
            return np.zeros(len(q))
        return pinocchio.computeGeneralizedGravity(self.arm.model, self.arm.data, q)

    def adapt(self, dt, q, H_r, xi2, ahead, coulomb, *, is_cut):
        """Advance theta, k and d3."""
        g = self.gains
        friction = self.reversals
        columns = friction.of
        rate = np.zeros(g.m)
        change = np.zeros(g.n)
        if self.latched is not None:
            Phi, b = self.latched
            # factored with the columns that are active at the latch
            rate = np.linalg.solve(Phi + g.rho * g.information, b - Phi @ self.theta)
            for i in np.flatnonzero(self.active[columns]):
                c, k = friction.solution(i)
                rate[columns.start + i] = c - self.theta[columns.start + i]
                change[i] = k - friction.k[i]
        tracking = np.zeros(g.m)
        if not is_cut:
            tracking[: g.p] = -(g.variance * (H_r.T @ xi2))[: g.p]
            rate_of_d3 = g.gamma * (xi2 + g.eta * self.d3)
            if g.follows_inertia:
                Yp, _ = self.arm.momentum_regressors(q, rate_of_d3 / g.joint_inertia)
                rate_of_d3 = Yp @ g.initial_estimate[: g.p]
            step = -dt * rate_of_d3
            self.d3 = self.d3 + step
            friction.observe(step, ahead)
        v = g.Gamma * (g.kappa * rate + tracking)
        by_tracking = self.theta + dt * g.Gamma * tracking
        assert np.linalg.norm(self.theta[: g.p]) < g.radius
        self.theta = np.clip(self.theta + dt * v, g.least, g.most)
        if self.latched is not None:
            linear = np.ones(g.m)
            linear[columns] = 0.0
            self.d3 = self.d3 - (H_r * linear) @ (self.theta - by_tracking)
        friction.k = friction.k + dt * g.kappa * change
        after = friction.compensation(self.theta, ahead)
        self.d3 = self.d3 - (after - coulomb)
        self.disturbance = self.d3 + H_r[:, g.p :] @ self.theta[g.p :] + after
