# SPDX-License-Identifier: Apache-2.0
"""Load and active events acting on the arm in a sample.

They are held over the sample, and independent of the kind of arm.
"""

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from sim_plant.disturbance import JointDisturbance


class LoadSettings(NamedTuple):
    """Load that acts all the time."""

    payload: float  # kg, point mass at the tip
    torque: Annotated[Array, 'n']  # N m, pushes the joints
    force: Annotated[Array, '3']  # N, pushes the tip, in the frame of the base
    offset: Annotated[Array, 'n']  # rad, measured minus true position


class EventSettings(NamedTuple):
    """Contribution of each event to load and friction; times are in samples."""

    begin: Annotated[Array, 'events']
    end: Annotated[Array, 'events']  # infinite: permanent
    ramp: Annotated[Array, 'events']
    payload: Annotated[Array, 'events']
    sloshing: Annotated[Array, 'events']
    torque: Annotated[Array, 'events', 'n']
    force: Annotated[Array, 'events', '3']
    viscous: Annotated[Array, 'events', 'n']
    coulomb: Annotated[Array, 'events', 'n']
    offset: Annotated[Array, 'events', 'n']


class Acting(NamedTuple):
    """Sum of load and events in one sample."""

    sample: Cell  # of the sum; -1: none yet
    payload: Cell  # kg
    sloshing: Cell  # kg
    force: Annotated[Array, '3']  # N
    offset: Annotated[Array, 'n']  # rad
    constant: Annotated[Array, 'n']  # N m, of the disturbance, less torques that push the joints
    viscous: Annotated[Array, 'n']  # N m s/rad, not below zero
    coulomb: Annotated[Array, 'n']  # N m, not below zero


@inner
def come(sample: float, at: float, ramp: float) -> float:
    """Return the fraction, from 0 to 1, of a ramp of `ramp` samples that begins at sample `at`."""
    if sample < at:
        return 0.0
    if sample >= at + ramp:
        return 1.0
    return (sample - at) / ramp


@inner
def add(total: np.ndarray, fraction: float, one: np.ndarray) -> None:
    """Add a fraction of one vector to another."""
    for i in range(total.size):
        total[i] += fraction * one[i]


@inner
def put(target: np.ndarray, values: np.ndarray) -> None:
    """Copy a vector; `target[:] = values` compiles ten functions just for a shape error."""
    for i in range(target.size):
        target[i] = values[i]


@inner
def update_acting(
    disturbance: JointDisturbance,
    load: LoadSettings,
    events: EventSettings,
    sample: float,
    acting: Acting,
) -> None:
    """Sum load and events of a sample, unless already done."""
    if acting.sample[0] == sample:
        return
    acting.sample[0] = sample
    acting.payload[0] = load.payload
    acting.sloshing[0] = 0.0
    put(acting.force, load.force)
    put(acting.offset, load.offset)
    put(acting.constant, disturbance.constant)
    put(acting.viscous, disturbance.viscous)
    put(acting.coulomb, disturbance.coulomb)
    add(acting.constant, -1.0, load.torque)
    for e in range(events.begin.size):
        fraction = come(sample, events.begin[e], events.ramp[e])
        fraction -= come(sample, events.end[e], events.ramp[e])
        if fraction != 0.0:
            acting.payload[0] += fraction * events.payload[e]
            acting.sloshing[0] += fraction * events.sloshing[e]
            add(acting.force, fraction, events.force[e])
            add(acting.offset, fraction, events.offset[e])
            add(acting.constant, -fraction, events.torque[e])
            add(acting.viscous, fraction, events.viscous[e])
            add(acting.coulomb, fraction, events.coulomb[e])
    for i in range(acting.viscous.size):
        acting.viscous[i] = max(acting.viscous[i], 0.0)
        acting.coulomb[i] = max(acting.coulomb[i], 0.0)
