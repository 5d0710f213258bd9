# SPDX-License-Identifier: Apache-2.0
"""The sampled plant of an arm from a URDF: mechanics, events, and its configuration."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio
import pytest
from random_arm import PANDA

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.inertia import pseudo_inertia
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change
from sim_plant.plant import parameters_of, plant_of, true_inertias

PANDA_CONFIG = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}
FRICTIONLESS = {'disturbance.viscous': [0.0] * 7, 'disturbance.coulomb': [0.0] * 7}


def panda(**given):
    return build(
        PlantConfig,
        {**PANDA_CONFIG, **{name.replace('__', '.'): value for name, value in given.items()}},
    )


def swinging_torques(samples):
    """Torques (samples, 7) that swing the arm."""
    t = 1e-3 * np.arange(samples)[:, None]
    amplitude = np.array([20.0, 10.0, 10.0, 10.0, 2.0, 2.0, 1.0])
    return amplitude * np.sin(2.0 * np.pi * t * np.linspace(1.0, 2.0, 7))


def test_urdf_and_tip_are_a_complete_configuration():
    config = panda()
    assert config.joints == tuple(PANDA)
    assert config.initial.position == pytest.approx((0, 0, 0, -1.5708, 0, 1.8675, 0), abs=1e-9)
    assert config.initial.velocity == config.disturbance.amplitude == (0.0,) * 7
    assert config.actuator.torque_limit == (87.0,) * 4 + (12.0,) * 3
    assert change(config, {'seed': 3}).joints == config.joints


def test_given_parameters_override_the_urdf():
    config = panda(actuator__torque_limit=[50.0] * 7, initial__position=[0.1] * 7)
    assert config.actuator.torque_limit == (50.0,) * 7
    assert config.initial.position == (0.1,) * 7


class MujocoArm:
    """The arm of a URDF in MuJoCo, with locked fingers and MuJoCo's RK4 integrator."""

    def __init__(self, config, payload=0.0):
        spec = mujoco.MjSpec.from_string(config.robot.text)
        spec.compiler.boundmass = spec.compiler.boundinertia = 0.0
        for joint in spec.joints:
            if joint.name not in config.joints:
                spec.delete(joint)
        tip = spec.body(config.robot.tip)
        if payload:
            ball = tip.add_body()
            ball.mass, ball.inertia, ball.explicitinertial = payload, [1e-12] * 3, True
        self.model = spec.compile()
        self.model.opt.timestep = config.sample_time
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
        self.model.opt.gravity[:] = config.robot.gravity
        self.model.dof_damping[:] = config.disturbance.viscous
        self.model.dof_armature[:] = config.robot.rotors(config.robot.chain(config.joints))
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = config.initial.position
        self.data.qvel[:] = config.initial.velocity
        mujoco.mj_forward(self.model, self.data)

    def step(self, torque):
        self.data.qfrc_applied[:] = torque
        mujoco.mj_step(self.model, self.data)


def states(config, torques):
    """True q, dq (samples + 1, 14) under these torques."""
    arm = plant_of(config)
    rows = [arm.truth()[-14:].copy()]
    for torque in torques:
        arm.step(torque)
        rows.append(arm.truth()[-14:].copy())
    return np.array(rows)


@pytest.mark.parametrize('payload', [0.0, 2.0])
def test_motion_matches_mujoco(payload):
    config = panda(**{'disturbance.viscous': [0.5] * 7, 'load.payload': payload})
    torques = swinging_torques(500)
    rows = states(config, torques)
    mujoco_arm = MujocoArm(config, payload)
    for torque in torques:
        mujoco_arm.step(torque)
    moved = np.abs(rows[-1, :7] - rows[0, :7])
    assert moved.max() > 0.5
    expected = np.concatenate((mujoco_arm.data.qpos, mujoco_arm.data.qvel))
    np.testing.assert_allclose(rows[-1], expected, rtol=0.0, atol=1e-6)


def test_truth_contains_the_base_parameters_with_the_payload():
    config = panda(**{'events.begin': [0.5], 'events.payload': [2.0]})
    chain = config.robot.chain(config.joints)
    base, rotors = base_parameters(chain), config.robot.rotors(chain)
    expected = base.of(chain.inertias, rotors)
    np.testing.assert_allclose(parameters_of(config, 0.4), expected, rtol=1e-12)
    loaded = chain.inertias.copy()
    point = chain.tip_placement[:3, 3]
    loaded[-1] += pinocchio.Inertia(2.0, point, np.zeros((3, 3))).toDynamicParameters()
    np.testing.assert_allclose(parameters_of(config, 0.6), base.of(loaded, rotors), rtol=1e-12)


