# SPDX-License-Identifier: Apache-2.0
"""The interface between the laws and an arm: two regressors, and the names of what they multiply.

A law knows a model only by `Model` and the two dispatching kernels below.  To add an arm, write its
two kernels in a file of their own, give it a code, and extend both dispatchers: numba cannot cache
across processes a kernel that takes functions as arguments, so the choice is made by code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.arms import planar_chain, two_link
from blf_dsc_controller.compiled.jit import inner

TWO_LINK = 0
PLANAR_CHAIN = 1


@dataclass(frozen=True)
class Model:
    """An arm whose dynamics are linear in `p` parameters.

    Attributes:
        code: which branch of the dispatching kernels serves it.
        n: number of joints.
        parameter_names: names of the p entries of P, in order.
        constants: what the regressors know of the arm's geometry (meaning up to the model).
    """

    code: int
    n: int
    parameter_names: tuple[str, ...]
    constants: tuple[float, ...]

    @property
    def p(self) -> int:
        """Number of parameters."""
        return len(self.parameter_names)


def two_link_arm(l1: float, gravity: float) -> Model:
    """Two-link planar arm with known l1 [m] and gravity [m/s^2]; masses and l2 unknown."""
    return Model(TWO_LINK, two_link.JOINTS, two_link.PARAMETER_NAMES, (gravity / l1,))


def planar_arm(n: int, l1: float, gravity: float) -> Model:
    """Planar arm of n links with known l1 [m] and gravity [m/s^2]; all else unknown."""
    return Model(PLANAR_CHAIN, n, planar_chain.parameter_names(n), (gravity / l1,))


@inner
def regressor(
    code: int,
    constants: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    H: np.ndarray,
) -> None:
    """Fill H (n x p): H P = M(q) a + C(q, dq) v + G(q)   [N m], Property III."""
    if code == TWO_LINK:
        two_link.regressor(constants, q, dq, v, a, H)
    else:
        planar_chain.regressor(constants, q, dq, v, a, H)


@inner
def momentum_regressor(
    code: int,
    constants: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    Yp: np.ndarray,
    Yr: np.ndarray,
) -> None:
    """Fill Yp, Yr (n x p): Yp P = M dq  and  Yr P = G - C^T dq."""
    if code == TWO_LINK:
        two_link.momentum_regressor(constants, q, dq, Yp, Yr)
    else:
        planar_chain.momentum_regressor(constants, q, dq, Yp, Yr)


@inner
def regressors(
    code: int,
    constants: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    H: np.ndarray,
    Yp: np.ndarray,
    Yr: np.ndarray,
) -> None:
    """`regressor` and `momentum_regressor` of one state."""
    if code == TWO_LINK:
        two_link.regressors(constants, q, dq, v, a, H, Yp, Yr)
    else:
        planar_chain.regressor(constants, q, dq, v, a, H)
        planar_chain.momentum_regressor(constants, q, dq, Yp, Yr)
