# SPDX-License-Identifier: Apache-2.0
"""The planar two-link arm of Section IV, linear in its parameters, for the controller.

Point masses at the link ends, angles from the horizontal, q2 relative to q1:

    P = [(m1 + m2) l1^2, m2 l2^2, m2 l1 l2]   [kg m^2]
    constants = [r],  r = g / l1              [1/s^2]

The masses and l2 appear in P alone; of the arm's geometry the regressor needs only r.  Equation
(34) prints cos q2 in the first gravity term; it is cos q1 (see `potential`).
"""

from math import cos, sin

import numpy as np

from blf_dsc_controller.compiled.jit import inner

JOINTS = 2
PARAMETER_NAMES = ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')


Angles = tuple[float, float, float, float]
"""cos q1, cos q2, sin q2, cos(q1 + q2)."""


@inner
def angles_of(q: np.ndarray) -> Angles:
    """Sines and cosines that the regressors are made of."""
    return cos(q[0]), cos(q[1]), sin(q[1]), cos(q[0] + q[1])


@inner
def regressor(
    constants: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    H: np.ndarray,
) -> None:
    """Fill H (2 x 3) so that H P = M(q) a + C(q, dq) v + G(q)   [N m], Property III."""
    fill_regressor(constants[0], angles_of(q), dq, v, a, H)


@inner
def fill_regressor(
    r: float, angles: Angles, dq: np.ndarray, v: np.ndarray, a: np.ndarray, H: np.ndarray
) -> None:
    """`regressor` from the angles' sines and cosines."""
    c1, c2, s2, c12 = angles
    H[0, 0] = a[0] + r * c1
    H[0, 1] = a[0] + a[1]
    H[0, 2] = c2 * (2.0 * a[0] + a[1]) - s2 * (dq[1] * v[0] + (dq[0] + dq[1]) * v[1]) + r * c12
    H[1, 0] = 0.0
    H[1, 1] = a[0] + a[1]
    H[1, 2] = c2 * a[0] + s2 * dq[0] * v[0] + r * c12


@inner
def momentum_regressor(
    constants: np.ndarray, q: np.ndarray, dq: np.ndarray, Yp: np.ndarray, Yr: np.ndarray
) -> None:
    """Fill Yp, Yr (2 x 3) so that Yp P = M dq [kg m^2/s] and Yr P = G - C^T dq [N m].

    Then d/dt(Yp P) + Yr P = tau - tau_dist: the dynamics without the acceleration.
    """
    fill_momentum_regressor(constants[0], angles_of(q), dq, Yp, Yr)


@inner
def fill_momentum_regressor(
    r: float, angles: Angles, dq: np.ndarray, Yp: np.ndarray, Yr: np.ndarray
) -> None:
    """`momentum_regressor` from the angles' sines and cosines."""
    c1, c2, s2, c12 = angles
    Yp[0, 0] = dq[0]
    Yp[0, 1] = dq[0] + dq[1]
    Yp[0, 2] = c2 * (2.0 * dq[0] + dq[1])
    Yp[1, 0] = 0.0
    Yp[1, 1] = dq[0] + dq[1]
    Yp[1, 2] = c2 * dq[0]
    Yr[0, 0] = r * c1
    Yr[0, 1] = 0.0
    Yr[0, 2] = r * c12
    Yr[1, 0] = 0.0
    Yr[1, 1] = 0.0
    Yr[1, 2] = s2 * dq[0] * (dq[0] + dq[1]) + r * c12


@inner
def regressors(
    constants: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    H: np.ndarray,
    Yp: np.ndarray,
    Yr: np.ndarray,
) -> None:
    """Both regressors from one computation of the sines and cosines, which cost most of them."""
    angles = angles_of(q)
    fill_regressor(constants[0], angles, dq, v, a, H)
    fill_momentum_regressor(constants[0], angles, dq, Yp, Yr)


@inner
def inertia(P: np.ndarray, q: np.ndarray, M: np.ndarray) -> None:
    """Fill the inertia matrix M (2 x 2) [kg m^2]."""
    coupling = P[2] * cos(q[1])
    M[0, 0] = P[0] + P[1] + 2.0 * coupling
    M[0, 1] = P[1] + coupling
    M[1, 0] = M[0, 1]
    M[1, 1] = P[1]


@inner
def coriolis(P: np.ndarray, q: np.ndarray, dq: np.ndarray, C: np.ndarray) -> None:
    """Fill C (2 x 2) [N m s/rad] in Christoffel form, so that dM/dt - 2 C is skew (Property I)."""
    c = P[2] * sin(q[1])
    C[0, 0] = -c * dq[1]
    C[0, 1] = -c * (dq[0] + dq[1])
    C[1, 0] = c * dq[0]
    C[1, 1] = 0.0


@inner
def gravity(constants: np.ndarray, P: np.ndarray, q: np.ndarray, G: np.ndarray) -> None:
    """Fill the gravity torque G (2,) [N m], the gradient of `potential`."""
    r = constants[0]
    G[1] = P[2] * r * cos(q[0] + q[1])
    G[0] = P[0] * r * cos(q[0]) + G[1]


@inner
def potential(constants: np.ndarray, P: np.ndarray, q: np.ndarray) -> float:
    """Potential energy [J], zero with both links horizontal."""
    r = constants[0]
    return float(P[0] * r * sin(q[0]) + P[2] * r * sin(q[0] + q[1]))