def test_truth_factors_scale_every_body():
    config = panda(truth__mass_factor=1.3, truth__rotor_factor=1.2)
    chain = config.robot.chain(config.joints)
    expected = base_parameters(chain).of(1.3 * chain.inertias, 1.2 * config.robot.rotors(chain))
    np.testing.assert_allclose(parameters_of(config), expected, rtol=1e-12, atol=1e-15)


def test_random_truth_deviates_as_configured_and_stays_physical():
    config = panda(truth__mass_deviation=0.3, truth__centre_deviation=0.01)
    chain = config.robot.chain(config.joints)
    masses, shifts = [], []
    for seed in range(100):
        inertias = true_inertias(chain, change(config, {'truth.seed': seed}).truth)
        masses.append(inertias[:, 0] / chain.inertias[:, 0] - 1.0)
        centres = (rows[:, 1:4] / rows[:, :1] for rows in (inertias, chain.inertias))
        shifts.append(np.subtract(*centres))
        for true, urdf in zip(inertias, chain.inertias, strict=True):
            least, expected = (np.linalg.eigvalsh(pseudo_inertia(phi))[0] for phi in (true, urdf))
            assert least > -1e-12 * abs(expected)
    assert 0.29 < np.max(masses) < 0.3
    assert -0.3 < np.min(masses) < -0.29
    assert 0.0099 < np.max(shifts) < 0.01
    assert -0.01 < np.min(shifts) < -0.0099
    assert abs(np.mean(masses)) < 0.03
    again = true_inertias(chain, change(config, {'truth.seed': 99}).truth)
    np.testing.assert_array_equal(again[:, 0] / chain.inertias[:, 0] - 1.0, masses[-1])


def test_shifted_body_keeps_its_inertia_about_the_centre_of_mass():
    """Only the position of its centre of mass changes."""
    config = panda(truth__centre_deviation=0.01, truth__seed=1)
    chain = config.robot.chain(config.joints)
    for true, urdf in zip(true_inertias(chain, config.truth), chain.inertias, strict=True):
        shifted, original = (pinocchio.Inertia.FromDynamicParameters(phi) for phi in (true, urdf))
        np.testing.assert_allclose(shifted.inertia, original.inertia, atol=1e-12)


def test_events_act_on_all_seven_joints_at_their_time():
    """A push at the tip acts through its Jacobian; friction, torques and offsets add up."""
    names = ('force', 'torque', 'viscous', 'coulomb', 'offset')
    values = ([3.0, -2.0, 5.0], *(np.linspace(low, 2.0 * low, 7) for low in (2.0, 1.0, 0.5, 1e-3)))
    given = {f'events.{name}': list(value) for name, value in zip(names, values, strict=True)}
    arm = plant_of(panda(**{'events.begin': [0.1], **given}))
    truth = arm.truth().copy()
    for torque in swinging_torques(101):
        truth = arm.truth().copy()
        arm.step(torque)
    P = arm.arm.p
    q, dq = truth[P + 7 : P + 14], truth[P + 14 :]
    position, jacobian = np.zeros(3), np.zeros((3, 7))
    arm.arm.fill_tip(q, position, jacobian)
    expected = -values[1] + values[2] * dq + values[3] * np.tanh(dq / 0.01) - values[0] @ jacobian
    np.testing.assert_allclose(truth[P : P + 7], expected, rtol=1e-12)
    measured = arm.measure()[:7] - arm.truth()[-14:-7]
    np.testing.assert_allclose(measured, values[4], atol=1e-12)


def test_two_plants_of_a_urdf_are_independent_and_repeatable():
    torques = swinging_torques(50)
    first, second = plant_of(panda()), plant_of(panda(**{'load.payload': 1.0}))
    rows = []
    for torque in torques:
        first.step(torque)
        second.step(torque)
        rows.append(first.measure().copy())
    first.reset()
    for torque, row in zip(torques, rows, strict=True):
        first.step(torque)
        np.testing.assert_array_equal(first.measure(), row)
