# SPDX-License-Identifier: Apache-2.0
"""Each kind of disturbance torque, on the arm's side of the equation of motion."""

import numpy as np
import pytest
from plants import disturbance, plant, rough_disturbance

from sim_plant.motion import disturbance_torque


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


def test_default_disturbance_is_zero():
    assert (torque(disturbance(), 3.0, [1.0, -1.0]) == 0).all()


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


def test_friction_slows_the_arm_down():
    free, damped = plant(), plant(load=disturbance(viscous=0.1, coulomb=0.1))
    for _ in range(200):
        free.step(np.zeros(2))
        damped.step(np.zeros(2))
    speed = [np.abs(arm.truth()[-2:]) for arm in (free, damped)]
    assert (speed[1] < speed[0]).all()


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
