# SPDX-License-Identifier: Apache-2.0
"""The nodes of the package, their configurations, and what they must agree on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import parameter, parameters

if TYPE_CHECKING:
    from collections.abc import Mapping

_AT_START = 'a bag is opened once, when the recorder starts'


@dataclass(frozen=True)
class RecorderConfig:
    """Parameters of `bag_recorder`."""

    output: str = parameter(
        'bag',
        'folder the bag is written into; it must not exist yet',
        read_only=_AT_START,
    )
    topics: tuple[str, ...] = parameter(
        (),
        'topics to record; none named: all that appear',
        may_be_empty=True,
        read_only=_AT_START,
    )
    compression: str = parameter(
        'none',
        'compression of the chunks of the bag',
        choices=('none', 'zstd'),
        read_only=_AT_START,
    )
    queue_depth: int = parameter(
        100_000,
        'messages of a topic that may wait while the disk is busy',
        unit='messages',
        at_least=1,
        read_only=_AT_START,
    )

    split_size: float = parameter(
        0.0,
        'size at which a new file of the bag is begun; 0: never',
        unit='MB',
        at_least=0.0,
        read_only=_AT_START,
    )
    split_duration: float = parameter(
        0.0,
        'time after which a new file of the bag is begun; 0: never',
        unit='s',
        at_least=0.0,
        read_only=_AT_START,
    )
    ring: float = parameter(
        0.0,
        'keep only this last time, in memory, and write it on the service trigger; 0: write all',
        unit='s',
        at_least=0.0,
        read_only=_AT_START,
    )

    def problems(self) -> list[str]:
        """Return what is wrong beside the ranges of single parameters, in words."""
        return [] if self.output.strip() else ['output: got no folder name to write the bag into']


_AT_START = 'it is looked at once, when the node starts'


@dataclass(frozen=True)
class DrawnArm:
    """The lengths that it is drawn with."""

    l1: float = parameter(
        1.0, 'length of the first link', unit='m', symbol='l1', above=0.0, read_only=_AT_START
    )
    l2: float = parameter(
        0.8, 'length of the second link', unit='m', symbol='l2', above=0.0, read_only=_AT_START
    )


@dataclass(frozen=True)
class MarkersConfig:
    """Parameters of `arm_markers`."""

    joints: tuple[str, ...] = parameter(
        ('joint1', 'joint2'), 'names of the joints, from the base on', read_only=_AT_START
    )
    frame: str = parameter('base_link', 'frame that the markers are drawn in', read_only=_AT_START)
    period: float = parameter(
        0.1, 'time from one picture to the next', unit='s', above=0.0, read_only=_AT_START
    )
    torque_scale: float = parameter(
        0.05, 'length of the arrow of a torque', unit='m/(N m)', above=0.0, read_only=_AT_START
    )
    arm: DrawnArm = DrawnArm()

    def problems(self) -> list[str]:
        """Return what is wrong beside the ranges of single parameters, in words."""
        if len(self.joints) == 2:
            return []
        return [f'joints: got {len(self.joints)}, but the arm that is drawn has 2']


_NAMES = ('use_sim_time', 'start_type_description_service')


_GROUPS = ('qos_overrides.',)


def is_builtin(name: str) -> bool:
    """Whether ROS, not this package, declares the parameter."""
    return name in _NAMES or name.startswith(_GROUPS)


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
