# SPDX-License-Identifier: Apache-2.0
"""The planar two-link arm of Section IV, linear in its parameters, for the controller.

Point masses at the link ends, angles from the horizontal, q2 relative to q1:

    P = [(m1 + m2) l1^2, m2 l2^2, m2 l1 l2]   [kg m^2]
    r = g / l1                                [1/s^2]

The masses and l2 appear in P alone; the only geometry that the regressor needs is r.
Equation (34) prints cos q2 in the first gravity term, which must be cos q1
(doc/errata.md).

Its URDF is in the vertical x-z plane.  URDF joints turn counterclockwise about their
axis, and q1 counts from the horizontal upwards: from x to z, which is about -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.numerics.elementary import cos, sin

PARAMETER_NAMES = ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')

Angles = tuple[float, float, float, float]
"""cos q1, cos q2, sin q2, cos(q1 + q2)."""


class TwoLink(NamedTuple):
    """Two-link planar arm: an `ArmModel`."""

    r: float  # g / l1, 1/s^2

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
        return PARAMETER_NAMES

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of the entries of P."""
        return ('kg m^2',) * 3

    def sizes(self) -> tuple[int, int]:
        """Return n and p, constants in kernels: their loops over two joints are unrolled."""
        return 2, 3

    def regressor(self, q: Array, dq: Array, v: Array, a: Array, H: Array) -> None:
        """Fill H (2, 3) so that H P = M(q) a + C(q, dq) v + G(q)   [N m], Property III."""
        fill_regressor(self.r, angles_of(q), dq, v, a, H)

    def momentum_regressor(self, q: Array, dq: Array, Yp: Array, Yr: Array) -> None:
        """Fill Yp, Yr (2, 3) so that Yp P = M dq [N m s] and Yr P = G - C^T dq [N m]."""
        fill_momentum_regressor(self.r, angles_of(q), dq, Yp, Yr)

    def regressors(
        self, q: Array, dq: Array, v: Array, a: Array, H: Array, Yp: Array, Yr: Array
    ) -> None:
        """Compute both regressors from one evaluation of the sines and cosines, which cost most."""
        angles = angles_of(q)
        fill_regressor(self.r, angles, dq, v, a, H)
        fill_momentum_regressor(self.r, angles, dq, Yp, Yr)


@inner
def angles_of(q: Array) -> Angles:
    """Return the sines and cosines in the regressors."""
    return cos(q[0]), cos(q[1]), sin(q[1]), cos(q[0] + q[1])


@inner
def fill_regressor(
    r: float, angles: Angles, dq: Array, v: Array, a: Array, H: Array
) -> None:
    """Compute `regressor` from the angles' sines and cosines."""
    c1, c2, s2, c12 = angles
    H[0, 0] = a[0] + r * c1
    H[0, 1] = a[0] + a[1]
    H[0, 2] = (
        c2 * (2.0 * a[0] + a[1])
        - s2 * (dq[1] * v[0] + (dq[0] + dq[1]) * v[1])
        + r * c12
    )
    H[1, 0] = 0.0
    H[1, 1] = a[0] + a[1]
    H[1, 2] = c2 * a[0] + s2 * dq[0] * v[0] + r * c12


@inner
def fill_momentum_regressor(
    r: float, angles: Angles, dq: Array, Yp: Array, Yr: Array
) -> None:
    """Compute `momentum_regressor` from the angles' sines and cosines."""
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


def urdf(
    joints: Sequence[str], lengths: Sequence[float], masses: Sequence[float]
) -> str:
    """Return the URDF of the arm, whose tip is the link `tip`.

    `lengths` and `masses` are those of the links [m] and at their ends [kg].  Point
    masses have a tiny inertia: most parsers reject zero.
    """
    links = [f'link{k}' for k, _ in enumerate(joints, 1)]
    parents = ['base_link', *links]
    origins = [0.0, *lengths]
    moved = [
        _moved_link(*each)
        for each in zip(
            joints, parents[:-1], links, origins[:-1], lengths, masses, strict=True
        )
    ]
    return f"""\
<robot name="two_link">
  <link name="base_link" />
{''.join(moved)}\
  <joint name="tip_joint" type="fixed">
    <parent link="{parents[-1]}" />
    <child link="tip" />
    <origin xyz="{origins[-1]:.17g} 0 0" />
  </joint>
  <link name="tip" />
</robot>
"""


def _moved_link(
    joint: str, parent: str, link: str, origin: float, length: float, mass: float
) -> str:
    """Return a joint, at `origin` [m] along its parent, and the link that it moves."""
    from xml.sax.saxutils import quoteattr  # slow: it imports what reads from networks

    return f"""\
  <joint name={quoteattr(joint)} type="continuous">
    <parent link="{parent}" />
    <child link="{link}" />
    <origin xyz="{origin:.17g} 0 0" />
    <axis xyz="0 -1 0" />
  </joint>
  <link name="{link}">
    <inertial>
      <origin xyz="{length:.17g} 0 0" />
      <mass value="{mass:.17g}" />
      <inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0" />
    </inertial>
    <visual>
      <origin xyz="{length / 2:g} 0 0" rpy="0 1.5707963267948966 0" />
      <geometry><cylinder radius="0.02" length="{length:g}" /></geometry>
      <material name="blue"><color rgba="0.2 0.4 0.8 1" /></material>
    </visual>
  </link>
"""
