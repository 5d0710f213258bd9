# SPDX-License-Identifier: Apache-2.0
"""The closed loop of the recommended configuration with each peer's simulator.

Each function runs for `duration` and returns the tracking errors (samples, 2) [rad]. All hold the
torque over the sample and apply the disturbance; only the integration of the arm differs.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.law.factory import settings_of_config

sys.path.append(str(Path(__file__).parents[2] / 'test'))
from plain_law import PlainLaw, dynamics

Step = Callable[[float, np.ndarray], None]
State = Callable[[], tuple[np.ndarray, np.ndarray]]

CONTROLLER = ControllerConfig()
PLANT = PlantConfig()
T = PLANT.sample_time
_ARM = PLANT.arm


def disturbance(t: float) -> np.ndarray:
    """Return tau_dist (2,) [N m]."""
    d = PLANT.disturbance
    wave = np.sin(np.multiply(d.frequency, t) + d.phase)
    return np.add(d.constant, np.multiply(d.amplitude, wave))


def run(duration: float, state: State, step: Step) -> np.ndarray:
    """Close the loop around a simulator with the numpy law."""
    law = PlainLaw(settings_of_config(CONTROLLER))
    reference = CONTROLLER.reference
    offset, swing = np.array(reference.offset), np.array(reference.amplitude)
    w = reference.frequency[0]
    errors = np.zeros((round(duration / T), 2))
    for k in range(len(errors)):
        t = k * T
        q, dq = state()
        qr = offset + swing * np.cos(w * t)
        dqr = -w * swing * np.sin(w * t)
        ddqr = -w * w * swing * np.cos(w * t)
        law.tau = law.update(t, T, qr, dqr, ddqr, np.concatenate((q, dq, law.tau)))
        errors[k] = q - qr
        step(t, law.tau)
    return errors


def numpy_loop(duration: float) -> np.ndarray:
    """Run the arm and a Dormand-Prince step in numpy, too."""
    return _integrated(duration, _numpy_acceleration)


def pinocchio_loop(duration: float) -> np.ndarray:
    """Run the arm by pinocchio's articulated-body algorithm, a Dormand-Prince step in numpy."""
    import pinocchio

    model = pinocchio.Model()
    parent = 0
    offset = 0.0
    for name, length, mass in (('joint1', _ARM.l1, _ARM.m1), ('joint2', _ARM.l2, _ARM.m2)):
        placement = pinocchio.SE3(np.eye(3), np.array([offset, 0.0, 0.0]))
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), placement, name)
        tip = np.array([length, 0.0, 0.0])
        inertia = pinocchio.Inertia(mass, tip, np.zeros((3, 3)))
        model.appendBodyToJoint(parent, inertia, pinocchio.SE3.Identity())
        offset = length
    model.gravity.linear = np.array([0.0, -_ARM.gravity, 0.0])
    data = model.createData()

    def acceleration(q: np.ndarray, dq: np.ndarray, torque: np.ndarray) -> np.ndarray:
        return np.asarray(pinocchio.aba(model, data, q, dq, torque))

    return _integrated(duration, acceleration)


def scipy_loop(duration: float) -> np.ndarray:
    """Run the arm by scipy's adaptive RK45, one call per sample, at default tolerances."""
    from scipy.integrate import solve_ivp

    x = np.concatenate((PLANT.initial.position, PLANT.initial.velocity))

    def step(t: float, torque: np.ndarray) -> None:
        def motion(s: float, y: np.ndarray) -> np.ndarray:
            net = torque - disturbance(s)
            return np.concatenate((y[2:], _numpy_acceleration(y[:2], y[2:], net)))

        x[:] = solve_ivp(motion, (t, t + T), x).y[:, -1]

    return run(duration, lambda: (x[:2].copy(), x[2:].copy()), step)


