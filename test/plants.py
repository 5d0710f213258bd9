# SPDX-License-Identifier: Apache-2.0
"""Plants for the tests: the arm of Section IV, ideal unless a test asks for more."""

import numpy as np

from blf_dsc_controller import PlantConfig
from blf_dsc_controller.configuration.schema import build, parameters
from sim_plant.arm import PointMassArm
from sim_plant.plant import plant_of

ARM = PointMassArm(l1=1.0, l2=0.8, m1=0.5, m2=0.5, g=9.8)
PERIOD = 1e-3  # s
START = (2.293, 1.696)  # rad
QUIET = (0.0, 0.0)


def energies(arm, q, dq):
    """Return the kinetic and potential energy of the arm's two point masses [J]."""
    (s1, c1), (s12, c12) = ((np.sin(angle), np.cos(angle)) for angle in np.cumsum(q))
    v1 = arm.l1 * dq[0] * np.array([-s1, c1])
    v2 = v1 + arm.l2 * (dq[0] + dq[1]) * np.array([-s12, c12])
    height1 = arm.l1 * s1
    kinetic = 0.5 * (arm.m1 * v1 @ v1 + arm.m2 * v2 @ v2)
    return kinetic, arm.g * (arm.m1 * height1 + arm.m2 * (height1 + arm.l2 * s12))


IDEAL = {'disturbance.constant': QUIET, 'disturbance.amplitude': QUIET}
NAMES = {
    param.name.rpartition('.')[2]: param.name
    for param in parameters(PlantConfig)
    if param.name.startswith(('sensor.', 'actuator.', 'disturbance.'))
}
ROUGH = {
    'constant': (0.1, -0.2),
    'amplitude': (0.1, 0.3),
    'frequency': (1.0, 7.0),
    'phase': (0.0, 0.4),
    'viscous': (0.05, 0.1),
    'coulomb': (0.2, 0.1),
    'coulomb_velocity': 0.5,
    'stribeck': 0.5,
}
"""Every kind of disturbance at once, different on each joint."""


def plant(**changes):
    """Return the arm of a `configuration`."""
    return plant_of(configuration(**changes))


def configuration(*, start=START, velocity=QUIET, **changes):
    """Return that of an arm at 1 kHz, named without sensor, actuator or disturbance."""
    given = IDEAL | {'initial.position': start, 'initial.velocity': velocity}
    given |= {NAMES.get(name, name): value for name, value in changes.items()}
    lists = (np.ndarray, tuple)
    given = {
        k: [float(x) for x in v] if isinstance(v, lists) else v
        for k, v in given.items()
    }
    return build(PlantConfig, given)


def commands(samples, seed=5):
    """Return torques (samples, 2) around those of gravity, so that the arm stays in place."""
    return np.random.default_rng(seed).normal([-6.0, -2.0], 3.0, (samples, 2))


def run(a_plant, torques):
    """Return the measurements (samples, 6) of a plant under the given torques."""
    rows = np.empty((len(torques), 6))
    for row, torque in zip(rows, torques, strict=True):
        row[:] = a_plant.measure()
        a_plant.step(torque)
    return rows


def rigid_gears(n, bound, rotor_factor=1.2):
    """Return overrides that make a preset of n joints what it is with rigid gears.

    The feedback acts through the inertia, with a bound [rad] of what this can hold.
    """
    shared = {'robot.torque_loop': False}
    plant = {
        'joint.stiffness': [],
        'truth.rotor_inertia': [],
        'truth.rotor_factor': rotor_factor,
        'actuator.loop_gain': 0.0,
        'actuator.loop_damping': 0.0,
        'actuator.loop_lag': 0.0,
    }
    law = {
        'feedback.inertia': 'whole',
        'feedback.joint_stiffness': None,
        'feedback.joint_damping': None,
        'barrier.bound': [bound] * n,
    }
    return {'sim_plant': shared | plant, 'blf_dsc_controller': shared | law}
