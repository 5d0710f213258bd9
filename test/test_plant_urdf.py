# SPDX-License-Identifier: Apache-2.0
"""The plant of an arm from a URDF against pinocchio; its events and its truth."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from random_arm import ARMS, PANDA, ArmCase

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.inertia import pseudo_inertia
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change
from sim_plant.plant import parameters_of, plant_of, plant_settings, true_inertias
from sim_plant.rigid_body import acceleration, locate, motion_of, motion_size, rigid_bodies, tip


class BodyCase(ArmCase):
    """An arm as bodies of the plant."""

    def __init__(self, name):
        super().__init__(name)
        self.bodies = rigid_bodies(self.chain, self.gravity, self.chain.inertias, self.rotors)
        self.now = motion_of(np.full(motion_size(self.bodies), np.nan), self.bodies)

    def acceleration(self, payload=0.0):
        """Acceleration under the torque `v`, and pinocchio's (articulated bodies)."""
        ddq = self.v.copy()
        locate(self.bodies, self.q, self.dq, self.now)
        acceleration(self.bodies, self.now, payload, ddq, ddq)  # in place
        return ddq, pinocchio.aba(self.model, self.data, self.theirs, self.dq, self.v)


@pytest.mark.parametrize('name', ARMS)
def test_accelerations_match_pinocchio_and_the_controllers_regressor(name):
    """H(q, dq, dq, ddq) P = torque, from two derivations that share only the geometry."""
    case = BodyCase(name)
    ddq, expected = case.acceleration()
    np.testing.assert_allclose(ddq, expected, rtol=1e-10, atol=1e-10)
    model = serial_chain(case.chain, case.gravity)
    H = np.zeros((case.n, model.p))
    model.regressor(case.q, case.dq, case.dq, ddq, H)
    np.testing.assert_allclose(H @ case.phi, case.v, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('name', ARMS)
def test_tip_and_body_placements_match_pinocchio(name):
    case = BodyCase(name)
    locate(case.bodies, case.q, case.dq, case.now)
    pinocchio.framesForwardKinematics(case.model, case.data, case.theirs)
    position, jacobian, frame = np.zeros(3), np.zeros((3, case.n)), case.model.getFrameId(case.tip)
    tip(case.bodies, case.now, position, jacobian)
    np.testing.assert_allclose(position, case.data.oMf[frame].translation, atol=1e-12)
    axes = pinocchio.LOCAL_WORLD_ALIGNED
    theirs = pinocchio.computeFrameJacobian(case.model, case.data, case.theirs, frame, axes)
    np.testing.assert_allclose(jacobian, theirs.reshape(6, -1)[:3], atol=1e-12)
    for i in range(case.n + 1):
        np.testing.assert_allclose(case.now.origin[i], case.data.oMi[i].translation, atol=1e-12)
        np.testing.assert_allclose(case.now.rotation[i], case.data.oMi[i].rotation, atol=1e-12)


def test_acceleration_accounts_for_other_inertias_and_a_payload():
    """A truth that differs from the URDF: links 20 % heavier, 2 kg at the tip."""
    case = BodyCase('panda')
    inertias = 1.2 * case.chain.inertias
    case.bodies = rigid_bodies(case.chain, case.gravity, inertias, case.rotors)
    for i, heavier in enumerate(inertias, start=1):
        case.model.inertias[i] = pinocchio.Inertia.FromDynamicParameters(heavier)
    point = case.chain.tip_placement[:3, 3]
    case.model.inertias[case.n] += pinocchio.Inertia(2.0, point, np.zeros((3, 3)))
    np.testing.assert_allclose(*case.acceleration(2.0), rtol=1e-10, atol=1e-10)


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
    np.testing.assert_allclose(parameters_of(config, 0.4), expected, rtol=1e-12)
    loaded = chain.inertias.copy()
    point = chain.tip_placement[:3, 3]
    loaded[-1] += pinocchio.Inertia(2.0, point, np.zeros((3, 3))).toDynamicParameters()
    np.testing.assert_allclose(parameters_of(config, 0.6), base.of(loaded, rotors), rtol=1e-12)
    scaled = panda(truth__mass_factor=1.3, truth__rotor_factor=1.2)
    expected = base.of(1.3 * chain.inertias, 1.2 * rotors)
    np.testing.assert_allclose(parameters_of(scaled), expected, rtol=1e-12, atol=1e-15)


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
