# SPDX-License-Identifier: Apache-2.0
"""Loads and events of the simulated arm: payloads, pushes, friction, encoder offsets, a wall.

A load acts as long as it is set, an event from its time on. Vectors at the tip are in the base
frame: x to the right, z upwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from blf_dsc_controller.configuration.common import PerJoint
from blf_dsc_controller.configuration.schema import non_negative, parameter, positive

Vector = Annotated[tuple[float, ...], '3']
PerEvent = Annotated[tuple[float, ...], 'events.begin']
PerEventAndJoint = Annotated[tuple[float, ...], 'events.begin', 'joints']

_of_events = partial(parameter, (), omittable=True)


@dataclass(frozen=True)
class Load:
    """Loads that act on the arm besides its motors."""

    payload: float = non_negative(0.0, 'point mass at the tip', 'kg')
    torque: PerJoint = parameter((0.0, 0.0), 'external torque on each joint', 'N m')
    force: Vector = parameter((0.0, 0.0, 0.0), 'external force on the tip', 'N')


@dataclass(frozen=True)
class Wall:
    """Plane that pushes the tip back like a spring and a damper, but never pulls it."""

    point: Vector = parameter((0.0, 0.0, 0.0), 'a point on the plane', 'm')
    normal: Vector = parameter((0.0, 0.0, 1.0), 'direction in which the wall pushes')
    stiffness: float = non_negative(0.0, 'force per penetration depth; 0: no wall', 'N/m')
    damping: float = non_negative(0.0, 'force per velocity into the wall', 'N s/m')

    def problems(self) -> list[str]:
        """Require a non-zero normal."""
        if any(self.normal):
            return []
        return ['wall.normal: got [0.0, 0.0, 0.0], but a direction is needed']


@dataclass(frozen=True)
class Events:
    """Events, each of which adds to the load, the friction and the encoder offsets for a while.

    Events begin and end at whole samples; a ramp scales an event by the elapsed fraction.
    """

    begin: tuple[float, ...] = parameter(
        (), 'time at which each event begins, from the start', 's', at_least=0.0, may_be_empty=True
    )
    duration: PerEvent = _of_events('duration of each event; 0: permanent', unit='s', at_least=0.0)
    ramp: PerEvent = _of_events('time to fade in, and to fade out', unit='s', at_least=0.0)
    payload: PerEvent = _of_events('point mass at the tip', unit='kg', at_least=0.0)
    sloshing: PerEvent = _of_events(
        'point mass on a damped spring at the tip', unit='kg', at_least=0.0
    )
    sloshing_frequency: float = positive(15.0, 'undamped frequency of this spring', 'rad/s')
    sloshing_damping: float = non_negative(0.05, 'damping ratio of this spring')
    force: Annotated[tuple[float, ...], 'events.begin', '3'] = _of_events(
        'external force on the tip', unit='N'
    )
    torque: PerEventAndJoint = _of_events('external torque on each joint', unit='N m')
    viscous: PerEventAndJoint = _of_events('change in viscous friction', unit='N m s/rad')
    coulomb: PerEventAndJoint = _of_events('change in Coulomb friction', unit='N m')
    offset: PerEventAndJoint = _of_events('change in encoder offset', unit='rad')
