# SPDX-License-Identifier: Apache-2.0
"""The sampled loop against the same equations in continuous time, integrated by scipy."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from closed_loop_case import controller, plant, recommended
from plain_law import dynamics
from scipy.integrate import solve_ivp

from blf_dsc_controller.compiled import cholesky
from blf_dsc_controller.law.controller import Controller

TRUE = np.array([1.0, 0.32, 0.4])
R = 9.8  # 1/s^2
END = 0.5  # s
K, MU, LAMBDA, KP, W, KC = 150.0, 20.0, 0.002, np.array([60.0, 20.0]), 1000.0, 0.002
GAMMA, GAMMA3, KAPPA, RHO = 0.5, 100.0, 20.0, 1e-5
PHI = np.array([[60.0, 5.0, 20.0], [5.0, 1.0, 2.0], [20.0, 2.0, 9.0]])
TIMES = np.linspace(0.0, END, 11)


def reference(t):
    """qr of Section IV and its derivatives."""
    qr = np.array([1.9935, 1.3961]) + 0.3 * np.cos(t)
    return np.array([qr, [-0.3 * np.sin(t)] * 2, [-0.3 * np.cos(t)] * 2])


def surface(xi1, dqr):
    """beta2 of (18) with (15)."""
    s = np.pi * xi1**2 / (2.0 * KC**2)
    return -K * KC**2 / (np.pi * xi1) * np.sin(s) * np.cos(s) - MU * xi1 + dqr


def regressor(q, dq, v, a):
    """H(q, dq, v, a)."""
    parts = [dynamics(e, R, q, dq) for e in np.eye(3)]
    return np.column_stack([M @ a + C @ v + G for M, C, G in parts])


def derivative(t, y):
    """The whole loop: arm (1), filter (13), law (28), learning (20) from a latched window, (30)."""
    q, dq, alpha2, estimate, d3 = np.split(y, [2, 4, 6, 9])
    qr, dqr, ddqr = reference(t)
    xi1, xi2 = q - qr, dq - alpha2
    dalpha2 = (surface(xi1, dqr) - alpha2) / LAMBDA
    H, H_r = regressor(q, dq, alpha2, dalpha2), regressor(qr, dqr, dqr, ddqr)
    barrier = W * xi1 / np.cos(np.pi * xi1**2 / (2.0 * KC**2)) ** 2
    P0 = 0.5 * TRUE
    torque = H @ P0 + H_r @ (estimate - P0) + d3 - KP * xi2 - barrier
    M, C, G = dynamics(TRUE, R, q, dq)
    ddq = np.linalg.solve(M, torque - C @ dq - G - 0.1 - 0.1 * np.sin(t))
    eps = np.linalg.solve(PHI + RHO * np.eye(3), PHI @ (TRUE - estimate))
    learned = GAMMA * KAPPA * eps
    update = learned - GAMMA * H_r.T @ xi2
    return np.concatenate([dq, ddq, dalpha2, update, -GAMMA3 * xi2 - H_r @ learned])


@cache
def continuous():
    """Positions and P^ at TIMES, to a tolerance far below the sampling error."""
    start = np.array([2.293, 1.696])
    qr, dqr, _ = reference(0.0)
    alpha2 = surface(start - qr, dqr)
    y = np.concatenate([start, np.zeros(2), alpha2, 0.5 * TRUE, np.zeros(2)])
    solution = solve_ivp(
        derivative, (0.0, END), y, method='LSODA', rtol=1e-10, atol=1e-13, t_eval=TIMES
    )
    assert solution.success
    return solution.y[:2], solution.y[6:9]


def sampled(dt):
    """The same for the sampled loop with the package's own kernels."""
    settings = recommended(
        bias=False, Gamma=np.full(3, GAMMA), kappa=KAPPA, learning_start=1e9, window=10
    )
    law: Controller = controller(settings)
    law.state.latched[0] = 1.0
    law.state.Phi[:] = PHI
    law.state.b[:] = PHI @ TRUE
    law.state.factor[:] = PHI + RHO * np.eye(3)
    cholesky.factor(law.state.factor)
    arm = plant(sample_time=dt)
    q, estimate = [], []
    stride = round(END / dt / (TIMES.size - 1))
    for k in range(stride * (TIMES.size - 1) + 1):
        measurement = arm.measure()
        if k % stride == 0:
            q.append(measurement[:2].copy())
            estimate.append(law.state.estimate[:3].copy())
        law.update(k * dt, dt, measurement)
        arm.step(law.signals.torque)
    return np.array(q).T, np.array(estimate).T


@pytest.mark.parametrize('quantity', [0, 1], ids=['position', 'estimate'])
def test_sampled_loop_converges_to_the_continuous_one_at_first_order(quantity):
    """Halve the sample time three times; held torque and Euler adaptation are of first order."""
    exact = continuous()[quantity]
    errors = [np.abs(sampled(dt)[quantity] - exact).max() for dt in (1e-3, 5e-4, 2.5e-4, 1.25e-4)]
    order = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(order > 0.9), (errors, order)
    assert errors[-1] < 0.15 * errors[0]
