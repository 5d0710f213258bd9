# SPDX-License-Identifier: Apache-2.0
"""The arm's equation of motion against Lagrangian mechanics and the controller's regressor."""

import numpy as np
import pytest
from plants import ARM, ODD_ARM, energies

from blf_dsc_controller.arms.two_link import TwoLink
from sim_plant.arm import acceleration, parameters

ARMS = pytest.mark.parametrize('arm', [ARM, ODD_ARM], ids=['paper', 'odd'])
STEP = 1e-5  # rad; a central difference errs by STEP^2 and eps / STEP, some 1e-10 of the value


@pytest.fixture(params=range(10))
def state(request):
    """Random q, dq and torque, each (2,)."""
    rng = np.random.default_rng(request.param)
    return rng.uniform(-np.pi, np.pi, 2), rng.normal(0, 3, 2), rng.normal(0, 10, 2)


def vector(kernel, *arguments, size=2):
    out = np.empty(size)
    kernel(*arguments, out)
    return out


def gradient(function, x):
    """Central difference of a function of a vector, per entry."""
    return np.array(
        [(function(x + d) - function(x - d)) / (2 * STEP) for d in STEP * np.eye(x.size)]
    )


@ARMS
def test_acceleration_satisfies_the_euler_lagrange_equation(arm, state):
    """d/dt dL/ddq - dL/dq = torque, from nothing but the energies of two point masses."""
    q, dq, torque = state
    ddq = vector(acceleration, arm, q, dq, torque)

    def momentum(x):
        return gradient(lambda v: energies(arm, x[:2], v)[0], x[2:])

    rate = np.concatenate([dq, ddq])
    coarse = 1e-4  # s; the inner difference's rounding of 1e-10 / coarse is 1e-6
    x = np.concatenate([q, dq])
    momentum_rate = (momentum(x + coarse * rate) - momentum(x - coarse * rate)) / (2 * coarse)
    force = gradient(lambda y: np.subtract(*energies(arm, y, dq)), q)
    assert momentum_rate - force == pytest.approx(torque, abs=2e-4)


@ARMS
def test_controllers_regressor_reproduces_the_torque(arm, state):
    """H P = torque along the motion, two independent derivations of the same physics."""
    q, dq, torque = state
    ddq = vector(acceleration, arm, q, dq, torque)
    H = np.empty((2, 3))
    TwoLink(arm.g / arm.l1).regressor(q, dq, dq, ddq, H)
    assert H @ vector(parameters, arm, size=3) == pytest.approx(torque, abs=1e-11)


def test_papers_arm_has_the_papers_parameters():
    assert vector(parameters, ARM, size=3) == pytest.approx([1.0, 0.32, 0.4], rel=1e-15)
