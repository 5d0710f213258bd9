# SPDX-License-Identifier: Apache-2.0
"""Torque ripple of gears and motors: a sine and a cosine of the joint's own position.

Strain-wave gears and motors with poles disturb a joint by a torque that repeats N times
in each turn of it.  For each N of `learning.ripple_cycles` there are two columns a joint,

    tau_dist,i = a sin(N q_i) + b cos(N q_i)                                       [N m]

learned from the window like the other columns, and compensated at the position that
the reference has when the torque acts.
"""

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law.columns import Settings
from blf_dsc_controller.numerics.elementary import cos, sin


@inner
def fill_ripple(settings: Settings, i: int, angle: float, H: Array) -> None:
    """Fill the ripple columns of row i of a regressor H (n, m) at the position `angle` [rad]."""
    n = H.shape[0]
    blocks = settings.bias + settings.viscous + settings.coulomb
    blocks += settings.load_friction + 2 * settings.tones
    at = settings.first + n * blocks
    for k in range(settings.ripples):
        for j in range(2 * n):
            H[i, at + j] = 0.0
        H[i, at + i] = sin(settings.ripple_cycles[k] * angle)
        H[i, at + n + i] = cos(settings.ripple_cycles[k] * angle)
        at += 2 * n


@inner
def fill_measured_ripple(
    settings: Settings, lag: float, q: Array, dq: Array, H: Array
) -> None:
    """Fill the ripple columns of H (n, m) for the row, at q (n,) [rad] and dq (n,) [rad/s].

    The row's torque has passed the velocity filter, half of the `lag` [s] of
    `robot.lag`, but positions have not.
    """
    for i in range(q.size):
        fill_ripple(settings, i, q[i] - 0.5 * lag * dq[i], H)


@inner
def fill_compensated_ripple(
    settings: Settings,
    lag: float,
    qr: Array,
    dqr: Array,
    ddqr: Array,
    dt: float,
    H: Array,
) -> None:
    """Fill the ripple columns of H (n, m), where the reference is when the torque acts.

    Torques act 1.5 samples and half of the `lag` [s] late.
    """
    lead = 1.5 * dt + 0.5 * lag
    for i in range(qr.size):
        velocity = dqr[i] + 0.5 * lead * ddqr[i]
        fill_ripple(settings, i, qr[i] + lead * velocity, H)