def mujoco_loop(duration: float) -> np.ndarray:
    """Run the arm by MuJoCo's RK4 at the sample time, with the disturbance held over it."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{T}" integrator="RK4" gravity="0 {-_ARM.gravity} 0"/>
        <worldbody><body><joint axis="0 0 1"/><geom type="sphere" size="0.01" mass="{_ARM.m1}"
        pos="{_ARM.l1} 0 0" contype="0" conaffinity="0"/><body pos="{_ARM.l1} 0 0"><joint
        axis="0 0 1"/><geom type="sphere" size="0.01" mass="{_ARM.m2}" pos="{_ARM.l2} 0 0"
        contype="0" conaffinity="0"/></body></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qpos[:] = PLANT.initial.position
    data.qvel[:] = PLANT.initial.velocity

    def step(t: float, torque: np.ndarray) -> None:
        data.qfrc_applied[:] = torque - disturbance(t + 0.5 * T)
        mujoco.mj_step(model, data)

    return run(duration, lambda: (data.qpos.copy(), data.qvel.copy()), step)


def drake_loop(duration: float) -> np.ndarray:
    """Run the arm by Drake's MultibodyPlant, a fixed Runge-Kutta 3 step of the sample time."""
    from pydrake.math import RigidTransform
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import (
        FixedOffsetFrame,
        RevoluteJoint,
        SpatialInertia,
        UnitInertia,
    )
    from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig

    plant = MultibodyPlant(0.0)
    parent = plant.world_frame()
    offset = 0.0
    for name, length, mass in (('joint1', _ARM.l1, _ARM.m1), ('joint2', _ARM.l2, _ARM.m2)):
        tip = np.array([length, 0.0, 0.0])
        inertia = SpatialInertia(mass, tip, UnitInertia.PointMass(tip))
        body = plant.AddRigidBody(f'{name}_link', inertia)
        place = plant.AddFrame(
            FixedOffsetFrame(f'{name}_frame', parent, RigidTransform([offset, 0.0, 0.0]))
        )
        joint = plant.AddJoint(RevoluteJoint(name, place, body.body_frame(), [0.0, 0.0, 1.0]))
        plant.AddJointActuator(name, joint)
        parent, offset = body.body_frame(), length
    plant.mutable_gravity_field().set_gravity_vector([0.0, -_ARM.gravity, 0.0])
    plant.Finalize()
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    plant.SetPositions(context, np.array(PLANT.initial.position))
    plant.SetVelocities(context, np.array(PLANT.initial.velocity))
    config = SimulatorConfig(
        integration_scheme='runge_kutta3', max_step_size=T, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    port = plant.get_actuation_input_port()
    simulator.Initialize()

    def step(t: float, torque: np.ndarray) -> None:
        port.FixValue(context, torque - disturbance(t + 0.5 * T))
        simulator.AdvanceTo(t + T)

    return run(duration, lambda: (plant.GetPositions(context), plant.GetVelocities(context)), step)


_A = (
    np.array([]),
    np.array([1 / 5]),
    np.array([3 / 40, 9 / 40]),
    np.array([44 / 45, -56 / 15, 32 / 9]),
    np.array([19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729]),
    np.array([9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656]),
)
_B = np.array([35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84])
_C = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0)


def _integrated(
    duration: float, acceleration: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    x = np.concatenate((PLANT.initial.position, PLANT.initial.velocity))
    k = np.zeros((6, 4))

    def step(t: float, torque: np.ndarray) -> None:
        for stage, (a, c) in enumerate(zip(_A, _C, strict=True)):
            y = x + T * (a @ k[:stage])
            net = torque - disturbance(t + c * T)
            k[stage, :2] = y[2:]
            k[stage, 2:] = acceleration(y[:2], y[2:], net)
        x[:] += T * (_B @ k)

    return run(duration, lambda: (x[:2].copy(), x[2:].copy()), step)


def _numpy_acceleration(q: np.ndarray, dq: np.ndarray, torque: np.ndarray) -> np.ndarray:
    arm = PLANT.arm
    P = ((arm.m1 + arm.m2) * arm.l1**2, arm.m2 * arm.l2**2, arm.m2 * arm.l1 * arm.l2)
    M, C, G = dynamics(P, arm.gravity / arm.l1, q, dq)
    return np.linalg.solve(M, torque - C @ dq - G)


def octave_loop(duration: float) -> int:
    """Run `closed_loop.m` in Octave for `duration` [s] and return the number of samples."""
    script = Path(__file__).with_name('closed_loop.m')
    command = ['octave', '--no-gui', '--quiet', str(script), str(duration)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return int(output.split()[-1])
