# SPDX-License-Identifier: Apache-2.0
"""Arms with springs, torque loops and a base that gives way: other integrators, and limits."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('mujoco', reason='needs MuJoCo: pip install mujoco')

import mujoco
from scipy.integrate import solve_ivp

from blf_dsc_controller import PlantConfig
from blf_dsc_controller.configuration.schema import build
from sim_plant.mujoco_plant import spec_of
from sim_plant.plant import plant_of

MASS, LEVER, INERTIA, ROTOR = 2.0, 0.3, 0.05, 0.2  # kg, m, kg m^2, kg m^2
M = INERTIA + MASS * LEVER**2
WEIGHT = MASS * 9.81 * LEVER  # N m
K, RATIO = 5e3, 0.04
REDUCED = M * ROTOR / (M + ROTOR)
DAMPING = 2.0 * RATIO * np.sqrt(K * REDUCED)
PENDULUM = f"""
<robot name="pendulum">
  <link name="base"/>
  <link name="tip"><inertial><mass value="{MASS}"/><origin xyz="{LEVER} 0 0"/>
    <inertia ixx="{INERTIA}" iyy="{INERTIA}" izz="{INERTIA}" ixy="0" ixz="0" iyz="0"/>
  </inertial></link>
  <joint name="swing" type="revolute"><parent link="base"/><child link="tip"/>
    <axis xyz="0 -1 0"/><limit lower="-3" upper="3" effort="80" velocity="5"/></joint>
