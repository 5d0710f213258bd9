# SPDX-License-Identifier: Apache-2.0
"""Planar arms: two links as in Section IV, any number against a Lagrangian."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import MODEL, P, R, plant
from plain_law import dynamics
from plants import ARM

import sim_plant.arm as physics
from blf_dsc_controller.arms.model import arm_model
from blf_dsc_controller.arms.planar_chain import PlanarChain
from blf_dsc_controller.arms.two_link import TwoLink, urdf
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, flatten, parameters
from blf_dsc_controller.law.factory import controller_of
from sim_plant.plant import parameters_of

CLOSE = {'rtol': 0.0, 'atol': 1e-9}


def derivative(function, h=1e-3):
    """d/ds of function(s) at s = 0."""
    return (8.0 * (function(h) - function(-h)) - (function(2.0 * h) - function(-2.0 * h))) / (
        12.0 * h
    )


def filled(kernel, shape, *arguments):
    out = np.full(shape, np.nan)
    kernel(*arguments, out)
    return out


def inertia(P, q):
    return dynamics(P, R, q, np.zeros(2))[0]


def coriolis(P, q, dq):
    return dynamics(P, R, q, dq)[1]


def gravity(P, q):
    return dynamics(P, R, q, np.zeros(2))[2]


def potential(P, q):
    return P[0] * R * np.sin(q[0]) + P[2] * R * np.sin(q[0] + q[1])


def momentum_regressor(q, dq):
    Yp, Yr = np.full((2, 2, 3), np.nan)
    MODEL.momentum_regressor(q, dq, Yp, Yr)
    return Yp, Yr


def random_states():
    """P, q [rad], dq [rad/s], with random parameters so that every term counts; the generator."""
    for random in map(np.random.default_rng, range(20)):
        some_P, q, dq = random.normal(size=3), *random.uniform(-1.0, 1.0, (2, 2))
        yield some_P, np.pi * q, 3.0 * dq, random


def test_regressor_times_parameters_gives_the_dynamics():
    for some_P, q, dq, random in random_states():
        v, a = random.uniform(-5.0, 5.0, (2, 2))
        H = filled(MODEL.regressor, (2, 3), q, dq, v, a)
        torque = inertia(some_P, q) @ a + coriolis(some_P, q, dq) @ v + gravity(some_P, q)
        np.testing.assert_allclose(H @ some_P, torque, rtol=0.0, atol=1e-12)


def test_momentum_regressors_times_parameters_give_momentum_and_rest():
    for some_P, q, dq, _ in random_states():
        Yp, Yr = momentum_regressor(q, dq)
        rest = gravity(some_P, q) - coriolis(some_P, q, dq).T @ dq
        np.testing.assert_allclose(Yp @ some_P, inertia(some_P, q) @ dq, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(Yr @ some_P, rest, rtol=0.0, atol=1e-12)


def test_both_regressors_describe_the_same_motion():
    for _, q, dq, random in random_states():
        ddq = random.uniform(-5.0, 5.0, 2)
        H = filled(MODEL.regressor, (2, 3), q, dq, dq, ddq)
        _, Yr = momentum_regressor(q, dq)

        def momentum(s, q=q, dq=dq, ddq=ddq):
            return momentum_regressor(q + s * dq + 0.5 * s * s * ddq, dq + s * ddq)[0]

        np.testing.assert_allclose(derivative(momentum) + Yr, H, **CLOSE)


def test_inertia_rate_minus_twice_coriolis_is_skew_symmetric():
    for some_P, q, dq, _ in random_states():
        rate = derivative(lambda s, some_P=some_P, q=q, dq=dq: inertia(some_P, q + s * dq))
        S = rate - 2.0 * coriolis(some_P, q, dq)
        np.testing.assert_allclose(S, -S.T, **CLOSE)


def test_gravity_is_the_gradient_of_the_potential():
    for some_P, q, _, _ in random_states():
        gradient = [
            derivative(lambda s, some_P=some_P, q=q, axis=axis: potential(some_P, q + s * axis))
            for axis in np.eye(2)
        ]
        np.testing.assert_allclose(gradient, gravity(some_P, q), **CLOSE)


def test_model_agrees_with_the_simulated_arm():
    """M ddq + C dq + G = tau holds with the acceleration of the plant."""
    tau = np.array([3.0, -1.0])
    for _, q, dq, _ in random_states():
        ddq = filled(physics.acceleration, 2, ARM, q, dq, tau)
        torque = inertia(P, q) @ ddq + coriolis(P, q, dq) @ dq + gravity(P, q)
        np.testing.assert_allclose(torque, tau, **CLOSE)


def test_momentum_balance_holds_along_a_simulated_motion():
    """d/dt(Yp P) + Yr P = tau - tau_dist: a constant torque keeps the motion smooth."""
    arm = plant(viscous=0.3)
    tau = np.array([-2.0, 1.0])
    motion = []
    for _ in range(300):
        truth = arm.truth()
        motion.append((truth[3:5].copy(), *momentum_regressor(truth[5:7], truth[7:9])))
        arm.step(tau)
    tau_dist, Yp, Yr = map(np.array, zip(*motion, strict=True))
    momentum = Yp @ P

    rate = (8.0 * (momentum[3:-1] - momentum[1:-3]) - (momentum[4:] - momentum[:-4])) / 12e-3

    np.testing.assert_allclose(rate + (Yr @ P)[2:-2], tau - tau_dist[2:-2], **CLOSE)


def test_model_names_its_parameters():
    assert MODEL.parameter_names == ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')
    assert MODEL.parameter_units == ('kg m^2',) * 3
    assert MODEL.n == 2
    assert arm_model('two_link', 2, l1=0.5, gravity=9.8) == TwoLink(19.6)


@pytest.mark.parametrize('model', [MODEL, PlanarChain(3, R)], ids=['two', 'chain'])
def test_regressors_computed_at_once_equal_the_separate_ones(model):
    for random in map(np.random.default_rng, range(20)):
        q, dq, v, a = random.normal(size=(4, model.n))
        separate, together = np.full((2, 3, model.n, len(model.parameter_names)), np.nan)
        model.regressor(q, dq, v, a, separate[0])
        model.momentum_regressor(q, dq, separate[1], separate[2])
        model.regressors(q, dq, v, a, *together)
        np.testing.assert_array_equal(together, separate)


CONFIG = build(PlantConfig, {'arm.l1': 1.1, 'arm.l2': 0.7, 'arm.m1': 0.6, 'arm.m2': 0.45})
LINKS = (1.1, 0.7), (0.6, 0.45)


def test_mujoco_reads_the_same_arm_from_the_urdf():
    """Mass matrix and gravity torque of the URDF, compiled by MuJoCo, against the model's."""
    mujoco = pytest.importorskip('mujoco', reason='needs MuJoCo: pip install mujoco')
    text = urdf('arm', CONFIG.joints, *LINKS, (0.0, 0.0))
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.gravity[:] = (0.0, 0.0, -CONFIG.arm.gravity)
    data = mujoco.MjData(model)
    P, r, found = parameters_of(CONFIG), CONFIG.arm.gravity / CONFIG.arm.l1, np.zeros((2, 2))
    for q in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 2)):
        for joint, angle in zip(CONFIG.joints, q, strict=True):
            data.joint(joint).qpos[0] = angle
        mujoco.mj_forward(model, data)
        for i in range(2):
            mujoco.mj_mulM(model, data, found[i], np.eye(2)[i])
        mass, _, weight = dynamics(P, r, q, np.zeros(2))
        np.testing.assert_allclose(found, mass, atol=1e-7)  # points have 1e-9 kg m^2 in it
        np.testing.assert_allclose(data.qfrc_bias, weight, atol=1e-7)


def test_urdf_has_an_effort_limit_only_for_limited_motors():
    assert 'effort="12"' in urdf('arm', ('a', 'b'), *LINKS, (12.0, 0.0))
    assert urdf('arm', ('a', 'b'), *LINKS, (12.0, 0.0)).count('<limit') == 1
    assert '<joint name="b"' in urdf('arm', ('a', 'b'), *LINKS, (0.0, 0.0))


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
