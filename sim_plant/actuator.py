# SPDX-License-Identifier: Apache-2.0
"""The path of a commanded torque to the joint: a delay, then a limit."""

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array


class Drives(NamedTuple):
    """Torque limit and input delay."""

    torque_limit: Annotated[Array, 'n']  # N m, 0 = none
    delay: int  # samples


class DriveState(NamedTuple):
    """The torque applied last, and a ring of those still delayed."""

    applied: Annotated[Array, 'n']  # N m
    ring: Annotated[Array, 'drives.delay', 'n']  # N m


@inner
def limited(torque: float, limit: float) -> float:
    """Torque within +-limit; a limit of 0 is none."""
    if limit == 0.0:
        return torque
    return min(max(torque, -limit), limit)


@inner
def actuate(drives: Drives, sample: int, command: np.ndarray, state: DriveState) -> None:
    """Take the command of this sample and write the torque applied in it into the state.

    Until the first command has come through the delay, the applied torque is zero.
    """
    for i in range(command.size):
        torque = command[i]
        if drives.delay > 0:
            slot = sample % drives.delay
            torque = state.ring[slot, i]
            state.ring[slot, i] = command[i]
        state.applied[i] = limited(torque, drives.torque_limit[i])