</robot>
"""
SPRING = {
    'robot.urdf': PENDULUM,
    'joints': ['swing'],
    'truth.rotor_inertia': [ROTOR],
    'joint.stiffness': [K],
    'joint.damping_ratio': RATIO,
    'initial.position': [0.4],
}
PANDA = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}


def pendulum(**changes):
    """Return a plant of one joint, with parameters by names with `__` for dots."""
    given = {name.replace('__', '.'): value for name, value in changes.items()}
    return plant_of(build(PlantConfig, SPRING | given))


def step_torques(samples):
    """Return torques (samples, 1) [N m] that hold the weight, and jump."""
    levels = np.array([8.0, -5.0, 12.0, 0.0])
    return np.resize(np.repeat(levels, 25), samples)[:, None]


def states_of(arm, torques):
    """Return q, dq, theta, dtheta (samples, 4, n) before each step."""
    rows = []
    for torque in torques:
        q, dq = arm.truth()[-2 * arm.joints :].reshape(2, -1)
        rows.append((q.copy(), dq.copy(), *arm.motors.copy()))
        arm.step(torque)
    return np.array(rows)


class Written:
    """The equations of one joint as on paper, for scipy."""

    def __init__(
        self,
        viscous=0.0,
        coulomb=0.0,
        share=0.0,
        asymmetry=0.0,
        play=0.0,
        loop=(),
        most=0.0,
        sensor=(1.0, 0.0),
    ):
        self.viscous, self.coulomb = viscous, coulomb
        self.driving, self.driven = share * (1.0 + asymmetry), share * (1.0 - asymmetry)
        self.play, self.loop, self.most = play, loop, most
        self.factor, self.offset = sensor

    def spring(self, q, dq, theta, dtheta):
        """Return the torque by the twist, its rate, and that of the damper."""
        twist = theta - q
        beyond = twist - np.clip(twist, -self.play, self.play)
        touches = float(beyond != 0.0 or self.play == 0.0)
        rate = touches * (dtheta - dq)
        return K * beyond, K * rate, DAMPING * rate

    def slope(self, _t, x, torque):
        q, dq, theta, dtheta, u, z = x
        spring, rate, damper = self.spring(q, dq, theta, dtheta)
        spring += z
        dz = 0.0
        if self.most:
            dz = K * (dtheta - dq) * (1.0 - np.sign(dtheta - dq) * z / self.most)
        s = spring + damper
        share = self.driving if s * dtheta > 0.0 else self.driven
        level = self.coulomb + share * abs(s)
        friction = self.viscous * dtheta + level * np.tanh(dtheta / 0.5)
        du = 0.0
        motor = torque
        if self.loop:
            gain, damping, lag = self.loop
            shown = self.factor * spring + self.offset
            wanted = torque + gain * (torque - shown) - damping * self.factor * rate
            du, motor = (wanted - u) / lag, u
        load = WEIGHT * np.cos(q)
        return dq, (s - load) / M, dtheta, (motor - friction - s) / ROTOR, du, dz

    def follow(self, torques, start):
        """Return q, dq, theta, dtheta (samples, 4) before each step of 1 ms."""
        x, rows = np.array(start), []
        for (torque,) in torques:
            rows.append(x[:4].copy())
            x = solve_ivp(
                self.slope, (0.0, 1e-3), x, args=(torque,), rtol=1e-10, atol=1e-12
            ).y[:, -1]
        return np.array(rows)


def start_of(play=0.0):
    """Return the state of the pendulum at rest, with its motor braked."""
    load = WEIGHT * np.cos(0.4)
    return 0.4, 0.0, 0.4 + load / K + play, 0.0, load, 0.0


@pytest.mark.parametrize(
    ('given', 'written'),
    [
        ({}, Written()),
        (
            {
                'disturbance__viscous': [2.0],
                'disturbance__coulomb': [3.0],
                'disturbance__load_share': 0.1,
                'disturbance__coulomb_velocity': 0.5,
            },
            Written(viscous=2.0, coulomb=3.0, share=0.1),
        ),
        (
            {
                'disturbance__load_share': 0.1,
                'disturbance__load_asymmetry': 0.6,
                'disturbance__coulomb_velocity': 0.5,
            },
            Written(share=0.1, asymmetry=0.6),
        ),
        (
            {
                'actuator__loop_gain': 4.0,
                'actuator__loop_damping': 8e-3,
                'actuator__loop_lag': 3e-4,
            },
            Written(loop=(4.0, 8e-3, 3e-4)),
        ),
        (
            {
                'actuator__loop_gain': 4.0,
                'actuator__loop_damping': 8e-3,
                'actuator__loop_lag': 3e-4,
                'sensor__torque_factor': [0.8],
                'sensor__torque_offset': [-1.0],
            },
            Written(loop=(4.0, 8e-3, 3e-4), sensor=(0.8, -1.0)),
        ),
        ({'joint__backlash': [2e-3]}, Written(play=1e-3)),
        ({'joint__hysteresis': [2.0]}, Written(most=2.0)),
    ],
    ids=[
        *('spring', 'friction', 'friction by the direction of the torque'),
        *('torque loop', 'sensor', 'backlash', 'hysteresis'),
    ],
)
def test_joint_with_a_spring_moves_as_an_independent_integration_says(given, written):
    """To a thousandth of the largest excursion of each quantity: the steps are 25 us."""
    torques = step_torques(200)
    ours = states_of(pendulum(**given), torques)[..., 0]
    theirs = written.follow(torques, start_of(written.play))
    scale = np.abs(theirs - theirs[0]).max(axis=0)
    np.testing.assert_array_less(np.abs(ours - theirs).max(axis=0) / scale, 1e-3)


def panda(**changes):
    """Return a Panda without friction at a bent posture, with the FR3's motors."""
    given = {
        'truth.rotor_inertia': [0.606, 0.606, 0.462, 0.462, 0.206, 0.206, 0.206],
        'disturbance.viscous': [0.0] * 7,
        'disturbance.coulomb': [0.0] * 7,
        'initial.position': [0.1, 0.3, -0.4, -1.9, 0.5, 2.0, 0.3],
    }
    given |= {name.replace('__', '.'): value for name, value in changes.items()}
    return build(PlantConfig, PANDA | given)


def swung(config, samples=300):
    """Return the measurements (samples, 3, n) of an arm with all joints swinging."""
    arm = plant_of(config)
    rows = []
    for k in range(samples):
        rows.append(arm.measure().reshape(3, -1).copy())
        arm.step(0.15 * np.sin(0.02 * k) * np.array(config.actuator.torque_limit))
    return np.array(rows)


