# SPDX-License-Identifier: Apache-2.0
"""What an arm goes through: payloads, pushes, changed friction, encoder offsets, a wall.

`load` acts as long as it is set, `events` at their time. Vectors at the tip are in the frame of the
base: x to the right, z upwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from blf_dsc_controller.configuration.common import PerJoint
from blf_dsc_controller.configuration.schema import non_negative, parameter

Vector = Annotated[tuple[float, ...], '3']
PerEvent = Annotated[tuple[float, ...], 'events.begin']
PerEventAndJoint = Annotated[tuple[float, ...], 'events.begin', 'joints']

_of_events = partial(parameter, (), omittable=True)


@dataclass(frozen=True)
class Load:
    """What acts on the arm beside its motors."""

    payload: float = non_negative(0.0, 'point mass at the tip', 'kg')
    torque: PerJoint = parameter((0.0, 0.0), 'torque that pushes each joint', 'N m')
    force: Vector = parameter((0.0, 0.0, 0.0), 'force that pushes the tip', 'N')


@dataclass(frozen=True)
class Wall:
    """A plane that pushes the tip back, as a spring and a damper that never pull."""

    point: Vector = parameter((0.0, 0.0, 0.0), 'a point of the plane', 'm')
    normal: Vector = parameter((0.0, 0.0, 1.0), 'direction in which it pushes')
    stiffness: float = non_negative(0.0, 'force per depth; 0: no wall', 'N/m')
    damping: float = non_negative(0.0, 'force per velocity into the wall', 'N s/m')

    def problems(self) -> list[str]:
        """Require a direction."""
        if any(self.normal):
            return []
        return ['wall.normal: got [0.0, 0.0, 0.0], but a direction is needed']


@dataclass(frozen=True)
class Events:
    """Each event adds to the load, to the friction and to the encoders' offsets for a while.

    An event comes and goes at whole samples; during a ramp it acts by the fraction that has passed.
    """

    begin: tuple[float, ...] = parameter(
        (), 'time of each event from the start', 's', at_least=0.0, may_be_empty=True
    )
    duration: PerEvent = _of_events('time after which it ends; 0: it stays', unit='s', at_least=0.0)
    ramp: PerEvent = _of_events('time in which it comes, and goes', unit='s', at_least=0.0)
    payload: PerEvent = _of_events('point mass at the tip', unit='kg', at_least=0.0)
    force: Annotated[tuple[float, ...], 'events.begin', '3'] = _of_events(
        'force that pushes the tip', unit='N'
    )
    torque: PerEventAndJoint = _of_events('torque that pushes each joint', unit='N m')
    viscous: PerEventAndJoint = _of_events('change of the viscous friction', unit='N m s/rad')
    coulomb: PerEventAndJoint = _of_events('change of the Coulomb friction', unit='N m')
    offset: PerEventAndJoint = _of_events('change of the offset of the encoder', unit='rad')
