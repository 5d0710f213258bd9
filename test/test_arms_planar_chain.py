# SPDX-License-Identifier: Apache-2.0
"""The n-link planar arm against its Lagrangian and against the two-link arm it generalises."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.arms.planar_chain import PlanarChain
from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build, flatten, parameters
from blf_dsc_controller.law.factory import controller_of

R = 9.8  # 1/s^2, r = g / l1 with l1 = 1 m
SIZES = (1, 2, 3, 7)

PER_JOINT = {
    item.name: flatten(ControllerConfig())[item.name][0]
    for item in parameters(ControllerConfig)
    if item.length == ('joints',) and not item.omittable and not item.name.startswith('reference')
}
"""Every parameter with one value per joint, and the first value of its default."""


def case(n):
    """Random lengths (l1 = 1 m), masses, and a state of n joints."""
    random = np.random.default_rng(n)
    lengths = np.concatenate(([1.0], random.uniform(0.3, 1.2, n - 1)))
    masses = random.uniform(0.2, 1.5, n)
    beyond = np.cumsum(masses[::-1])[::-1]
    P = np.array([beyond[j] * lengths[i] * lengths[j] for i in range(n) for j in range(i, n)])
    return lengths, masses, P, random.normal(size=(4, n))


def regressor(q, dq, v, a):
    arm = PlanarChain(q.size, R)
    H = np.full((q.size, len(arm.parameter_names)), np.nan)
    arm.regressor(q, dq, v, a, H)
    return H


def momentum(q, dq):
    arm = PlanarChain(q.size, R)
    Yp, Yr = np.full((2, q.size, len(arm.parameter_names)), np.nan)
    arm.momentum_regressor(q, dq, Yp, Yr)
    return Yp, Yr


def energies(lengths, masses, q, dq):
    """Kinetic and potential energy from the Cartesian positions of the masses, complex-safe."""
    phi, w = np.cumsum(q), np.cumsum(dq)
    x = np.cumsum(-lengths * np.sin(phi) * w), np.cumsum(lengths * np.cos(phi) * w)
    kinetic = 0.5 * np.sum(masses * (x[0] ** 2 + x[1] ** 2))
    return kinetic, 9.8 * np.sum(masses * np.cumsum(lengths * np.sin(phi)))


def complex_gradient(function, x):
    """Gradient by complex steps of 1e-30, exact to rounding."""
    steps = 1e-30j * np.eye(x.size)
    return np.array([function(x + step).imag for step in steps]) / 1e-30


@pytest.mark.parametrize('n', SIZES)
def test_momentum_and_gravity_agree_with_the_lagrangian(n):
    lengths, masses, P, (q, dq, _, _) = case(n)
    Yp, Yr = momentum(q, dq)

    p = complex_gradient(lambda rate: energies(lengths, masses, q, rate)[0], dq)
    np.testing.assert_allclose(Yp @ P, p, atol=1e-11)
    gravity = complex_gradient(lambda angle: energies(lengths, masses, angle, dq)[1], q)
    G = regressor(q, np.zeros(n), np.zeros(n), np.zeros(n)) @ P
    np.testing.assert_allclose(G, gravity, atol=1e-11)
    # Lagrange: dp/dt - dT/dq + dU/dq = tau, so G - C^T dq = dU/dq - dT/dq.
    lagrange = -complex_gradient(lambda angle: energies(lengths, masses, angle, dq)[0], q)
    np.testing.assert_allclose(Yr @ P, lagrange + gravity, atol=1e-10)


@pytest.mark.parametrize('n', SIZES)
def test_regressor_agrees_with_the_momentum_balance(n):
    """H(q, dq, dq, ddq) P = d/dt(Yp P) + Yr P along a motion with this acceleration."""
    _, _, P, (q, dq, _, ddq) = case(n)
    h = 1e-6
    ahead, behind = (momentum(q + s * dq, dq + s * ddq)[0] @ P for s in (h, -h))
    expected = (ahead - behind) / (2.0 * h) + momentum(q, dq)[1] @ P
    np.testing.assert_allclose(regressor(q, dq, dq, ddq) @ P, expected, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize('n', SIZES)
def test_coriolis_is_in_christoffel_form(n):
    """xi^T (dM/dt - 2 C) xi = 0 (Property I), for xi independent of dq."""
    _, _, P, (q, dq, xi, _) = case(n)
    h = 1e-6
    rate = (momentum(q + h * dq, xi)[0] - momentum(q - h * dq, xi)[0]) @ P / (2.0 * h)
    zero = np.zeros(n)
    C_xi = (regressor(q, dq, xi, zero) - regressor(q, dq, zero, zero)) @ P
    assert abs(xi @ rate - 2.0 * xi @ C_xi) < 1e-7 * max(1.0, abs(xi @ rate))


def test_two_link_chain_is_the_arm_of_section_iv():
    _, _, _, (q, dq, v, a) = case(2)
    H = np.zeros((2, 3))
    TwoLink(R).regressor(q, dq, v, a, H)
    np.testing.assert_allclose(regressor(q, dq, v, a)[:, [0, 2, 1]], H, atol=1e-13)


def test_law_runs_on_three_links():
    """A configuration of three joints gives a controller with a torque and all its estimates."""
    config = build(
        ControllerConfig,
        {
            'model': 'planar_chain',
            'joints': ['a', 'b', 'c'],
            'learning.initial_estimate': [0.5] * 6,
            'learning.adaptation_gain': [0.5] * 6,
            'reference.offset': [0.0] * 3,
            'reference.amplitude': [0.1] * 3,
            **{name: [value] * 3 for name, value in PER_JOINT.items()},
        },
    )
    controller = controller_of(config)
    torque = controller.update(0.0, 1e-3, np.array([0.1, 0.1, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    at_rest = regressor(np.full(3, 0.1), np.zeros(3), np.zeros(3), np.zeros(3)) @ np.full(6, 0.5)
    # On the reference, at its turning point, the torque only has to hold the arm.
    np.testing.assert_allclose(torque, at_rest, atol=0.01)
    assert controller.state.estimate.size == 6 + 3
