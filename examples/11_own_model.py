# SPDX-License-Identifier: Apache-2.0
"""A model of an arm that no URDF describes: a polar arm in a vertical plane.

python examples/11_own_model.py

A link turns by q1 [rad] from the horizontal, and a mass slides along it, q2 [m] from
the axis.  The two checks below catch nearly every mistake.  doc/tutorial_law.md says
how to register a model.
"""

from math import cos, sin
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.compiled.layout import Array


class Polar(NamedTuple):
    """Regressors of P = [J, S, m]: inertia and first moment of the link, sliding mass."""

    gravity: float  # m/s^2

    @property
    def n(self) -> int:
        """Number of joints."""
        return 2

    @property
    def p(self) -> int:
        """Number of parameters."""
        return 3

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of P."""
        return ('J', 'S', 'm')

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of the entries of P."""
        return ('kg m^2', 'kg m', 'kg')

    def sizes(self) -> tuple[int, int]:
        """Return n and p, as constants of the compiled law."""
        return 2, 3

    def regressor(self, q: Array, dq: Array, v: Array, a: Array, H: Array) -> None:
        """Fill H (2, 3) so that H P = M(q) a + C(q, dq) v + G(q)."""
        g = self.gravity
        H[0, 0] = a[0]
        H[0, 1] = g * cos(q[0])
        H[0, 2] = (
            q[1] ** 2 * a[0]
            + q[1] * (dq[1] * v[0] + dq[0] * v[1])
            + g * q[1] * cos(q[0])
        )
        H[1, 0] = 0.0
        H[1, 1] = 0.0
        H[1, 2] = a[1] - q[1] * dq[0] * v[0] + g * sin(q[0])

    def momentum_regressor(self, q: Array, dq: Array, Yp: Array, Yr: Array) -> None:
        """Fill Yp, Yr (2, 3) so that Yp P = M dq and Yr P = G - C^T dq."""
        g = self.gravity
        Yp[0, 0] = dq[0]
        Yp[0, 1] = 0.0
        Yp[0, 2] = q[1] ** 2 * dq[0]
        Yp[1, 0] = 0.0
        Yp[1, 1] = 0.0
        Yp[1, 2] = dq[1]
        Yr[0, 0] = 0.0
        Yr[0, 1] = g * cos(q[0])
        Yr[0, 2] = g * q[1] * cos(q[0])
        Yr[1, 0] = 0.0
        Yr[1, 1] = 0.0
        Yr[1, 2] = g * sin(q[0]) - q[1] * dq[0] ** 2

    def regressors(
        self, q: Array, dq: Array, v: Array, a: Array, H: Array, Yp: Array, Yr: Array
    ) -> None:
        """Both of one state."""
        self.regressor(q, dq, v, a, H)
        self.momentum_regressor(q, dq, Yp, Yr)


MODEL, P = Polar(9.81), np.array([0.4, 0.2, 1.0])
STEP = 1e-6  # s, of the difference quotients


def filled(q, dq, v, a):
    """H, Yp and Yr."""
    H, Yp, Yr = np.empty((3, 2, 3))
    MODEL.regressors(q, dq, v, a, H, Yp, Yr)
    return H, Yp, Yr


def main():
    """Check both identities at a hundred states."""
    random, zero = np.random.default_rng(1), np.zeros(2)
    for _ in range(100):
        q, dq, ddq = random.uniform(-1.0, 1.0, (3, 2))
        H, _, Yr = filled(q, dq, dq, ddq)
        ahead = filled(q + STEP * dq, dq + STEP * ddq, dq, ddq)[1] @ P
        behind = filled(q - STEP * dq, dq - STEP * ddq, dq, ddq)[1] @ P
        # d/dt(Yp P) + Yr P is the torque of the regressor.
        rate = (ahead - behind) / (2 * STEP)
        np.testing.assert_allclose(rate + Yr @ P, H @ P, atol=1e-8)

        G = filled(q, zero, zero, zero)[0] @ P
        C_dq = filled(q, dq, dq, zero)[0] @ P - G
        ahead = filled(q + STEP * dq, dq, dq, dq)[1] @ P
        behind = filled(q - STEP * dq, dq, dq, dq)[1] @ P
        # dq^T (dM/dt - 2 C) dq = 0: the skewness.
        dM_dq = (ahead - behind) / (2 * STEP)
        np.testing.assert_allclose(dq @ dM_dq, 2.0 * dq @ C_dq, atol=1e-8)
    print('both identities hold')


if __name__ == '__main__':
    main()
