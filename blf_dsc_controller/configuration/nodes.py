# SPDX-License-Identifier: Apache-2.0
"""The nodes of the package by name, their configurations, and what they must agree on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

from blf_dsc_controller.arms.two_link_geometry import urdf
from blf_dsc_controller.arms.urdf import Chain, read_chain
from blf_dsc_controller.configuration.common import joint_problems
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.robot import Robot, given_robot
from blf_dsc_controller.configuration.schema import Value, parameter, parameters

PLANT = 'sim_plant'
CONTROLLER = 'blf_dsc_controller'
RECORDER = 'bag_recorder'
MARKERS = 'arm_markers'
VIEW = 'view'
WATCHDOG = 'torque_watchdog'

_of_bag = partial(parameter, read_only='a bag is opened once, when the recorder starts')
_of_view = partial(parameter, read_only='the page is served once, when the node starts')
_of_markers = partial(parameter, read_only='it is read once, when the node starts')


@dataclass(frozen=True)
class RecorderConfig:
    """Parameters of the node `bag_recorder`."""

    output: str = _of_bag('bag', 'folder of the bag; it must not exist yet')
    topics: tuple[str, ...] = _of_bag((), 'topics to record; empty: all', may_be_empty=True)
    compression: Literal['none', 'zstd'] = _of_bag('none', 'compression of the chunks of the bag')
    queue_depth: int = _of_bag(
        100_000,
        'messages buffered per topic while the disk is busy',
        'messages',
        at_least=1,
    )
    split_size: float = _of_bag(
        0.0, 'size at which the bag continues in a new file; 0: never', 'MB', at_least=0.0
    )
    split_duration: float = _of_bag(
        0.0, 'duration at which the bag continues in a new file; 0: never', 's', at_least=0.0
    )
    clock: Literal['wall', 'plant'] = _of_bag(
        'wall',
        'log times: as received, or (lock-step) the stamp of the last joint state, so that the bag '
        'plays at the speed of the arm',
    )

    def problems(self) -> list[str]:
        """Check that the folder has a name."""
        return [] if self.output.strip() else ['output: got no folder name to write the bag into']


@dataclass(frozen=True)
class MarkerArm:
    """Link lengths of the drawn arm."""

    l1: float = _of_markers(1.0, 'length of the first link', 'm', 'l1', above=0.0)
    l2: float = _of_markers(0.8, 'length of the second link', 'm', 'l2', above=0.0)


@dataclass(frozen=True)
class MarkersConfig:
    """Parameters of the node `arm_markers`."""

    joints: tuple[str, ...] = _of_markers(
        ('joint1', 'joint2'), 'names of the joints, from the base'
    )
    frame: str = _of_markers('base_link', 'frame of the markers')
    period: float = _of_markers(0.1, 'time between two updates of the markers', 's', above=0.0)
    torque_scale: float = _of_markers(0.05, 'arrow length per torque', 'm/(N m)', above=0.0)
    arm: MarkerArm = MarkerArm()
    robot: Robot = Robot()

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Value]:
        """Return the joints of a URDF, and its base as the frame."""
        if not given.get('robot.urdf'):
            return {}
        chain = given_robot(given, given.get('joints'))[1]
        return {'joints': tuple(joint.name for joint in chain.joints), 'frame': chain.base}

    @property
    def chain(self) -> Chain:
        """The arm to draw."""
        if self.robot.urdf:
            return self.robot.chain(self.joints)
        lengths = self.arm.l1, self.arm.l2
        text = urdf(MARKERS, self.joints, lengths, (1.0, 1.0), (0.0, 0.0))
        return read_chain(text, 'base_link', 'tip', self.joints)

    def problems(self) -> list[str]:
        """Check the joints."""
        needed = None if self.robot.urdf else 2
        return joint_problems(self.joints, 'the arm of the markers', needed)


@dataclass(frozen=True)
class WatchdogConfig:
    """Parameters of the node `torque_watchdog`."""

    timeout: float = parameter(
        0.05,
        'silence of the controller, while joint states go on, after which it commands',
        's',
        at_least=0.005,
        at_most=10.0,
        read_only='it is read once, when the node starts',
    )


@dataclass(frozen=True)
class ViewConfig:
    """Parameters of the node `view`."""

    host: str = _of_view('127.0.0.1', 'address of this computer on which the page is served')
    port: int = _of_view(
        8080, 'port of the page; if taken, the next free one', at_least=1, at_most=65535
    )


NODES: Mapping[
    str,
    type[
        PlantConfig
        | ControllerConfig
        | RecorderConfig
        | MarkersConfig
        | ViewConfig
        | WatchdogConfig
    ],
] = {
    PLANT: PlantConfig,
    CONTROLLER: ControllerConfig,
    RECORDER: RecorderConfig,
    MARKERS: MarkersConfig,
    VIEW: ViewConfig,
    WATCHDOG: WatchdogConfig,
}


class LoopConfig(NamedTuple):
    """The configurations of all nodes of a closed loop, as `load_loop` reads them."""

    plant: PlantConfig
    controller: ControllerConfig
    recorder: RecorderConfig

    @property
    def by_node(self) -> dict[str, PlantConfig | ControllerConfig | RecorderConfig]:
        """The configurations by node name."""
        return {PLANT: self.plant, CONTROLLER: self.controller, RECORDER: self.recorder}

    def problems(self) -> list[str]:
        """Check that plant and controller agree on sample time and joints."""
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
    """Return the parameter names of all nodes of the package."""
    return frozenset(one.name for cls in NODES.values() for one in parameters(cls))


def is_builtin(name: str) -> bool:
    """Whether ROS itself, not this package, declares the parameter."""
    builtin = ('use_sim_time', 'start_type_description_service')
    return name in builtin or name.startswith('qos_overrides.')
