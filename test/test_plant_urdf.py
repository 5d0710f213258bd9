# SPDX-License-Identifier: Apache-2.0
"""The plant of an arm from a URDF: its configuration, its truth and its events."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from plants import true_parameters
from random_arm import PANDA

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.urdf import pseudo_inertia
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change
from sim_plant.plant import plant_of, plant_settings, true_inertias

PANDA_CONFIG = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}


def panda(**given):
    given = {name.replace('__', '.'): value for name, value in given.items()}
    return build(PlantConfig, PANDA_CONFIG | given)


def swinging_torques(samples):
    """Torques (samples, 7) that swing the arm."""
    t = 1e-3 * np.arange(samples)[:, None]
    amplitude = np.array([20.0, 10.0, 10.0, 10.0, 2.0, 2.0, 1.0])
    return amplitude * np.sin(2.0 * np.pi * t * np.linspace(1.0, 2.0, 7))


def test_urdf_and_tip_are_a_complete_configuration_which_given_parameters_override():
    config = panda()
    assert config.joints == tuple(PANDA)
    assert config.initial.position == pytest.approx((0, 0, 0, -1.5708, 0, 1.8675, 0), abs=1e-9)
    assert config.initial.velocity == config.disturbance.amplitude == (0.0,) * 7
    assert config.actuator.torque_limit == (87.0,) * 4 + (12.0,) * 3
    assert change(config, {'seed': 3}).joints == config.joints
    config = panda(actuator__torque_limit=[50.0] * 7, initial__position=[0.1] * 7)
    assert config.actuator.torque_limit == (50.0,) * 7
    assert config.initial.position == (0.1,) * 7
    rippled = plant_settings(change(config, {'actuator.ripple': 0.01}))  # of the limit
    assert rippled.disturbance.ripple == pytest.approx(0.5)


def test_truth_contains_the_base_parameters_with_payload_and_factors():
    config = panda(**{'events.begin': [0.5], 'events.payload': [2.0]})
    chain = config.robot.chain(config.joints)
    base, rotors = base_parameters(chain), config.robot.rotors(chain)
    expected = base.of(chain.inertias, rotors)
    np.testing.assert_allclose(true_parameters(config, 0.4), expected, rtol=1e-12)
    loaded = chain.inertias.copy()
    point = chain.tip_placement[:3, 3]
    loaded[-1] += pinocchio.Inertia(2.0, point, np.zeros((3, 3))).toDynamicParameters()
    np.testing.assert_allclose(true_parameters(config, 0.6), base.of(loaded, rotors), rtol=1e-12)
    scaled = panda(truth__mass_factor=1.3, truth__rotor_factor=1.2)
    expected = base.of(1.3 * chain.inertias, 1.2 * rotors)
    np.testing.assert_allclose(true_parameters(scaled), expected, rtol=1e-12, atol=1e-15)


def test_random_truth_deviates_as_configured_and_stays_physical():
    """A shift only moves the centre of mass: the inertia about it remains."""
    config = panda(truth__mass_deviation=0.3, truth__centre_deviation=0.01)
    chain = config.robot.chain(config.joints)
    bodies = np.array(
        [true_inertias(chain, change(config, {'truth.seed': seed}).truth) for seed in range(100)]
    )
    masses = bodies[:, :, 0] / chain.inertias[:, 0]
    centres, original = (rows[..., 1:4] / rows[..., :1] for rows in (bodies, chain.inertias))
    for found, nearly, most in ((masses - 1.0, 0.29, 0.3), (centres - original, 0.0099, 0.01)):
        assert nearly < found.max() < most
        assert -most < found.min() < -nearly
    assert abs(masses.mean() - 1.0) < 0.03
    for true, urdf in zip(bodies.reshape(-1, 10), np.tile(chain.inertias, (100, 1)), strict=True):
        least, expected = (np.linalg.eigvalsh(pseudo_inertia(phi))[0] for phi in (true, urdf))
        assert least > -1e-12 * abs(expected)
        about = [pinocchio.Inertia.FromDynamicParameters(phi).inertia for phi in (true, urdf)]
        np.testing.assert_allclose(about[0] / true[0], about[1] / urdf[0], atol=1e-12)
    again = true_inertias(chain, change(config, {'truth.seed': 99}).truth)
    np.testing.assert_array_equal(again, bodies[-1])


def test_events_act_on_all_seven_joints_at_their_time():
    """A push at the tip acts through its Jacobian; friction, torques and offsets add up."""
    names = ('force', 'torque', 'viscous', 'coulomb', 'offset')
    values = ([3.0, -2.0, 5.0], *(np.linspace(low, 2.0 * low, 7) for low in (2.0, 1.0, 0.5, 1e-3)))
    given = {f'events.{name}': list(value) for name, value in zip(names, values, strict=True)}
    arm = plant_of(panda(**{'events.begin': [0.1], **given}))
    for torque in swinging_torques(100):
        arm.step(torque)
    load, q, dq = arm.truth()[arm.arm.p :].reshape(3, 7)
    position, jacobian = np.zeros(3), np.zeros((3, 7))
    arm.arm.fill_tip(q, position, jacobian)
    expected = -values[1] + values[2] * dq + values[3] * np.tanh(dq / 0.01) - values[0] @ jacobian
    np.testing.assert_allclose(load, expected, rtol=1e-12)
    np.testing.assert_allclose(arm.measure()[:7] - q, values[4], atol=1e-12)


def test_two_plants_of_a_urdf_are_independent_and_repeatable():
    first, second = plant_of(panda()), plant_of(panda(**{'load.payload': 1.0}))
    rows = [], []
    for torque in swinging_torques(50):
        first.step(torque)
        second.step(torque)
        rows[0].append(first.measure().copy())
    first.reset()
    for torque in swinging_torques(50):
        first.step(torque)
        rows[1].append(first.measure().copy())
    np.testing.assert_array_equal(*rows)
