# SPDX-License-Identifier: Apache-2.0
"""What happens to a commanded torque on its way to the joint: a delay, then a limit."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.compiled.jit import inner


class Actuator(NamedTuple):
    """Torque limit and input delay."""

    torque_limit: NDArray[np.float64]  # (n,) N m, 0 = none
    delay: int  # samples


class ActuatorState(NamedTuple):
    """What was applied last and, in a ring, what is still on its way."""

    applied: NDArray[np.float64]  # (n,) N m
    ring: NDArray[np.float64]  # (delay, n) N m


@inner
def actuator_view(flat: NDArray[np.float64]) -> Actuator:
    """Read an actuator from its (n + 1,) vector."""
    n = flat.size - 1
    return Actuator(flat[:n], int(flat[n]))


@inner
def limited(torque: float, limit: float) -> float:
    """Return the torque within +-limit; a limit of 0 is none."""
    if limit == 0.0:
        return torque
    return min(max(torque, -limit), limit)


@inner
def actuate(
    actuator: Actuator, sample: int, command: NDArray[np.float64], state: ActuatorState
) -> None:
    """Take the command of this sample and write the torque applied in it into the state.

    Until the first command has come through the delay, the applied torque is zero.
    """
    for i in range(command.size):
        torque = command[i]
        if actuator.delay > 0:
            slot = sample % actuator.delay
            torque = state.ring[slot, i]
            state.ring[slot, i] = command[i]
        state.applied[i] = limited(torque, actuator.torque_limit[i])
