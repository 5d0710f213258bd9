# SPDX-License-Identifier: Apache-2.0
"""The plant of a configuration: with our mechanics, or with those of MuJoCo."""

from __future__ import annotations

from blf_dsc_controller.configuration.plant import PlantConfig
from sim_plant.mujoco_plant import MujocoPlant
from sim_plant.sampled_plant import Plant
from sim_plant.settings import plant_settings


def plant_of(config: PlantConfig) -> Plant:
    """Return the plant of a configuration, at sample 0.

    Raises:
        BlfDscError: its physics is MuJoCo's, which is missing or cannot read the arm.
    """
    if config.physics == 'mujoco':
        return MujocoPlant(config)
    start = config.initial
    return Plant(plant_settings(config), start.position, start.velocity, config.seed)
