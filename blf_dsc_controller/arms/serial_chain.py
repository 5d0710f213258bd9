# SPDX-License-Identifier: Apache-2.0
"""Model of a serial chain of rigid bodies, linear in its inertial parameters: an `ArmModel`.

Spatial vectors are (angular, linear) at the origin of a body's frame.  S_j is the axis
of joint j, v_i = sum_j S_j dq_j and w_i = sum_j S_j v_j over the joints j <= i that
carry body i, and alpha_i = sum_j (S_j a_j + S_j' v_j) - gravity with S_j' = v_j x S_j.
Over the bodies i >= j,

    (M a + C v + G)_j = sum_i S_j . (I_i alpha_i + B(I_i, v_i) w_i)
    B(I, v) w = (v x* I w + w x* I v - I (v x w)) / 2,    for which M' - 2 C is skew
    (M dq)_j = sum_i S_j . I_i v_i
    (G - C^T dq)_j = -sum_i (S_j' . I_i v_i + S_j . weight_i)

(Echeandia and Wensing, Numerical methods to compute the Coriolis matrix and Christoffel
symbols for rigid-body systems, 2021.)  All of it is linear in the ten parameters
(`urdf.INERTIA_NAMES`) of each body in its joint's frame.  A rotor inertia J, reflected
to its joint, adds J a_j and J dq_j.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.arms.inertia import INERTIA_NAMES, INERTIA_UNITS
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.compiled.jit import called, inner
from blf_dsc_controller.compiled.layout import Array, pack, view_of
from blf_dsc_controller.numerics.algebra import Vector, cross, dot, plus, product
from blf_dsc_controller.numerics.elementary import cos, sin

ROTOR = len(INERTIA_NAMES)
"""Entry of the rotor inertia, after the ten inertial parameters of a body."""

# Rows of `Bodies.motions`; after them, S and S' of each joint.
VELOCITY, REFERENCE, ACCELERATION, GRAVITY, AXES = range(5)


class Bodies(NamedTuple):
    """A chain and the columns of its regressors.

    Motions and products are working memory.
    """

    n: int
    p: int
    gravity: Annotated[Array, 3]  # m/s^2, in the base
    rotation: Annotated[Array, 'n', 3, 3, 3]  # R0, R1, R2 of R0 + cos q R1 + sin q R2
    offset: Annotated[Array, 'n', 3]  # of a body's origin in the previous body, m
    slide: Annotated[Array, 'n', 3]  # change of the offset per q, for prismatic joints
    axis: Annotated[Array, 'n', 6]  # S in the joint's own frame
    first: Annotated[Array, 'n + 1']  # first column of each body, then p
    entry: Annotated[Array, 'p']  # of each column: index among its body's ten, or ROTOR
    motions: Annotated[Array, '4 + 2 * n', 6]  # in the frame of the current body
    # of an axis with each entry's contribution
    products: Annotated[Array, 3, ROTOR + 1]


bodies_of = view_of(Bodies)


@called
def fill_regressor(
    vector: Array, q: Array, dq: Array, v: Array, a: Array, H: Array
) -> None:
    """Fill H (n, p) of a packed chain: see `SerialChain.regressor`."""
    bodies = bodies_of(vector)
    begin(bodies)
    for i in range(bodies.n):
        advance(bodies, i, q[i], dq[i], v[i], a[i])
        add_torque(bodies, i, a[i], H)


@called
def fill_momentum_regressor(
    vector: Array, q: Array, dq: Array, Yp: Array, Yr: Array
) -> None:
    """Fill Yp and Yr (n, p) of a packed chain: see `SerialChain.momentum_regressor`."""
    bodies = bodies_of(vector)
    begin(bodies)
    for i in range(bodies.n):
        advance(bodies, i, q[i], dq[i], 0.0, 0.0)
        add_momentum(bodies, i, dq[i], Yp, Yr)


@called
def fill_regressors(
    vector: Array,
    q: Array,
    dq: Array,
    v: Array,
    a: Array,
    H: Array,
    Yp: Array,
    Yr: Array,
) -> None:
    """Fill H, Yp and Yr (n, p) of a packed chain: see `SerialChain.regressors`."""
    bodies = bodies_of(vector)
    begin(bodies)
    for i in range(bodies.n):
        advance(bodies, i, q[i], dq[i], v[i], a[i])
        add_torque(bodies, i, a[i], H)
        add_momentum(bodies, i, dq[i], Yp, Yr)


@inner
def angular(motion: Array) -> Vector:
    """Return the angular part of a motion (6,)."""
    return motion[0], motion[1], motion[2]


@inner
def linear(motion: Array) -> Vector:
    """Return the linear part of a motion (6,)."""
    return motion[3], motion[4], motion[5]


@inner
def begin(bodies: Bodies) -> None:
    """Set the motions of the base: at rest, under gravity."""
    for k in range(3):
        for row in range(AXES):
            bodies.motions[row, k] = 0.0
            bodies.motions[row, 3 + k] = 0.0
        bodies.motions[ACCELERATION, 3 + k] = -bodies.gravity[k]
        bodies.motions[GRAVITY, 3 + k] = bodies.gravity[k]


@inner
def advance(bodies: Bodies, i: int, q: float, dq: float, v: float, a: float) -> None:
    """Transform all motions from the frame of body i - 1 to that of i, and add those of joint i.

    q, dq, v, a are those of the joint [rad, rad/s, rad/s, rad/s^2].
    """
    motions = bodies.motions
    rotation = bodies.rotation[i]
    c, s = cos(q), sin(q)
    column0 = rotation_column(rotation, c, s, 0)
    column1 = rotation_column(rotation, c, s, 1)
    column2 = rotation_column(rotation, c, s, 2)
    offset, slide = bodies.offset[i], bodies.slide[i]
    origin = (
        offset[0] + q * slide[0],
        offset[1] + q * slide[1],
        offset[2] + q * slide[2],
    )
    row_of_joint = AXES + 2 * i
    for row in range(row_of_joint):
        motion = motions[row]
        w, u = angular(motion), linear(motion)
        u = plus(u, cross(w, origin))
        motion[0] = dot(column0, w)
        motion[3] = dot(column0, u)
        motion[1] = dot(column1, w)
        motion[4] = dot(column1, u)
        motion[2] = dot(column2, w)
        motion[5] = dot(column2, u)
    axis, rate = motions[row_of_joint], motions[row_of_joint + 1]
    S = bodies.axis[i]
    w = angular(motions[VELOCITY])
    u = linear(motions[VELOCITY])
    turning = cross(w, angular(S))
    moving = cross(w, linear(S))
    swept = cross(u, angular(S))
    for k in range(3):
        rate[k] = turning[k]
        rate[3 + k] = moving[k] + swept[k]
    for k in range(6):
        axis[k] = S[k]
        motions[VELOCITY, k] += S[k] * dq
        motions[REFERENCE, k] += S[k] * v
        motions[ACCELERATION, k] += S[k] * a + rate[k] * v


@inner
def rotation_column(rotation: Array, c: float, s: float, k: int) -> Vector:
    """Return column k of R0 + c R1 + s R2 (3, 3, 3)."""
    return (
        rotation[0, 0, k] + c * rotation[1, 0, k] + s * rotation[2, 0, k],
        rotation[0, 1, k] + c * rotation[1, 1, k] + s * rotation[2, 1, k],
        rotation[0, 2, k] + c * rotation[1, 2, k] + s * rotation[2, 2, k],
    )


@inner
def add_torque(bodies: Bodies, i: int, a: float, H: Array) -> None:
    """Fill the columns of body i in M a + C v + G, in rows 0 to i of H (n, p).

    `a` [rad/s^2] is that of joint i, which turns its rotor.
    """
    motions = bodies.motions
    products = bodies.products[0]
    w = angular(motions[VELOCITY])
    u = linear(motions[VELOCITY])
    reference = angular(motions[REFERENCE])
    alpha = angular(motions[ACCELERATION])
    A = linear(motions[ACCELERATION])
    A = plus(A, cross(reference, u))
    for j in range(i + 1):
        torque_products(motions[AXES + 2 * j], alpha, A, w, reference, products)
        products[ROTOR] = a if j == i else 0.0
        fill_columns(bodies, i, j, products, H)


@inner
def add_momentum(bodies: Bodies, i: int, dq: float, Yp: Array, Yr: Array) -> None:
    """Fill the columns of body i in M dq and in G - C^T dq, in rows 0 to i of Yp and Yr (n, p)."""
    motions = bodies.motions
    momenta = bodies.products[1]
    forces = bodies.products[2]
    w = angular(motions[VELOCITY])
    u = linear(motions[VELOCITY])
    g = linear(motions[GRAVITY])
    for j in range(i + 1):
        S = motions[AXES + 2 * j]
        dS = motions[AXES + 2 * j + 1]
        momentum_products(S, w, u, momenta)
        momenta[ROTOR] = dq if j == i else 0.0
        fill_columns(bodies, i, j, momenta, Yp)
        momentum_products(dS, w, u, forces)
        lever = cross(g, angular(S))
        forces[0] += dot(linear(S), g)
        forces[1] += lever[0]
        forces[2] += lever[1]
        forces[3] += lever[2]
        for entry in range(ROTOR):
            forces[entry] = -forces[entry]
        forces[ROTOR] = 0.0
        fill_columns(bodies, i, j, forces, Yr)


@inner
def fill_columns(bodies: Bodies, i: int, j: int, products: Array, Y: Array) -> None:
    """Copy the products that are columns of body i to row j of Y; zero the rows below i."""
    for k in range(int(bodies.first[i]), int(bodies.first[i + 1])):
        Y[j, k] = products[int(bodies.entry[k])]
        if j == i:
            for below in range(i + 1, bodies.n):
                Y[below, k] = 0.0


@inner
def torque_products(
    S: Array, alpha: Vector, A: Vector, v: Vector, w: Vector, out: Array
) -> None:
    """Fill S . (I alpha + B(I, v) w) for a unit of each of the ten.

    H = m c are the moments.

        force = m A + alpha x h + w x (v x h)
        moment = h x A + I (alpha - v x w / 2) + (v x I w + w x I v) / 2

    Here alpha, v and w are the angular parts; A is alpha's linear part + w x (v's
    linear part).
    """
    s, t = angular(S), linear(S)
    turn = cross(t, alpha)
    lever = cross(A, s)
    along = dot(t, v)
    speed = dot(v, w)
    out[0] = dot(t, A)
    out[1] = turn[0] + lever[0] + along * w[0] - speed * t[0]
    out[2] = turn[1] + lever[1] + along * w[1] - speed * t[1]
    out[3] = turn[2] + lever[2] + along * w[2] - speed * t[2]
    xx = v[0] * w[0]
    yy = v[1] * w[1]
    zz = v[2] * w[2]
    xy = 0.5 * (v[0] * w[1] + v[1] * w[0])
    xz = 0.5 * (v[0] * w[2] + v[2] * w[0])
    yz = 0.5 * (v[1] * w[2] + v[2] * w[1])
    half = cross(v, w)
    x = alpha[0] - 0.5 * half[0]
    y = alpha[1] - 0.5 * half[1]
    z = alpha[2] - 0.5 * half[2]
    out[4] = s[0] * x + s[1] * xz - s[2] * xy
    out[5] = s[0] * (y - xz) + s[1] * (x + yz) + s[2] * (xx - yy)
    out[6] = s[1] * y + s[2] * xy - s[0] * yz
    out[7] = s[0] * (z + xy) + s[1] * (zz - xx) + s[2] * (x - yz)
    out[8] = s[0] * (yy - zz) + s[1] * (z - xy) + s[2] * (y + xz)
    out[9] = s[2] * z + s[0] * yz - s[1] * xz


@inner
def momentum_products(S: Array, w: Vector, u: Vector, out: Array) -> None:
    """Fill S . I v for a unit of each of the ten.

    W and u are v's angular and linear parts.
    """
    s, t = angular(S), linear(S)
    turn, lever = cross(t, w), cross(u, s)
    out[0] = dot(t, u)
    out[1] = turn[0] + lever[0]
    out[2] = turn[1] + lever[1]
    out[3] = turn[2] + lever[2]
    out[4] = s[0] * w[0]
    out[5] = s[0] * w[1] + s[1] * w[0]
    out[6] = s[1] * w[1]
    out[7] = s[0] * w[2] + s[2] * w[0]
    out[8] = s[1] * w[2] + s[2] * w[1]
    out[9] = s[2] * w[2]


class SerialChain(NamedTuple):
    """Arm of any serial chain: an `ArmModel`.

    It contains its working memory, so each thread needs its own.
    """

    n: int
    p: int
    vector: Array  # Bodies

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of P, joints numbered from 1: m7, m*cx7, Ixx7, rotor7."""
        names = (*INERTIA_NAMES, 'rotor')
        return tuple(f'{names[entry]}{body + 1}' for body, entry in self._columns())

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of the entries of P; the rotor of a prismatic joint is in kg."""
        axis = bodies_of(self.vector).axis
        return tuple(
            (*INERTIA_UNITS, 'kg m^2' if axis[body, :3].any() else 'kg')[entry]
            for body, entry in self._columns()
        )

    def _columns(self) -> list[tuple[int, int]]:
        bodies = bodies_of(self.vector)
        body = np.repeat(np.arange(self.n), np.diff(bodies.first).astype(int))
        return [(int(b), int(e)) for b, e in zip(body, bodies.entry, strict=True)]

    def sizes(self) -> tuple[int, int]:
        """Return n and p."""
        return self.n, self.p

    def regressor(self, q: Array, dq: Array, v: Array, a: Array, H: Array) -> None:
        """Fill H (n, p) so that H P = M(q) a + C(q, dq) v + G(q)   [N m], Property III."""
        fill_regressor(self.vector, q, dq, v, a, H)

    def momentum_regressor(self, q: Array, dq: Array, Yp: Array, Yr: Array) -> None:
        """Fill Yp, Yr (n, p) so that Yp P = M dq [N m s] and Yr P = G - C^T dq [N m]."""
        fill_momentum_regressor(self.vector, q, dq, Yp, Yr)

    def regressors(
        self, q: Array, dq: Array, v: Array, a: Array, H: Array, Yp: Array, Yr: Array
    ) -> None:
        """Compute `regressor` and `momentum_regressor` in one pass along the chain."""
        fill_regressors(self.vector, q, dq, v, a, H, Yp, Yr)


def serial_chain(
    chain: Chain,
    gravity: tuple[float, ...],
    columns: list[tuple[int, int]] | None = None,
) -> SerialChain:
    """Return the model of a chain; `gravity` [m/s^2] is given in its base.

    `columns` are the parameters as (body, entry), both counted from 0, in ascending
    order of the bodies; ROTOR is the entry after the ten. None selects all n * 11.
    """
    n = len(chain.joints)
    if columns is None:
        columns = [(i, entry) for i in range(n) for entry in range(ROTOR + 1)]
    rotation = np.zeros((n, 3, 3, 3))
    offset = np.zeros((n, 3))
    slide = np.zeros((n, 3))
    axis = np.zeros((n, 6))
    for i, joint in enumerate(chain.joints):
        R = joint.placement[:3, :3]
        offset[i] = joint.placement[:3, 3]
        if joint.kind == 'prismatic':
            rotation[i, 0] = R
            slide[i] = (R * joint.axis).sum(axis=1)
            axis[i, 3:] = joint.axis
        else:
            along = np.outer(joint.axis, joint.axis)
            turns = along, np.eye(3) - along, np.cross(np.eye(3), joint.axis)
            rotation[i] = product(R, np.array(turns))
            axis[i, :3] = joint.axis
    body, entry = np.transpose(columns)
    bodies = Bodies(
        n=n,
        p=len(columns),
        gravity=np.array(gravity),
        rotation=rotation,
        offset=offset,
        slide=slide,
        axis=axis,
        first=np.searchsorted(body, np.arange(n + 1)),
        entry=entry,
        motions=np.zeros((AXES + 2 * n, 6)),
        products=np.zeros((3, ROTOR + 1)),
    )
    return SerialChain(n, len(columns), pack(bodies))