def with_motors(config, damping):
    """Return MuJoCo's model of an arm with a body for each motor, whose spring is a tendon."""
    spec = spec_of(config)
    for i, name in enumerate(config.joints):
        rotor = config.truth.rotor_inertia[i]
        motor = spec.worldbody.add_body(
            name=f'motor{i}', mass=1.0, inertia=[1.0, 1.0, rotor], explicitinertial=True
        )
        motor.add_joint(name=f'theta{i}', type=mujoco.mjtJoint.mjJNT_HINGE)
        spring = spec.add_tendon(name=f'spring{i}', springlength=[0.0, 0.0])
        spring.wrap_joint(f'theta{i}', 1.0)
        spring.wrap_joint(name, -1.0)
    model = spec.compile()
    model.opt.timestep = 2.5e-5
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.dof_damping[:] = [0.0] * len(damping) + [*config.disturbance.viscous]
    model.dof_frictionloss[:] = model.jnt_limited[:] = 0.0
    model.tendon_stiffness[:] = config.joint.stiffness
    model.tendon_damping[:] = damping
    return model


def test_arm_with_springs_moves_as_mujocos_with_bodies_for_its_motors():
    """To 1e-6 rad of 0.65 rad, in 0.3 s; the springs give way by up to 2.5 mrad."""
    stiffness = [1e4, 2e4, 1e4, 5e3, 5e3, 5e3, 5e3]
    config = panda(joint__stiffness=stiffness, disturbance__viscous=[1.0] * 7)
    arm = plant_of(config)
    model = with_motors(config, arm._settings.transmission.damping)
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate((config.initial.position, arm.motors[0]))
    for k in range(300):
        torque = 0.15 * np.sin(0.02 * k) * np.array(config.actuator.torque_limit)
        arm.step(torque)
        data.qfrc_applied[7:] = torque
        mujoco.mj_step(model, data, 40)
        ours = np.concatenate((arm.truth()[-14:-7], arm.motors[0]))
        np.testing.assert_allclose(ours, data.qpos, rtol=0.0, atol=1e-6)
    assert np.abs(data.qpos[:7] - config.initial.position).max() > 0.5


@pytest.mark.parametrize(
    'given',
    [
        {'joint__stiffness': [1e4] * 7},
        {'base__mass': 60.0},
        {'joint__stiffness': [1e4, 0.0, 5e3, 1e4, 2e4, 1e4, 1e4], 'base__mass': 60.0},
    ],
)
def test_links_and_base_are_those_of_mujoco(given):
    """MuJoCo's M and C dq + G; all else is the same, so that only rounding differs."""
    given = {
        'truth__mass_deviation': 0.2,
        'truth__centre_deviation': 0.01,
        'load__payload': 1.0,
        'load__force': [5.0, 3.0, -4.0],
        **given,
    }
    ours, theirs = (
        swung(panda(physics=physics, **given)) for physics in ('own', 'mujoco')
    )
    np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-9)


def test_run_repeats_after_a_reset():
    """With everything that an elastic arm has: bit for bit."""
    config = panda(
        joint__stiffness=[1e4] * 7,
        joint__backlash=[4e-4] * 7,
        joint__hysteresis=[0.5] * 7,
        robot__effort='whole',
        sensor__torque_noise=[0.05] * 7,
        actuator__loop_gain=4.0,
        actuator__loop_damping=8e-3,
        actuator__delay=2,
        actuator__torque_noise=0.01,
        base__mass=60.0,
        sensor__position_noise=1e-5,
        sensor__eccentricity=[1e-3] * 7,
        disturbance__load_share=0.1,
        disturbance__warm_factor=0.6,
        events__begin=[0.01],
        events__sloshing=[1.0],
    )
    torques = 5.0 * np.sin(np.arange(60.0))[:, None] * np.ones(7)
    arm = plant_of(config)

    def run(torques):
        rows = []
        for torque in torques:
            rows.append(np.concatenate((arm.measure(), arm.truth())))
            arm.step(torque)
        return np.array(rows)

    first = run(torques)
    arm.reset()
    assert (run(torques) == first).all()
