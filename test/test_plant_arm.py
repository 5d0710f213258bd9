# SPDX-License-Identifier: Apache-2.0
"""The arm's equations of motion against mechanics, and against the controller's regressor."""

import numpy as np
import pytest
from plants import ARM, ODD_ARM

from blf_dsc_controller.arms.two_link import TwoLink
from sim_plant.dynamics import (
    acceleration,
    coriolis,
    gravity,
    kinetic_energy,
    mass_matrix,
    parameters,
    potential_energy,
)

ARMS = pytest.mark.parametrize('arm', [ARM, ODD_ARM], ids=['paper', 'odd'])
STEP = 1e-5  # rad; a central difference errs by STEP^2 and eps / STEP, some 1e-10 of the value
DIFFERENCE = 1e-8  # ... with room for values of 10


@pytest.fixture(params=range(10))
def state(request):
    """Random q, dq and ddq, each (2,)."""
    rng = np.random.default_rng(request.param)
    return rng.uniform(-np.pi, np.pi, 2), rng.normal(0, 3, 2), rng.normal(0, 10, 2)


def matrix(kernel, *arguments):
    out = np.empty((2, 2))
    kernel(*arguments, out)
    return out


def vector(kernel, *arguments, size=2):
    out = np.empty(size)
    kernel(*arguments, out)
    return out


def slope(function, x):
    """Central difference of a function of a vector, per entry."""
    return np.array(
        [(function(x + d) - function(x - d)) / (2 * STEP) for d in STEP * np.eye(x.size)]
    )


def masses(arm, q):
    """Cartesian positions (2, 2) of the two point masses, m: the definition of the arm."""
    elbow = arm.l1 * np.array([np.cos(q[0]), np.sin(q[0])])
    return np.array([elbow, elbow + arm.l2 * np.array([np.cos(q.sum()), np.sin(q.sum())])])


@ARMS
def test_energies_are_those_of_two_point_masses(arm, state):
    q, dq, _ = state
    velocities = np.tensordot(dq, slope(lambda x: masses(arm, x), q), 1)
    mass = np.array([arm.m1, arm.m2])
    assert kinetic_energy(arm, q, dq) == pytest.approx(
        0.5 * mass @ (velocities**2).sum(axis=1), rel=DIFFERENCE
    )
    assert potential_energy(arm, q) == pytest.approx(arm.g * mass @ masses(arm, q)[:, 1], abs=1e-13)


@ARMS
def test_mass_matrix_is_symmetric_positive_definite_and_gives_the_kinetic_energy(arm, state):
    q, dq, _ = state
    M = matrix(mass_matrix, arm, q)
    assert (M == M.T).all()
    assert np.linalg.eigvalsh(M)[0] > 0
    assert 0.5 * dq @ M @ dq == pytest.approx(kinetic_energy(arm, q, dq), rel=1e-13)


@ARMS
def test_m_dot_minus_2c_is_skew_symmetric(arm, state):
    q, dq, _ = state
    M_dot = np.tensordot(dq, slope(lambda x: matrix(mass_matrix, arm, x), q), 1)
    S = M_dot - 2 * matrix(coriolis, arm, q, dq)
    assert pytest.approx(0, abs=DIFFERENCE) == S + S.T


@ARMS
def test_gravity_is_the_gradient_of_the_potential(arm, state):
    q, _, _ = state
    gradient = slope(lambda x: potential_energy(arm, x), q)
    assert vector(gravity, arm, q) == pytest.approx(gradient, abs=DIFFERENCE)


@ARMS
def test_acceleration_solves_the_equation_of_motion(arm, state):
    q, dq, torque = state
    ddq = vector(acceleration, arm, q, dq, torque)
    M, C, G = matrix(mass_matrix, arm, q), matrix(coriolis, arm, q, dq), vector(gravity, arm, q)
    assert M @ ddq + C @ dq + G == pytest.approx(torque, abs=1e-11)


@ARMS
def test_acceleration_obeys_euler_and_lagrange(arm, state):
    """d/dt dL/ddq - dL/dq = torque, of the energies alone."""
    q, dq, torque = state
    ddq = vector(acceleration, arm, q, dq, torque)

    def momentum(x):
        return slope(lambda v: kinetic_energy(arm, x[:2], v), x[2:])

    rate = np.concatenate([dq, ddq])
    coarse = 1e-4  # s; the inner difference's rounding of 1e-10 / coarse is 1e-6
    x = np.concatenate([q, dq])
    momentum_rate = (momentum(x + coarse * rate) - momentum(x - coarse * rate)) / (2 * coarse)
    force = slope(lambda y: kinetic_energy(arm, y, dq) - potential_energy(arm, y), q)
    assert momentum_rate - force == pytest.approx(torque, abs=2e-4)


@ARMS
def test_regressor_of_the_controller_describes_this_arm(arm, state):
    """H P = M a + C v + G, two independent derivations of the same physics."""
    q, dq, a = state
    v = dq[::-1] + 0.3
    H = np.empty((2, 3))
    TwoLink(arm.g / arm.l1).regressor(q, dq, v, a, H)
    M, C, G = matrix(mass_matrix, arm, q), matrix(coriolis, arm, q, dq), vector(gravity, arm, q)
    assert H @ vector(parameters, arm, size=3) == pytest.approx(M @ a + C @ v + G, abs=1e-11)


def test_the_papers_arm_has_the_papers_parameters():
    assert vector(parameters, ARM, size=3) == pytest.approx([1.0, 0.32, 0.4], rel=1e-15)
