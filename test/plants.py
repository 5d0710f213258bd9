# SPDX-License-Identifier: Apache-2.0
"""Plants for the tests: the arm of Section IV, ideal unless a test asks for more."""

import numpy as np

from sim_plant.arm import PointMassArm
from sim_plant.drives import Compensation, Drives, lag
from sim_plant.kernels import PlantSettings
from sim_plant.motion import (
    Acting,
    EventSettings,
    JointDisturbance,
    LoadSettings,
    Motion,
    SloshSettings,
    TipState,
    WallSettings,
)
from sim_plant.plant import Plant
from sim_plant.sensors import MEASURED, Encoders

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


def points(l1, l2, q):
    """Return base, elbow and tip [m] at the joint positions q [rad]."""
    elbow = l1 * np.array([np.cos(q[0]), 0.0, np.sin(q[0])])
    angle = q[0] + q[1]
    return np.zeros(3), elbow, elbow + l2 * np.array([np.cos(angle), 0.0, np.sin(angle)])


def disturbance(**terms):
    """Return a disturbance of two joints, zero by default; each term for both or per joint."""
    none = dict.fromkeys(JointDisturbance._fields, 0.0) | {'frequency': 1.0}
    terms = none | {'coulomb_velocity': 0.01, 'stribeck_velocity': 0.1} | terms
    scalars = ('stribeck', 'stribeck_velocity', 'ripple_frequency')
    each = {name: np.full(2, value, float) for name, value in terms.items()}
    return JointDisturbance(**each | {name: float(terms[name]) for name in scalars})


def rough_disturbance():
    """Return every kind of disturbance at once, different on each joint."""
    return disturbance(
        constant=[0.1, -0.2],
        amplitude=[0.1, 0.3],
        frequency=[1.0, 7.0],
        phase=[0.0, 0.4],
        viscous=[0.05, 0.1],
        coulomb=[0.2, 0.1],
        coulomb_velocity=0.5,
        stribeck=0.5,
        ripple=[0.1, 0.05],
        ripple_frequency=20.0,
    )


def full_plant(**changes):
    """Return a plant with every kind of imperfection."""
    imperfections = {
        'position_noise': 1e-5,
        'velocity_noise': 1e-3,
        'resolution': 1e-5,
        'torque_limit': (8.0, 3.0),
        'delay': 2,
        'time_constant': 2e-3,
        'torque_noise': 0.01,
        'velocity_pole': 400.0,
    }
    return plant(load=rough_disturbance(), **imperfections | changes)


NOWHERE = WallSettings(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0, 0.0)
UNLOADED = LoadSettings(0.0, *(np.zeros(size) for size in (2, 3, 2)))
CALM = SloshSettings(0.0, 0.0, np.zeros(3))
UNEVENTFUL = EventSettings(*np.zeros((5, 0)), *(np.zeros((0, size)) for size in (2, 3, 2, 2, 2)))


def motion(arm=ARM, load=None, force=(0.0, 0.0, 0.0), wall=NOWHERE):
    """Return the equation of motion of an arm with a disturbance and a force at its tip."""
    tip = TipState(np.zeros(3), np.zeros(3), np.zeros((3, 2)), np.zeros(3), np.zeros(3))
    load, nothing = load or disturbance(), np.zeros(1)
    friction = load.constant, load.viscous, load.coulomb
    acting = Acting(nothing, nothing, nothing, np.array(force), np.zeros(2), *friction)
    return Motion(arm, load, acting, wall, CALM, tip)


def settings(
    *,
    period_ns=1_000_000,
    load=None,
    position_noise=0.0,
    velocity_noise=0.0,
    resolution=0.0,
    velocity_source=MEASURED,
    velocity_pole=0.0,
    torque_limit=(0.0, 0.0),
    delay=0,
    time_constant=0.0,
    torque_noise=0.0,
    step=0.0,
):
    """Return settings of the arm of Section IV, by default at 1 kHz."""
    return PlantSettings(
        arm=ARM,
        n=2,
        p=3,
        period_ns=period_ns,
        steps=1,
        events=0,
        encoders=Encoders(
            position_noise, velocity_noise, resolution, velocity_source, velocity_pole, 0
        ),
        disturbance=disturbance() if load is None else load,
        drives=Drives(
            np.array(torque_limit), delay, *lag(time_constant, period_ns * 1e-9), torque_noise
        ),
        compensation=Compensation(0.0, 1, 1.0, step, 0.0),
        drive_size=0,
        drive_memory=0,
        drive_bodies=np.zeros(0),
        load=UNLOADED,
        wall=NOWHERE,
        slosh=CALM,
        schedule=UNEVENTFUL,
    )


def plant(*, seed=0, start=START, velocity=(0.0, 0.0), **changes):
    """Return a plant, by default at the paper's initial position."""
    return Plant(settings(**changes), start, velocity, seed)


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
