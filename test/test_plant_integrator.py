# SPDX-License-Identifier: Apache-2.0
"""The fixed-step integrators: order, agreement with scipy, and conservation of energy."""

import numpy as np
import pytest
from plants import ARM, PERIOD, START, commands, disturbance, energies, motion, rough_disturbance
from scipy.integrate import RK45, simpson, solve_ivp

from sim_plant.motion import DOPRI5, RK4, Stages, integrate, state_derivative

STAGES = Stages(np.empty(4), np.empty((6, 4)))
INITIAL = np.array([*START, 0.5, -1.0])
TORQUE = np.array([-6.0, -2.0])


def advance(method, load, t, h, torque, x):
    integrate(method, motion(load=load), t, h, torque, x, STAGES)


def states(method, load, torque, h, steps):
    """States (steps + 1, 4) under a constant torque."""
    rows = np.empty((steps + 1, 4))
    rows[0] = x = INITIAL.copy()
    for k in range(steps):
        advance(method, load, k * h, h, torque, x)
        rows[k + 1] = x
    return rows


def rhs(load, torque):
    """Right-hand side for scipy."""

    def evaluate(t, x):
        dx = np.empty(4)
        state_derivative(motion(load=load), t, x, torque, dx)
        return dx

    return evaluate


def exact(load, t, h, torque, x):
    """State after h seconds by scipy's DOP853, accurate to almost the last digit."""
    solution = solve_ivp(rhs(load, torque), (t, t + h), x, 'DOP853', rtol=1e-13, atol=1e-14)
    return solution.y[:, -1]


def energy(rows):
    return np.array([sum(energies(ARM, x[:2], x[2:])) for x in rows])


@pytest.mark.parametrize(('method', 'order'), [(RK4, 4), (DOPRI5, 5)], ids=['rk4', 'dopri5'])
def test_error_converges_with_the_order_of_the_method(method, order):
    load = disturbance(amplitude=5.0, frequency=[20.0, 26.0], coulomb=0.2, coulomb_velocity=2.0)
    reference = exact(load, 0.0, 0.5, TORQUE, INITIAL)
    coarse, fine = (
        np.linalg.norm(states(method, load, TORQUE, 0.5 / n, n)[-1] - reference) for n in (128, 256)
    )
    # Dormand and Prince chose coefficients with a small h^5 error, so the h^6 term still shows, and
    # finer steps run into rounding: the order is the nearest whole number.
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.4)


def test_dopri5_step_matches_scipys_rk45():
    load, h = rough_disturbance(), 0.05
    rk45 = RK45(rhs(load, TORQUE), 0.3, INITIAL, 1.0, first_step=h, rtol=1e9, atol=1e9)
    rk45.step()
    assert rk45.t == 0.3 + h
    x = INITIAL.copy()
    advance(DOPRI5, load, 0.3, h, TORQUE, x)
    assert x == pytest.approx(rk45.y, rel=1e-14)


def test_motion_under_sampled_torques_matches_dop853():
    load, x = rough_disturbance(), INITIAL.copy()
    expected = INITIAL.copy()
    for k, torque in enumerate(commands(100)):
        advance(DOPRI5, load, k * PERIOD, PERIOD, torque, x)
        expected = exact(load, k * PERIOD, PERIOD, torque, expected)
    # 100 steps with scipy's tolerance of 1e-13 each
    assert x == pytest.approx(expected, abs=1e-11)


def test_energy_is_conserved_without_torque_and_disturbance():
    total = energy(states(DOPRI5, disturbance(), np.zeros(2), PERIOD, 2000))
    # 5 J times a relative error of (h / 0.1 s)^5
    assert np.abs(total - total[0]).max() < 5e-10


def test_viscous_friction_dissipates_the_expected_power():
    """The energy gained is the integral of dq^T (torque - viscous dq)."""
    viscous, steps = np.array([0.3, 0.1]), 1000
    rows = states(DOPRI5, disturbance(viscous=viscous), TORQUE, PERIOD, steps)
    dq = rows[:, 2:]
    power = (dq * (TORQUE - viscous * dq)).sum(axis=1)
    gained = energy(rows)[-1] - energy(rows)[0]
    # Simpson's rule errs by (h / 0.1 s)^4 / 180 = 6e-11 of the 30 J that flow
    assert gained == pytest.approx(simpson(power, dx=PERIOD), abs=1e-8)
    assert np.abs(viscous * dq).max() > 0.1


def test_disturbance_is_evaluated_within_the_step():
    """Within a step the disturbance moves far from its value at the start of the step."""
    load = disturbance(amplitude=1.0, frequency=50.0)
    h = 0.02  # 1 rad of the disturbance's phase
    x = INITIAL.copy()
    advance(DOPRI5, load, 0.3, h, TORQUE, x)
    assert x == pytest.approx(exact(load, 0.3, h, TORQUE, INITIAL), abs=1e-4)
    frozen = exact(disturbance(constant=np.sin(50.0 * 0.3)), 0.3, h, TORQUE, INITIAL)
    assert np.abs(frozen - x).max() > 1e-2
