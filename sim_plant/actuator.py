# SPDX-License-Identifier: Apache-2.0
"""Path of a commanded torque to the joint: delay, limit, lag, and noise."""

from math import exp
from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array


class Drives(NamedTuple):
    """Properties of the drives of all joints.

    The lag is solved exactly for a held command; the torque applied in a sample is its mean.
    """

    torque_limit: Annotated[Array, 'n']  # N m, 0 = none
    delay: int  # samples
    decay: float  # of the lag over a sample, exp(-T / time constant); 0: no lag
    mean_decay: float  # its mean over the sample
    noise: float  # standard deviation, relative to the torque


class DriveState(NamedTuple):
    """Last applied torque, motor torque at the end of the sample, and a ring of delayed torques."""

    applied: Annotated[Array, 'n']  # N m
    motor: Annotated[Array, 'n']  # N m
    noise: Annotated[Array, 'n']  # standard normal
    ring: Annotated[Array, 'drives.delay', 'n']  # N m


@inner
def limited(torque: float, limit: float) -> float:
    """Clamp a torque to +-limit; 0 means no limit."""
    if limit == 0.0:
        return torque
    return min(max(torque, -limit), limit)


@inner
def actuate(drives: Drives, sample: int, command: np.ndarray, state: DriveState) -> None:
    """Process the command of this sample and write the torque applied in it to the state.

    Until the first command has passed the delay, the applied torque is zero.
    """
    for i in range(command.size):
        torque = command[i]
        if drives.delay > 0:
            slot = sample % drives.delay
            torque = state.ring[slot, i]
            state.ring[slot, i] = command[i]
        torque = limited(torque, drives.torque_limit[i])
        if drives.decay > 0.0:
            lacking = state.motor[i] - torque
            state.motor[i] = torque + drives.decay * lacking
            torque += drives.mean_decay * lacking
        if drives.noise > 0.0:
            torque *= 1.0 + drives.noise * state.noise[i]
        state.applied[i] = torque


def lag(time_constant: float, period: float) -> tuple[float, float]:
    """Return decay and mean decay over a period [s] of a lag with a time constant [s] (0: none)."""
    if time_constant == 0.0:
        return 0.0, 0.0
    decay = exp(-period / time_constant)
    return decay, time_constant / period * (1.0 - decay)
