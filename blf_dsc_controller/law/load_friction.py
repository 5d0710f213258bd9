# SPDX-License-Identifier: Apache-2.0
"""Friction that grows with the torque in the gear of a joint.

The teeth of a gear rub the more, the more torque it carries.  With the torque tau_L that the
learned model has along the reference, each joint has a column for the share k of it that is lost,

    tau_dist,i = k |tau_L,i| s(dq_i),    tau_L = H(qr, dqr, dqr, ddqr) P^                [N m]

learned from the window like the other columns, and compensated at the velocity that the
reference has when the torque acts.  The measured torque in place of tau_L would explain itself.

Of Coulomb friction, reversals show the sum of both where they happen to be.  What varies with
posture and load along the motion is left to this column.
"""

from blf_dsc_controller.arms.friction import sliding
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law.columns import Settings, set_block


@inner
def fill_gear_torque(first: int, H: Array, estimate: Array, tau: Array) -> None:
    """Write tau_L (n,) [N m] to `tau`, by the `first` p columns of H (n, m) and of theta^ (m,)."""
    for i in range(tau.size):
        tau[i] = 0.0
        for j in range(first):
            tau[i] += H[i, j] * estimate[j]


@inner
def fill_block(settings: Settings, tau: Array, i: int, sign: float, H: Array) -> None:
    """Fill the block in row i of a regressor H (n, m), at tau_L (n,) [N m] and s of a velocity."""
    blocks = settings.bias + settings.viscous + settings.coulomb
    set_block(H, settings.first + tau.size * blocks, i, abs(tau[i]) * sign)


@inner
def fill_measured(settings: Settings, tau: Array, dq: Array, Yr: Array) -> None:
    """Fill the block of [Yr | D] (n, m) for the row, at tau_L (n,) [N m] and dq (n,) [rad/s]."""
    for i in range(tau.size):
        sign = sliding(dq[i], settings.coulomb_velocity)
        fill_block(settings, tau, i, sign, Yr)


@inner
def fill_compensated(settings: Settings, tau: Array, sign: Array, H: Array) -> None:
    """Fill the block of H (n, m), with `sign` (n,), the s at which `friction` is compensated."""
    for i in range(tau.size):
        fill_block(settings, tau, i, sign[i], H)
