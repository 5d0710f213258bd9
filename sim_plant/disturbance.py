# SPDX-License-Identifier: Apache-2.0
"""Joint torques the controller is not told of: constant, sinusoid, viscous and Coulomb friction.

tau_dist stands on the arm's side, M ddq + C dq + G + tau_dist = tau (33), so friction has the sign
of the velocity. Coulomb friction is smoothed by tanh, so that a fixed step keeps its order.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.compiled.jit import inner

DISTURBANCE_TERMS = 7


class JointDisturbance(NamedTuple):
    """The disturbance of one joint."""

    constant: float  # N m
    amplitude: float  # N m
    frequency: float  # rad/s
    phase: float  # rad
    viscous: float  # N m s/rad
    coulomb: float  # N m
    coulomb_velocity: float  # rad/s, at which Coulomb friction has reached three quarters


def disturbance_vector(
    *,
    constant: ArrayLike,
    amplitude: ArrayLike,
    frequency: ArrayLike,
    phase: ArrayLike,
    viscous: ArrayLike,
    coulomb: ArrayLike,
    coulomb_velocity: ArrayLike,
) -> NDArray[np.float64]:
    """Return the (7n,) vector of n joints; each term is (n,), or one number for all joints."""
    terms = (constant, amplitude, frequency, phase, viscous, coulomb, coulomb_velocity)
    columns = np.broadcast_arrays(*(np.asarray(term, dtype=np.float64) for term in terms))
    return np.stack(columns, axis=-1).ravel()


@inner
def joint_disturbance(flat: NDArray[np.float64], i: int) -> JointDisturbance:
    """Read joint i of a disturbance vector."""
    k = i * DISTURBANCE_TERMS
    return JointDisturbance(
        flat[k], flat[k + 1], flat[k + 2], flat[k + 3], flat[k + 4], flat[k + 5], flat[k + 6]
    )


@inner
def joint_torque(joint: JointDisturbance, t: float, dq: float) -> float:
    """Return tau_dist of one joint, N m, t seconds after the start."""
    torque = joint.constant + joint.amplitude * math.sin(joint.frequency * t + joint.phase)
    torque += joint.viscous * dq
    if joint.coulomb != 0.0:
        torque += joint.coulomb * math.tanh(dq / joint.coulomb_velocity)
    return torque


@inner
def disturbance_torque(
    flat: NDArray[np.float64], t: float, dq: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Write tau_dist(t, dq), (n,), N m, of a disturbance vector."""
    for i in range(dq.size):
        out[i] = joint_torque(joint_disturbance(flat, i), t, dq[i])
