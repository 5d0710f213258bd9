# SPDX-License-Identifier: Apache-2.0
"""The sampled loop at small errors, of an arm with rigid or elastic joints.

About a posture, each joint of an elastic arm is a motor behind a spring:

    M q'' = K (th - q) + D (th' - q') + d
    B th'' + F th' + K (th - q) + D (th' - q') = u

M [kg m^2] is that of the links, B the inertia of the motors, d [N m] a torque at the
links.  Drives with a torque sensor may close a loop around it,

    u = tau + k_T (tau - s) - k_S s',      s = K (th - q) + D (th' - q') behind a lag

A rigid arm is one state less for each joint: (M + B) q'' + F q' = tau + d.  Drives
and velocity filter have lags, torques are held for a sample and arrive after whole
samples, and velocities are differences of positions (th or q).

What a law adds is linear as well: `Feedback`.  `Loop.margin` is the modulus margin,
the smallest singular value of I + G C over the frequencies, for the loop cut at the
torques of all joints: the distance from instability that no simultaneous change of
the joints' responses may bridge.  It is looked for above 5 Hz: below, an arm is rigid,
and its damping ratio is the better measure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

SLOWEST = 5.0
"""Frequency [Hz] from which on margins count: below, the damping ratio is the better measure."""

DAMPING_RATIO = 0.03
"""Damping ratio of motor and link on the spring between them, both free."""

_SHORTEST = 1e-5  # s, of a lag that is not left out
_FREQUENCIES = 120
_FASTEST = 0.48  # of the sample rate


class TorqueLoop(NamedTuple):
    """Loop of the drives around their joint torque sensors."""

    gain: float = 4.0  # k_T
    damping: float = 8e-3  # k_S, s
    lag: float = 3e-4  # s


class Joints(NamedTuple):
    """What is between the torques of the drives and the links."""

    motors: Floats  # B (n,), kg m^2, reflected to the joints
    viscous: Floats  # F (n,), N m s/rad
    stiffness: Floats | None = None  # K (n,), N m/rad; None: rigid
    damping_ratio: float = DAMPING_RATIO
    torque_loop: TorqueLoop | None = None
    motor_side: bool = False  # the encoders are at the motors


class Timing(NamedTuple):
    """Sampling and lags of a loop."""

    period: float  # T, s
    delay: int = 1  # whole samples until a torque arrives
    drive_lag: float = 0.0  # s
    velocity_lag: float = 0.0  # s, of the filter on differenced positions


class Feedback(NamedTuple):
    """A law at small errors, in k postures.

    With measured position y and velocity v, from the reference,

        tau = - position y - surface xi2 + inertia alpha2' + d3,    xi2 = v - alpha2
        alpha2 follows -rate y by the surface filter,               d3' = - integral xi2

    The xi2 of `surface` may lag.
    """

    position: Floats  # (k, n, n) N m/rad
    surface: Floats  # (k, n, n) N m s/rad
    inertia: Floats  # (k, n, n) kg m^2
    integral: Floats  # (k, n, n) N m/rad
    rate: Floats  # (n,) 1/s
    time_constant: float  # lambda, s
    known_rate: bool
    damping_lag: float | Floats = 0.0  # s, of all joints or of each (n,)


class Loop(NamedTuple):
    """Arm, sampling and law, in k postures: the linear loop."""

    links: Floats  # M (k, n, n), kg m^2
    joints: Joints
    timing: Timing
    feedback: Feedback

    def transition(self) -> tuple[Floats, Floats]:
        """Return A (k, N, N) and B (k, N, n) of the errors x+ = A x + B d.

        d [N m] is held for a sample; the first n of x are the positions q [rad].
        """
        A, G, sensed = _sampled_arm(self.links, self.joints, self.timing)
        return _with_law(A, G, sensed, self.timing, self.feedback)

    def at(self, postures: slice) -> Loop:
        """Return the loop in some of the postures."""
        law = self.feedback
        some = law._replace(
            position=law.position[postures],
            surface=law.surface[postures],
            inertia=law.inertia[postures],
            integral=law.integral[postures],
        )
        return self._replace(links=self.links[postures], feedback=some)

    def is_stable(self) -> bool:
        """Return whether the errors decay in all postures."""
        A, _ = self.transition()
        return bool(np.abs(np.linalg.eigvals(A)).max() < 1.0)

    def margin(self) -> Margin:
        """Return the modulus margin in the worst posture; 0 if one is unstable."""
        frequencies = np.geomspace(SLOWEST, _FASTEST / self.timing.period, _FREQUENCIES)
        s: Complex = np.asarray(2j * np.pi * frequencies, complex)
        G = arm_response(self.links, self.joints, self.timing, s)
        C = law_response(self.feedback, self.timing, s)
        distance = np.eye(len(self.joints.motors)) + G @ C
        smallest = np.linalg.svd(distance, compute_uv=False)[..., -1]
        posture, index = np.unravel_index(int(smallest.argmin()), smallest.shape)
        value = float(smallest[posture, index]) if self.is_stable() else 0.0
        _, _, directions = np.linalg.svd(distance[posture, index])
        joint = int(np.abs(directions[-1]).argmax())
        return Margin(value, float(frequencies[index]), int(posture), joint)


class Margin(NamedTuple):
    """A modulus margin, with the frequency [Hz], posture and joint at which it is smallest."""

    value: float
    frequency: float
    posture: int
    joint: int


def arm_response(links: Floats, joints: Joints, timing: Timing, s: Complex) -> Complex:
    """Return G (k, f, n, n) [rad/(N m)] at s = i omega (f,), from torque to measured position.

    `links` are M (k, n, n) [kg m^2].  Holding the torque, delay and lag of the drives are part of
    it.
    """
    T = timing.period
    hold = (1.0 - np.exp(-T * s)) / (T * s) * np.exp(-timing.delay * T * s)
    hold = hold / (1.0 + timing.drive_lag * s)
    s = s[:, None]  # (f, n) from here on
    motors = joints.motors * s**2 + joints.viscous * s
    M = links[:, None] * (s**2)[..., None]  # (k, f, n, n)
    if joints.stiffness is None:
        return np.linalg.inv(M + _diagonals(motors)) * hold[:, None, None]
    spring = joints.stiffness + _damping(links, joints, joints.stiffness) * s
    loop = joints.torque_loop or TorqueLoop(0.0, 0.0)
    sensed = (loop.gain + loop.damping * s) / (1.0 + loop.lag * s)
    free = np.linalg.inv(M + _diagonals(spring))
    link_response = free * spring[:, None, :]  # q = ... th
    reaction = spring * (1.0 + sensed)
    motor = _diagonals(motors + reaction) - reaction[..., None] * link_response
    motor_response = np.linalg.inv(motor) * ((1.0 + loop.gain) * hold)[:, None, None]
    if joints.motor_side:
        return motor_response
    return np.asarray(link_response @ motor_response)


def law_response(feedback: Feedback, timing: Timing, s: Complex) -> Complex:
    """Return C (k, f, n, n) [N m/rad] at s = i omega (f,): tau = - C y."""
    T = timing.period
    z = np.exp(T * s)[:, None, None]
    decay = _decay(timing.velocity_lag, T)
    velocity = (1.0 - decay) * (1.0 - 1.0 / z) / T / (1.0 - decay / z)
    C_y, C_v = law_responses(feedback, T, s)
    return np.asarray(C_y + velocity * C_v)


def law_responses(feedback: Feedback, T: float, s: Complex) -> tuple[Complex, Complex]:
    """Return C_y [N m/rad] and C_v [N m s/rad] (k, f, n, n): tau = - C_y y - C_v v.

    T [s] is the sample time, s = i omega (f,).
    """
    z = np.exp(T * s)[:, None]
    g = 1.0 - np.exp(-T / feedback.time_constant)
    # alpha2+ = alpha2 + g (-rate y - alpha2) - T rate v
    followed = -g * feedback.rate / (z - 1.0 + g)
    known = (
        -T * feedback.rate / (z - 1.0 + g) if feedback.known_rate else 0.0 * followed
    )
    return (
        feedback.position[:, None] + _alpha2_response(feedback, T, z, followed, 0.0),
        _alpha2_response(feedback, T, z, known, 1.0),
    )


def _alpha2_response(
    feedback: Feedback, T: float, z: Complex, alpha2: Complex, velocity: float
) -> Complex:
    """Return what the law adds for alpha2 (f, n) and the velocity, at z (f, 1): (k, f, n, n)."""
    dalpha2 = (z - 1.0) / T * alpha2
    xi2 = velocity - alpha2
    d3 = -T / (z - 1.0) * xi2
    lagged = low_pass(_damping_decay(feedback, T), z) * xi2
    return np.asarray(
        feedback.surface[:, None] * lagged[:, None, :]
        - feedback.inertia[:, None] * dalpha2[:, None, :]
        - feedback.integral[:, None] * d3[:, None, :]
    )


def low_pass(decay: float | Floats, z: Complex) -> Complex:
    """Return the response (...) at z (...) of a lag that retains `decay` in a sample."""
    return np.asarray((1.0 - decay) / (1.0 - decay / z))


def _diagonals(values: Complex) -> Complex:
    """Return diagonal matrices (..., n, n) of values (..., n)."""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))


def _decay(lag: float, T: float) -> float:
    return float(np.exp(-T / max(lag, _SHORTEST)))


def _damping_decay(feedback: Feedback, T: float) -> Floats:
    """Return what the lags of xi2 retain in a sample: of all joints or of each (n,)."""
    lag = np.asarray(feedback.damping_lag)
    return np.where(lag > 0.0, np.exp(-T / np.maximum(lag, _SHORTEST)), 0.0)


def _damping(links: Floats, joints: Joints, K: Floats) -> Floats:
    """Return D (n,) [N m s/rad] of the springs K (n,): by the least inertia of the links."""
    free = 1.0 / np.diagonal(np.linalg.inv(links), axis1=1, axis2=2)
    link = free.min(axis=0)
    reduced = joints.motors * link / (joints.motors + link)
    return np.asarray(2.0 * joints.damping_ratio * np.sqrt(K * reduced))


def _sampled_arm(
    links: Floats, joints: Joints, timing: Timing
) -> tuple[Floats, Floats, Floats]:
    """Return the arm over a sample: x+ = A x + G [tau, d], with y = sensed x.

    x has q and q', those of the motors and the torque loop of elastic joints, and the
    torque of the drives.
    """
    k, n, _ = links.shape
    arm = _rigid_arm if joints.stiffness is None else _elastic_arm
    A, G, sensed = arm(links, joints)
    drive = slice(-n, None)
    lag = max(timing.drive_lag, _SHORTEST)
    A[:, drive, drive] = -np.eye(n) / lag
    G[:, drive, :n] = np.eye(n) / lag
    size = A.shape[1]
    augmented = np.zeros((k, size + 2 * n, size + 2 * n))
    augmented[:, :size, :size] = A
    augmented[:, :size, size:] = G
    from scipy.linalg import expm  # 0.1 s and a pool of threads: only where it is used

    sampled = expm(timing.period * augmented)[:, :size]
    return sampled[..., :size], sampled[..., size:], sensed


def _rigid_arm(links: Floats, joints: Joints) -> tuple[Floats, Floats, Floats]:
    """Return x' = A x + G [tau, d], with y = sensed x, but for the drives: x = [q, q', drive]."""
    k, n, _ = links.shape
    q, dq, drive = np.eye(3 * n).reshape(3, n, 3 * n)
    A, G = np.zeros((k, 3 * n, 3 * n)), np.zeros((k, 3 * n, 2 * n))
    free = np.linalg.inv(links + np.diag(joints.motors))
    A[:, :n] = dq
    A[:, n : 2 * n] = free @ (drive - joints.viscous[:, None] * dq)
    G[:, n : 2 * n, n:] = free
    return A, G, q


def _elastic_arm(links: Floats, joints: Joints) -> tuple[Floats, Floats, Floats]:
    """Return the same for x = [q, q', th, th', s, drive]."""
    k, n, _ = links.shape
    q, dq, th, dth, lagged_spring, drive = np.eye(6 * n).reshape(6, n, 6 * n)
    K = np.asarray(joints.stiffness)
    D = _damping(links, joints, K)
    spring = K[:, None] * (th - q) + D[:, None] * (dth - dq)
    loop = joints.torque_loop or TorqueLoop(0.0, 0.0)
    change = (spring - lagged_spring) / loop.lag
    u = (1.0 + loop.gain) * drive - loop.gain * lagged_spring - loop.damping * change
    friction = joints.viscous[:, None] * dth
    free = np.linalg.inv(links)
    A, G = np.zeros((k, 6 * n, 6 * n)), np.zeros((k, 6 * n, 2 * n))
    A[:, :n] = dq
    A[:, n : 2 * n] = free @ spring
    A[:, 2 * n : 3 * n] = dth
    A[:, 3 * n : 4 * n] = (u - spring - friction) / joints.motors[:, None]
    A[:, 4 * n : 5 * n] = change
    G[:, n : 2 * n, n:] = free
    return A, G, th if joints.motor_side else q


class _Memory(NamedTuple):
    """What the law and the way to the drives keep for the next sample.

    Each is a matrix (n, N) or (k, n, N) that takes it from the whole state x (N,).
    """

    pending: tuple[Floats, ...]  # torques, the oldest first, N m
    y: Floats  # rad
    v: Floats  # rad/s
    alpha2: Floats  # rad/s
    d3: Floats  # N m
    lagged: tuple[Floats, ...]  # xi2 behind `damping_lag`, if there is one

    @property
    def parts(self) -> tuple[Floats, ...]:
        """All of them, in the order of the state."""
        return (*self.pending, self.y, self.v, self.alpha2, self.d3, *self.lagged)


def _memory_before(size: int, n: int, delay: int, *, lags: bool) -> _Memory:
    """Return the memory before a sample: behind the `size` states of the arm."""
    blocks = delay + 4 + lags
    rows = np.eye(size + blocks * n)[size:].reshape(blocks, n, -1)
    y, v, alpha2, d3 = rows[delay : delay + 4]
    return _Memory(tuple(rows[:delay]), y, v, alpha2, d3, tuple(rows[delay + 4 :]))


def _law_step(
    memory: _Memory, y: Floats, T: float, velocity_lag: float, law: Feedback
) -> tuple[Floats, _Memory]:
    """Return the law's torque at the measured position y, and the memory after it.

    Both are matrices, as is y, that take them from the whole state.
    """
    velocity_decay = _decay(velocity_lag, T)
    v = velocity_decay * memory.v + (1.0 - velocity_decay) * (y - memory.y) / T
    rate = law.rate[:, None]
    g = 1.0 - np.exp(-T / law.time_constant)
    dalpha2 = g * (-rate * y - memory.alpha2) / T
    if law.known_rate:
        dalpha2 = dalpha2 - rate * v
    xi2 = v - memory.alpha2
    damping_decay = _damping_decay(law, T)[..., None]
    lagged = tuple(
        damping_decay * each + (1.0 - damping_decay) * xi2 for each in memory.lagged
    )
    damped = lagged[0] if lagged else xi2
    tau = law.inertia @ dalpha2 - law.position @ y - law.surface @ damped
    tau = tau + memory.d3
    alpha2 = memory.alpha2 + T * dalpha2
    d3 = memory.d3 - T * (law.integral @ xi2)
    pending = (*memory.pending, tau)[1:]
    return tau, _Memory(pending, y, v, alpha2, d3, lagged)


def _with_law(
    arm: Floats, G: Floats, sensed: Floats, timing: Timing, law: Feedback
) -> tuple[Floats, Floats]:
    """Return A (k, N, N) and B (k, N, n) of arm, pending torques and law together."""
    k, size, _ = arm.shape
    n = len(sensed)
    memory = _memory_before(size, n, timing.delay, lags=bool(np.any(law.damping_lag)))
    N = memory.y.shape[1]
    y = np.zeros((n, N))
    y[:, :size] = sensed
    tau, next_memory = _law_step(memory, y, timing.period, timing.velocity_lag, law)
    acting = memory.pending[0] if timing.delay else tau
    A = np.zeros((k, N, N))
    A[:, :size, :size] = arm
    A[:, :size] += G[..., :n] @ acting
    rows = [np.broadcast_to(part, (k, n, N)) for part in next_memory.parts]
    A[:, size:] = np.concatenate(rows, axis=1)
    B = np.zeros((k, N, n))
    B[:, :size] = G[..., n:]
    return A, B
