# SPDX-License-Identifier: Apache-2.0
"""One fixed step of the equation of motion, with the torque held and the disturbance varying.

Two explicit Runge-Kutta methods: the classic one of order 4, and the fifth-order solution of
Dormand and Prince (1980), which MATLAB calls ode5.  Stage i is evaluated at t + c_i h and
x + h sum_j a_ij k_j; the step ends at x + h sum_i b_i k_i.
"""

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from sim_plant.motion import Motion, state_derivative

RK4 = 0
DOPRI5 = 1
INTEGRATORS = {'rk4': RK4, 'dopri5': DOPRI5}

_RK4_C = np.array([0, 1 / 2, 1 / 2, 1])
_RK4_A = np.array([[0, 0, 0, 0], [1 / 2, 0, 0, 0], [0, 1 / 2, 0, 0], [0, 0, 1, 0]])
_RK4_B = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])

_DOPRI5_C = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1])
_DOPRI5_A = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
    ]
)
_DOPRI5_B = np.array([35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84])


class Stages(NamedTuple):
    """Working memory of a step."""

    point: Annotated[Array, '2 * n + 6']
    k: Annotated[Array, '6', '2 * n + 6']


@inner
def _explicit_step(
    a: np.ndarray,
    b: np.ndarray,
    c: np.ndarray,
    motion: Motion,
    t: float,
    h: float,
    torque: np.ndarray,
    x: np.ndarray,
    stages: Stages,
) -> None:
    point, k = stages.point, stages.k
    for stage in range(b.size):
        for i in range(x.size):
            slope = 0.0
            for j in range(stage):
                slope += a[stage, j] * k[j, i]
            point[i] = x[i] + h * slope
        state_derivative(motion, t + c[stage] * h, point, torque, k[stage])
    for i in range(x.size):
        slope = 0.0
        for j in range(b.size):
            slope += b[j] * k[j, i]
        x[i] += h * slope


@inner
def integrate(
    method: int,
    motion: Motion,
    t: float,
    h: float,
    torque: np.ndarray,
    x: np.ndarray,
    stages: Stages,
) -> None:
    """Advance x in place from t to t + h [s] under a held torque (n,) [N m].

    `x` is [q, dq] (2n,), or [q, dq, y, v] (2n + 6,) while a load sloshes.
    """
    if method == RK4:
        _explicit_step(_RK4_A, _RK4_B, _RK4_C, motion, t, h, torque, x, stages)
    else:
        _explicit_step(_DOPRI5_A, _DOPRI5_B, _DOPRI5_C, motion, t, h, torque, x, stages)
