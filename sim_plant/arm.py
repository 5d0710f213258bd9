# SPDX-License-Identifier: Apache-2.0
"""Mechanics of the simulated arms: any serial chain of rigid bodies, and the arm of Section IV.

An arm is a `NamedTuple` of numbers and arrays with the methods of `Arm`.  Kernels call
them as plain Python does; each kernel is compiled for the type of arm that is passed to
it.  Both arms are derived independently of the controller's regressors, so that each
checks the other:

    (M(q) + rotors) ddq + C(q, dq) dq + G(q) = torque    (33), (34)

For a chain by the Newton-Euler equations in the base frame: the bias C dq + G is the
torque of the motion without acceleration; a column of M is the torque of a unit
acceleration of one joint, which moves all bodies beyond it as one (Featherstone, Rigid
Body Dynamics Algorithms, 2008, chapters 5 and 6).  For two links with point masses at
their ends, in a vertical plane, from the Lagrangian.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, Protocol

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.inertia import pseudo_inertia, rotational_inertia
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.compiled.jit import called, compile_methods, inner
from blf_dsc_controller.compiled.layout import Array, pack, size_of, view_of
from blf_dsc_controller.numerics.algebra import (
    Vector,
    cholesky_factor,
    cholesky_solve,
    cross,
    dot,
    plus,
    put,
    times,
    transform,
    vector,
)
from blf_dsc_controller.numerics.elementary import cos, sin


class RigidBodies(NamedTuple):
    """Geometry and inertias of a chain of n bodies, each in the frame of its joint."""

    n: int
    p: int
    gravity: Annotated[Array, 3]  # m/s^2, in the base
    # of a joint's frame at q = 0, to the previous body
    rotation: Annotated[Array, 'n', 3, 3]
    offset: Annotated[Array, 'n', 3]  # of its origin in the previous body, m
    axis: Annotated[Array, 'n', 3]
    prismatic: Annotated[Array, 'n']  # 1: prismatic, 0: revolute
    mass: Annotated[Array, 'n']  # kg
    moment: Annotated[Array, 'n', 3]  # kg m, mass times centre of mass
    inertia: Annotated[Array, 'n', 3, 3]  # kg m^2, about the frame's origin
    rotor: Annotated[Array, 'n']  # kg m^2, or kg, reflected to the joint
    tip: Annotated[Array, 3]  # m, in the last body
    # base parameters without payload; none in a model of the drives
    P: Annotated[Array, 'p']
    P_payload: Annotated[Array, 'p']  # contribution of 1 kg at the tip
    zeros: Annotated[Array, 'n']


class BodyMotion(NamedTuple):
    """Pose and motion of the bodies in the base frame.

    Entry 0 of each field is the base.
    """

    rotation: Annotated[Array, 'n + 1', 3, 3]
    origin: Annotated[Array, 'n + 1', 3]  # m
    axis: Annotated[Array, 'n + 1', 3]
    turning: Annotated[Array, 'n + 1', 3]  # angular velocity, rad/s
    # angular acceleration without ddq, rad/s^2
    turning_rate: Annotated[Array, 'n + 1', 3]
    # acceleration of the origin without ddq and gravity, m/s^2
    bias: Annotated[Array, 'n + 1', 3]
    # Working memory: sums over a body and all beyond it, about its origin.
    mass: Annotated[Array, 'n + 1']
    moment: Annotated[Array, 'n + 1', 3]
    inertia: Annotated[Array, 'n + 1', 3, 3]
    force: Annotated[Array, 'n + 1', 3]
    torque: Annotated[Array, 'n + 1', 3]
    M: Annotated[Array, 'n', 'n']
    factor: Annotated[Array, 'n', 'n']


bodies_of = view_of(RigidBodies)
motion_of = view_of(BodyMotion)
motion_size = size_of(BodyMotion)


def rigid_bodies(
    chain: Chain,
    gravity: tuple[float, ...],
    inertias: np.ndarray,
    rotors: np.ndarray,
    parameters: BaseParameters | None = None,
) -> RigidBodies:
    """Return bodies with the geometry of a chain, inertias (n, 10) and rotors (n,)."""
    P = parameters.of(inertias, rotors) if parameters else np.zeros(0)
    tensors = [pseudo_inertia(inertia) for inertia in inertias]
    return RigidBodies(
        n=len(chain.joints),
        p=P.size,
        gravity=np.array(gravity),
        rotation=np.array([joint.placement[:3, :3] for joint in chain.joints]),
        offset=np.array([joint.placement[:3, 3] for joint in chain.joints]),
        axis=np.array([joint.axis for joint in chain.joints]),
        prismatic=np.array(
            [float(joint.kind == 'prismatic') for joint in chain.joints]
        ),
        mass=inertias[:, 0].copy(),
        moment=inertias[:, 1:4].copy(),
        inertia=np.array([rotational_inertia(J) for J in tensors]),
        rotor=np.array(rotors),
        tip=chain.tip_placement[:3, 3].copy(),
        P=P,
        P_payload=parameters.load if parameters else P,
        zeros=np.zeros(len(chain.joints)),
    )


@inner
def locate(arm: RigidBodies, q: np.ndarray, dq: np.ndarray, now: BodyMotion) -> None:
    """Write pose and motion of the bodies at q (n,) and dq (n,)."""
    for r in range(3):
        for c in range(3):
            now.rotation[0, r, c] = 1.0 if r == c else 0.0
        now.origin[0, r] = now.turning[0, r] = 0.0
        now.turning_rate[0, r] = now.bias[0, r] = 0.0
    for i in range(arm.n):
        before, R = now.rotation[i], now.rotation[i + 1]
        for c in range(3):
            column = transform(before, vector(arm.rotation[i, :, c]))
            for r in range(3):
                R[r, c] = column[r]
        axis = transform(R, vector(arm.axis[i]))
        lever = transform(before, vector(arm.offset[i]))
        slides = arm.prismatic[i]
        turns = 1.0 - arm.prismatic[i]
        turn(R, axis, turns * q[i])
        lever = plus(lever, times(slides * q[i], axis))
        own = times(dq[i], axis)
        w = vector(now.turning[i])
        dw = vector(now.turning_rate[i])
        swept, speed = cross(w, own), cross(w, lever)
        put(axis, now.axis[i + 1])
        put(plus(vector(now.origin[i]), lever), now.origin[i + 1])
        put(plus(w, times(turns, own)), now.turning[i + 1])
        put(plus(dw, times(turns, swept)), now.turning_rate[i + 1])
        bias = plus(vector(now.bias[i]), plus(cross(dw, lever), cross(w, speed)))
        put(plus(bias, times(2.0 * slides, swept)), now.bias[i + 1])


@inner
def turn(R: np.ndarray, axis: Vector, angle: float) -> None:
    """Rotate the columns of R (3, 3) about a unit vector by an angle [rad]."""
    c, s = cos(angle), sin(angle)
    for k in range(3):
        column = vector(R[:, k])
        turned = plus(times(c, column), times(s, cross(axis, column)))
        turned = plus(turned, times((1.0 - c) * dot(axis, column), axis))
        for r in range(3):
            R[r, k] = turned[r]


@inner
def combine_bodies(arm: RigidBodies, now: BodyMotion, payload: float) -> None:
    """Sum inertias, and forces and moments of the bias, from the tip to the base."""
    n = arm.n
    F = N = (0.0, 0.0, 0.0)
    for i in range(n, 0, -1):
        R = now.rotation[i]
        m = arm.mass[i - 1]
        h = transform(R, vector(arm.moment[i - 1]))
        I = now.inertia[i]
        rotate(R, arm.inertia[i - 1], I)
        if i == n:
            lever = transform(R, vector(arm.tip))
            h = plus(h, times(payload, lever))
            m += payload
            add_point(payload, lever, I)
        w = vector(now.turning[i])
        dw = vector(now.turning_rate[i])
        a = plus(vector(now.bias[i]), times(-1.0, vector(arm.gravity)))
        F = plus(F, plus(times(m, a), plus(cross(dw, h), cross(w, cross(w, h)))))
        N = plus(
            N, plus(cross(h, a), plus(transform(I, dw), cross(w, transform(I, w))))
        )
        put(F, now.force[i])
        put(N, now.torque[i])
        if i < n:
            lever = plus(vector(now.origin[i + 1]), times(-1.0, vector(now.origin[i])))
            beyond = vector(now.moment[i + 1])
            M = now.mass[i + 1]
            add_inertia(now.inertia[i + 1], beyond, M, lever, I)
            h = plus(h, plus(beyond, times(M, lever)))
            m += M
        now.mass[i] = m
        put(h, now.moment[i])
        lever = plus(vector(now.origin[i]), times(-1.0, vector(now.origin[i - 1])))
        N = plus(N, cross(lever, F))


@inner
def rotate(R: np.ndarray, A: np.ndarray, out: np.ndarray) -> None:
    """Write R A R^T (3, 3)."""
    for r in range(3):
        row = vector(R[r])
        half = (dot(row, vector(A[0])), dot(row, vector(A[1])), dot(row, vector(A[2])))
        for c in range(3):
            out[r, c] = dot(half, vector(R[c]))


@inner
def add_inertia(
    I: np.ndarray, h: Vector, m: float, lever: Vector, out: np.ndarray
) -> None:
    """Add the inertia I (3, 3) of a mass m with first moment h, both about a point at `lever`."""
    sphere = 2.0 * dot(h, lever) + m * dot(lever, lever)
    for r in range(3):
        for c in range(3):
            products = h[r] * lever[c] + lever[r] * h[c] + m * lever[r] * lever[c]
            out[r, c] += I[r, c] - products + (sphere if r == c else 0.0)


@inner
def add_point(m: float, lever: Vector, out: np.ndarray) -> None:
    """Add the inertia (3, 3) of a point mass at `lever`."""
    for r in range(3):
        for c in range(3):
            sphere = dot(lever, lever) if r == c else 0.0
            out[r, c] += m * (sphere - lever[r] * lever[c])


@inner
def fill_inertia(arm: RigidBodies, now: BodyMotion) -> None:
    """Fill M (n, n), the inertia matrix of the joints, rotors included."""
    for j in range(arm.n):
        axis = vector(now.axis[j + 1])
        h = vector(now.moment[j + 1])
        if arm.prismatic[j] == 1.0:
            F = times(now.mass[j + 1], axis)
            N = cross(h, axis)
        else:
            F = cross(axis, h)
            N = transform(now.inertia[j + 1], axis)
        for i in range(j, -1, -1):
            now.M[i, j] = now.M[j, i] = along_joint(arm, now, i, F, N)
            lever = plus(vector(now.origin[i + 1]), times(-1.0, vector(now.origin[i])))
            N = plus(N, cross(lever, F))
        now.M[j, j] += arm.rotor[j]


@inner
def along_joint(
    arm: RigidBodies, now: BodyMotion, i: int, F: Vector, N: Vector
) -> float:
    """Return the torque [N m], or force [N], of joint i under F and a moment N about its origin."""
    axis = vector(now.axis[i + 1])
    return dot(axis, F) if arm.prismatic[i] == 1.0 else dot(axis, N)


@called
def fill_tip(
    bodies: Array, memory: Array, q: Array, position: Array, jacobian: Array
) -> None:
    """Implement `RigidArm.fill_tip`."""
    arm = bodies_of(bodies)
    now = motion_of(memory, arm)
    locate(arm, q, arm.zeros, now)
    lever = transform(now.rotation[arm.n], vector(arm.tip))
    end = plus(vector(now.origin[arm.n]), lever)
    put(end, position)
    for j in range(arm.n):
        axis = vector(now.axis[j + 1])
        if arm.prismatic[j] == 0.0:
            axis = cross(axis, plus(end, times(-1.0, vector(now.origin[j + 1]))))
        for r in range(3):
            jacobian[r, j] = axis[r]


@called
def fill_gravity(bodies: Array, memory: Array, q: Array, out: Array) -> None:
    """Write the torque (n,) [N m, or N] that holds the bodies at q against gravity."""
    arm = bodies_of(bodies)
    now = motion_of(memory, arm)
    locate(arm, q, arm.zeros, now)
    combine_bodies(arm, now, 0.0)
    for j in range(arm.n):
        out[j] = along_joint(
            arm, now, j, vector(now.force[j + 1]), vector(now.torque[j + 1])
        )


@called
def accelerate(
    bodies: Array,
    memory: Array,
    payload: float,
    q: Array,
    dq: Array,
    torque: Array,
    ddq: Array,
) -> None:
    """Implement `RigidArm.accelerate`."""
    arm = bodies_of(bodies)
    now = motion_of(memory, arm)
    locate(arm, q, dq, now)
    combine_bodies(arm, now, payload)
    for j in range(arm.n):
        ddq[j] = torque[j] - along_joint(
            arm, now, j, vector(now.force[j + 1]), vector(now.torque[j + 1])
        )
    fill_inertia(arm, now)
    for i in range(arm.n):
        for j in range(i + 1):
            now.factor[j, i] = now.M[i, j]
    cholesky_factor(now.factor)
    cholesky_solve(now.factor, ddq)


@called
def fill_mobility(
    bodies: Array,
    memory: Array,
    payload: float,
    q: Array,
    dq: Array,
    inverse: Array,
    bias: Array,
) -> None:
    """Write M^-1 (n, n) and C dq + G (n,) of the bodies, with a payload [kg] at the tip."""
    arm = bodies_of(bodies)
    now = motion_of(memory, arm)
    locate(arm, q, dq, now)
    combine_bodies(arm, now, payload)
    for j in range(arm.n):
        bias[j] = along_joint(
            arm, now, j, vector(now.force[j + 1]), vector(now.torque[j + 1])
        )
    fill_inertia(arm, now)
    invert(now.M, now.factor, inverse)


@inner
def invert(M: Array, factor: Array, inverse: Array) -> None:
    """Write the inverse of a positive definite M (n, n), with memory for its factor (n, n)."""
    for i in range(M.shape[0]):
        for j in range(i + 1):
            factor[j, i] = M[i, j]
    cholesky_factor(factor)
    for i in range(M.shape[0]):
        for j in range(M.shape[0]):
            inverse[i, j] = 1.0 if i == j else 0.0
        cholesky_solve(factor, inverse[i])


class RigidArm(NamedTuple):
    """A serial-chain arm with its working memory: threads must not share one.

    Its bodies may begin with those of a base, which are not among its n joints.
    """

    n: int
    p: int
    bodies: Array  # RigidBodies
    memory: Array  # BodyMotion

    def joint_count(self) -> int:
        """Return n."""
        return self.n

    def fill_parameters(self, payload: float, P: Array) -> None:
        """Write the base parameters P (p,) with a payload [kg]."""
        bodies = bodies_of(self.bodies)
        for k in range(self.p):
            P[k] = bodies.P[k] + payload * bodies.P_payload[k]

    def fill_tip(self, q: Array, position: Array, jacobian: Array) -> None:
        """Write the tip position (3,) [m] at q (n,), and its Jacobian (3, n) [m/rad, or 1]."""
        fill_tip(self.bodies, self.memory, q, position, jacobian)

    def accelerate(
        self, payload: float, q: Array, dq: Array, torque: Array, ddq: Array
    ) -> None:
        """Write ddq (n,) with a point mass `payload` [kg] at the tip.

        `ddq` may alias the joint `torque` (n,) [N m, or N].
        """
        accelerate(self.bodies, self.memory, payload, q, dq, torque, ddq)


def rigid_arm(bodies: RigidBodies, mounts: int = 0) -> RigidArm:
    """Return the arm of some bodies, of which the first ones are those of its base."""
    memory = np.zeros(motion_size(bodies))
    return RigidArm(bodies.n - mounts, bodies.p, pack(bodies), memory)


class PointMassArm(NamedTuple):
    """Lengths, masses and gravity; l2, m1 and m2 are unknown to the controller.

    Joint 1 is measured from the horizontal, joint 2 from link 1.  G is the gradient of
    the potential; its first term has cos q1, where (34) prints cos q2.
    """

    l1: float  # m
    l2: float  # m
    m1: float  # kg
    m2: float  # kg
    g: float  # m/s^2

    @property
    def p(self) -> int:
        """Number of parameters."""
        return 3

    def joint_count(self) -> int:
        """Return n, a constant in kernels: their loops over two joints are unrolled."""
        return 2

    def fill_parameters(self, payload: float, P: Array) -> None:
        """Write the parameters P (3,) [kg m^2] that the controller estimates."""
        m2 = self.m2 + payload
        P[0] = (self.m1 + m2) * self.l1**2
        P[1] = m2 * self.l2**2
        P[2] = m2 * self.l1 * self.l2

    def fill_tip(self, q: Array, position: Array, jacobian: Array) -> None:
        """Write the position (3,) [m] of the tip and its Jacobian (3, n) [m/rad]."""
        x1 = self.l1 * cos(q[0])
        z1 = self.l1 * sin(q[0])
        x2 = self.l2 * cos(q[0] + q[1])
        z2 = self.l2 * sin(q[0] + q[1])
        position[0] = x1 + x2
        position[1] = 0.0
        position[2] = z1 + z2
        jacobian[0, 0], jacobian[0, 1] = -z1 - z2, -z2
        jacobian[1, 0], jacobian[1, 1] = 0.0, 0.0
        jacobian[2, 0], jacobian[2, 1] = x1 + x2, x2

    def accelerate(
        self, payload: float, q: Array, dq: Array, torque: Array, ddq: Array
    ) -> None:
        """Write ddq = M^-1 (torque - C dq - G) (2,) [rad/s^2].

        `ddq` may alias `torque`.
        """
        m2 = self.m2 + payload
        outer = m2 * self.l2**2
        coupling = m2 * self.l1 * self.l2 * cos(q[1])
        m11 = (self.m1 + m2) * self.l1**2 + outer + 2.0 * coupling
        m12 = outer + coupling
        m22 = outer
        c = -m2 * self.l1 * self.l2 * sin(q[1])  # dM12/dq2 = dM11/dq2 / 2
        g2 = m2 * self.g * self.l2 * cos(q[0] + q[1])
        g1 = (self.m1 + m2) * self.g * self.l1 * cos(q[0]) + g2
        f1 = torque[0] - c * dq[1] * (2.0 * dq[0] + dq[1]) - g1
        f2 = torque[1] + c * dq[0] * dq[0] - g2
        determinant = m11 * m22 - m12 * m12
        ddq[0] = (m22 * f1 - m12 * f2) / determinant
        ddq[1] = (m11 * f2 - m12 * f1) / determinant


class Arm(Protocol):
    """An arm that may carry a payload, a point mass [kg] at its tip."""

    @property
    def p(self) -> int:
        """Number of parameters P."""

    def joint_count(self) -> int:
        """Return n, for kernels."""

    def fill_parameters(self, payload: float, P: Array) -> None:
        """Write the parameters P (p,) that the controller estimates."""

    def fill_tip(self, q: Array, position: Array, jacobian: Array) -> None:
        """Write the tip position (3,) [m] in the base frame and its Jacobian (3, n) [m/rad]."""

    def accelerate(
        self, payload: float, q: Array, dq: Array, torque: Array, ddq: Array
    ) -> None:
        """Write ddq (n,) [rad/s^2] of M ddq + C dq + G = torque.

        `ddq` may alias `torque`.
        """


compile_methods(
    Arm,
    ('joint_count', 'fill_parameters', 'fill_tip', 'accelerate'),
    PointMassArm,
    RigidArm,
)
