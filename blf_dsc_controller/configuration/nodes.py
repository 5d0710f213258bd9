# SPDX-License-Identifier: Apache-2.0
"""The nodes of the package, what each can be told, and what they must agree on."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.markers import MarkersConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.recorder import RecorderConfig
from blf_dsc_controller.configuration.schema import parameters

if TYPE_CHECKING:
    from collections.abc import Mapping

PLANT = 'sim_plant'
CONTROLLER = 'blf_dsc_controller'
RECORDER = 'bag_recorder'
MARKERS = 'arm_markers'

NODES: Mapping[str, type[PlantConfig | ControllerConfig | RecorderConfig | MarkersConfig]] = {
    PLANT: PlantConfig,
    CONTROLLER: ControllerConfig,
    RECORDER: RecorderConfig,
    MARKERS: MarkersConfig,
}


class LoopConfig(NamedTuple):
    """The configuration of all nodes of a closed loop."""

    plant: PlantConfig
    controller: ControllerConfig
    recorder: RecorderConfig

    @property
    def by_node(self) -> dict[str, PlantConfig | ControllerConfig | RecorderConfig]:
        """The configurations under the names of their nodes."""
        return {PLANT: self.plant, CONTROLLER: self.controller, RECORDER: self.recorder}

    def problems(self) -> list[str]:
        """Return where plant and controller contradict each other, in words."""
        plant, controller = self.plant, self.controller
        problems = []
        if plant.sample_time_ns != controller.sample_time_ns:
            problems.append(
                f'sample_time: {PLANT} has {plant.sample_time:g} s, but {CONTROLLER} has '
                f'{controller.sample_time:g} s: give it once, under /**'
            )
        if sorted(plant.joints) != sorted(controller.joints):
            problems.append(
                f'joints: {PLANT} has {", ".join(plant.joints)}, but {CONTROLLER} has '
                f'{", ".join(controller.joints)}: give them once, under /**'
            )
        return problems


def known_names() -> frozenset[str]:
    """Every parameter name that some node of the package has."""
    return frozenset(one.name for cls in NODES.values() for one in parameters(cls))
