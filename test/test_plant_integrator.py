# SPDX-License-Identifier: Apache-2.0
"""The fixed-step integrator: order, agreement with scipy, and conservation of energy."""

import numpy as np
import pytest
from plants import (
    PERIOD,
    START,
    commands,
    disturbance,
    motion,
    plant,
    rough_disturbance,
)
from scipy.integrate import RK45, solve_ivp

from sim_plant.motion import Stages, disturbance_torque, integrate, state_derivative

STAGES = Stages(np.empty(4), np.empty((6, 4)))
INITIAL = np.array([*START, 0.5, -1.0])
TORQUE = np.array([-6.0, -2.0])


def advance(load, t, h, torque, x):
    integrate(motion(load=load), t, h, torque, x, STAGES)


def states(load, torque, h, steps):
    """States (steps + 1, 4) under a constant torque."""
    rows = np.empty((steps + 1, 4))
    rows[0] = x = INITIAL.copy()
    for k in range(steps):
        advance(load, k * h, h, torque, x)
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


def test_error_converges_with_order_five():
    load = disturbance(amplitude=5.0, frequency=[20.0, 26.0], coulomb=0.2, coulomb_velocity=2.0)
    reference = exact(load, 0.0, 0.5, TORQUE, INITIAL)
    coarse, fine = (
        np.linalg.norm(states(load, TORQUE, 0.5 / n, n)[-1] - reference) for n in (128, 256)
    )
    # Dormand and Prince chose coefficients with a small h^5 error, so the h^6 term still shows, and
    # finer steps run into rounding: the order is the nearest whole number.
    assert np.log2(coarse / fine) == pytest.approx(5.0, abs=0.4)


def test_dopri5_step_matches_scipys_rk45():
    load, h = rough_disturbance(), 0.05
    rk45 = RK45(rhs(load, TORQUE), 0.3, INITIAL, 1.0, first_step=h, rtol=1e9, atol=1e9)
    rk45.step()
    assert rk45.t == 0.3 + h
    x = INITIAL.copy()
    advance(load, 0.3, h, TORQUE, x)
    assert x == pytest.approx(rk45.y, rel=1e-14)


def test_motion_under_sampled_torques_matches_dop853():
    load, x = rough_disturbance(), INITIAL.copy()
    expected = INITIAL.copy()
    for k, torque in enumerate(commands(100)):
        advance(load, k * PERIOD, PERIOD, torque, x)
        expected = exact(load, k * PERIOD, PERIOD, torque, expected)
    # 100 steps with scipy's tolerance of 1e-13 each
    assert x == pytest.approx(expected, abs=1e-11)


def test_disturbance_is_evaluated_within_the_step():
    """Within a step the disturbance moves far from its value at the start of the step."""
    load = disturbance(amplitude=1.0, frequency=50.0)
    h = 0.02  # 1 rad of the disturbance's phase
    x = INITIAL.copy()
    advance(load, 0.3, h, TORQUE, x)
    assert x == pytest.approx(exact(load, 0.3, h, TORQUE, INITIAL), abs=1e-4)
    frozen = exact(disturbance(constant=np.sin(50.0 * 0.3)), 0.3, h, TORQUE, INITIAL)
    assert np.abs(frozen - x).max() > 1e-2


def torque(vector, t, dq, q=(0.3, -0.4)):
    out = np.empty(2)
    disturbance_torque(vector, t, np.array(q), np.array(dq, dtype=float), out)
    return out


def test_disturbances_add_up_for_each_joint():
    t, dq = 1.7, np.array([0.4, -0.9])
    expected = [
        0.1 + 0.1 * np.sin(1.7) + 0.05 * 0.4 + 0.2 * np.tanh(0.8),
        -0.2 + 0.3 * np.sin(7.0 * 1.7 + 0.4) - 0.1 * 0.9 - 0.1 * np.tanh(1.8),
    ]
    assert torque(rough_disturbance(), t, dq) == pytest.approx(expected, rel=1e-14)


def test_coulomb_friction_opposes_motion_and_is_constant_well_above_its_velocity():
    friction = disturbance(coulomb=[0.3, 0.5], coulomb_velocity=0.01)
    # tanh(20) is 1 to the last bit
    assert torque(friction, 0.0, [0.2, -0.2]).tolist() == [0.3, -0.5]
    assert torque(friction, 0.0, [0.0, 0.0]).tolist() == [0.0, 0.0]


def test_stribeck_friction_is_higher_at_low_velocity():
    friction = disturbance(coulomb=[0.3, 0.5], stribeck=0.5, stribeck_velocity=0.1)
    sliding, creeping = torque(friction, 0.0, [1.0, -1.0]), torque(friction, 0.0, [0.05, -0.05])
    assert sliding == pytest.approx([0.3, -0.5], rel=1e-12)
    rise = (1.0 + 0.5 * np.exp(-0.25)) * np.tanh(5.0)
    assert creeping == pytest.approx([0.3 * rise, -0.5 * rise], rel=1e-12)


def test_ripple_is_periodic_in_the_joint_angle():
    ripple = disturbance(ripple=[0.2, 0.4], ripple_frequency=20.0)
    period = 2.0 * np.pi / 20.0
    q = np.array([0.3 * period, -0.25 * period])
    here = torque(ripple, 0.0, [0.0, 0.0], q)
    assert here == pytest.approx([0.2 * np.sin(0.6 * np.pi), -0.4], rel=1e-12)
    assert torque(ripple, 5.0, [1.0, 1.0], q + period) == pytest.approx(here, abs=1e-12)


def test_positive_disturbance_decelerates_the_joint():
    """In the equation of motion tau_dist is on the side of M ddq."""
    undisturbed, disturbed = plant(), plant(load=disturbance(constant=[0.0, 1.0]))
    undisturbed.step(np.zeros(2))
    disturbed.step(np.zeros(2))
    assert disturbed.truth()[-1] < undisturbed.truth()[-1]


def test_truth_contains_the_current_disturbance():
    arm = plant(load=rough_disturbance(), velocity=(0.3, -0.2))
    for _ in range(100):
        arm.step(np.array([-6.0, -2.0]))
    truth = arm.truth()
    assert truth[:3] == pytest.approx([1.0, 0.32, 0.4])
    assert (truth[3:5] == torque(rough_disturbance(), 100_000_000 * 1e-9, truth[7:9])).all()
