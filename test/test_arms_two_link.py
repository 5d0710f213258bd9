# SPDX-License-Identifier: Apache-2.0
"""Two-link regressors: identities on random states, and a comparison with the simulated arm.

Derivatives are taken by a five-point stencil of step 1e-3, whose truncation h^4 / 30 and rounding
1e-16 / h both stay below 1e-12 for functions of size one; hence 1e-9 where terms reach 1e2.
"""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import MODEL, P, R, plant
from plain_law import dynamics
from plants import ARM

import sim_plant.dynamics as physics
from blf_dsc_controller.arms.model import arm_model
from blf_dsc_controller.arms.planar_chain import PlanarChain
from blf_dsc_controller.arms.two_link import TwoLink

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
