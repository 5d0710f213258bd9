# SPDX-License-Identifier: Apache-2.0
"""Plants for the tests: the arm of Section IV, ideal unless a test asks for more."""

import numpy as np

from sim_plant.actuator import Actuator
from sim_plant.disturbance import disturbance_vector
from sim_plant.dynamics import Arm
from sim_plant.integrator import DOPRI5
from sim_plant.plant import PlantSettings
from sim_plant.sampled import Plant
from sim_plant.sensors import MEASURED, Sensor

ARM = Arm(l1=1.0, l2=0.8, m1=0.5, m2=0.5, g=9.8)
ODD_ARM = Arm(l1=0.7, l2=1.1, m1=1.3, m2=0.4, g=9.81)  # no two of its numbers are the same
PERIOD = 1e-3  # s
START = (2.293, 1.696)  # rad


def disturbance(
    constant=0.0,
    amplitude=0.0,
    frequency=1.0,
    phase=0.0,
    viscous=0.0,
    coulomb=0.0,
    coulomb_velocity=0.01,
):
    """Disturbance vector of two joints, none unless asked for."""
    vector = disturbance_vector(
        constant=constant,
        amplitude=amplitude,
        frequency=frequency,
        phase=phase,
        viscous=viscous,
        coulomb=coulomb,
        coulomb_velocity=coulomb_velocity,
    )
    return vector if vector.size > 7 else np.tile(vector, 2)


def rough_disturbance():
    """Every kind of disturbance at once, different on each joint."""
    return disturbance(
        constant=[0.1, -0.2],
        amplitude=[0.1, 0.3],
        frequency=[1.0, 7.0],
        phase=[0.0, 0.4],
        viscous=[0.05, 0.1],
        coulomb=[0.2, 0.1],
        coulomb_velocity=0.5,
    )


def settings(
    *,
    integrator=DOPRI5,
    load=None,
    position_noise=0.0,
    velocity_noise=0.0,
    resolution=0.0,
    velocity_source=MEASURED,
    torque_limit=(0.0, 0.0),
    delay=0,
):
    """Settings of the arm of Section IV at 1 kHz."""
    return PlantSettings(
        period_ns=1_000_000,
        integrator=integrator,
        arm=ARM,
        sensor=Sensor(position_noise, velocity_noise, resolution, velocity_source),
        disturbance=disturbance() if load is None else load,
        actuator=Actuator(np.array(torque_limit), delay),
    )


def plant(*, seed=0, velocity=(0.0, 0.0), **changes):
    """A plant at the paper's initial position."""
    return Plant(settings(**changes), START, velocity, seed)


def commands(samples, seed=5):
    """Torques, (samples, 2), about what gravity asks for, so that the arm stays where it is."""
    return np.random.default_rng(seed).normal([-6.0, -2.0], 3.0, (samples, 2))


def run(a_plant, torques):
    """Measurements, (samples, 6), of a plant that answers with the given torques."""
    rows = np.empty((len(torques), 6))
    for row, torque in zip(rows, torques, strict=True):
        row[:] = a_plant.measure()
        a_plant.step(torque)
    return rows
