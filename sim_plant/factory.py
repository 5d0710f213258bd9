# SPDX-License-Identifier: Apache-2.0
"""From a configuration to the simulated plant."""

from __future__ import annotations

import dataclasses

import numpy as np

from blf_dsc_controller.configuration.plant import PlantConfig
from sim_plant import dynamics as arm
from sim_plant import integrator, sensors
from sim_plant.actuator import Actuator
from sim_plant.disturbance import disturbance_vector
from sim_plant.plant import PlantSettings
from sim_plant.sampled import Plant


def plant_of(config: PlantConfig) -> Plant:
    """Plant of a configuration, at its first sample."""
    settings = PlantSettings(
        period_ns=float(config.sample_time_ns),
        integrator=integrator.INTEGRATORS[config.integrator],
        arm=arm.Arm(*dataclasses.astuple(config.arm)),
        sensor=sensors.Sensor(
            config.sensor.position_noise,
            config.sensor.velocity_noise,
            config.sensor.resolution,
            sensors.VELOCITY_SOURCES[config.sensor.velocity],
        ),
        disturbance=disturbance_vector(**dataclasses.asdict(config.disturbance)),
        actuator=Actuator(np.array(config.actuator.torque_limit), config.actuator.delay),
    )
    return Plant(settings, config.initial.position, config.initial.velocity, config.seed)


def steps_of(config: PlantConfig) -> int:
    """Samples that the plant is stepped; 0 if it runs until it is stopped."""
    return round(config.duration / config.sample_time)
