# SPDX-License-Identifier: Apache-2.0
"""The torque that opposes each joint: a constant, a sinusoid, friction, and ripple."""

from math import exp, sin, tanh
from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array


class JointDisturbance(NamedTuple):
    """Disturbance of each joint."""

    constant: Annotated[Array, 'n']  # N m
    amplitude: Annotated[Array, 'n']  # N m
    frequency: Annotated[Array, 'n']  # rad/s
    phase: Annotated[Array, 'n']  # rad
    viscous: Annotated[Array, 'n']  # N m s/rad
    coulomb: Annotated[Array, 'n']  # N m
    coulomb_velocity: Annotated[Array, 'n']  # rad/s, at which tanh reaches three quarters
    stribeck: float  # additional friction near rest, relative to Coulomb friction
    stribeck_velocity: float  # rad/s
    ripple: Annotated[Array, 'n']  # N m
    ripple_frequency: float  # rad/rad


@inner
def disturbance_torque(
    disturbance: JointDisturbance, t: float, q: np.ndarray, dq: np.ndarray, out: np.ndarray
) -> None:
    """Write tau_dist (n,) [N m] at time t [s].

    Friction has the sign of the velocity; Coulomb friction is smoothed by tanh, so that the
    fixed-step integrator keeps its order.
    """
    for i in range(dq.size):
        angle = disturbance.frequency[i] * t + disturbance.phase[i]
        torque = disturbance.constant[i] + disturbance.amplitude[i] * sin(angle)
        torque += disturbance.viscous[i] * dq[i]
        if disturbance.coulomb[i] != 0.0:
            level = disturbance.coulomb[i]
            if disturbance.stribeck != 0.0:
                speed = dq[i] / disturbance.stribeck_velocity
                level *= 1.0 + disturbance.stribeck * exp(-speed * speed)
            torque += level * tanh(dq[i] / disturbance.coulomb_velocity[i])
        if disturbance.ripple[i] != 0.0:
            torque += disturbance.ripple[i] * sin(disturbance.ripple_frequency * q[i])
        out[i] = torque
