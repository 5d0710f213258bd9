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
def fill_block(
    settings: Settings, i: int, tau: float, velocity: float, H: Array
) -> None:
    """Fill the block in row i of a regressor H (n, m), at tau_L [N m] and a velocity [rad/s]."""
    blocks = settings.bias + settings.viscous + settings.coulomb
    rubs = abs(tau) * sliding(velocity, settings.coulomb_velocity)
    set_block(H, settings.first + H.shape[0] * blocks, i, rubs)


@inner
def fill_measured(settings: Settings, tau: Array, dq: Array, Yr: Array) -> None:
    """Fill the block of [Yr | D] (n, m) for the row, at tau_L (n,) [N m] and dq (n,) [rad/s]."""
    for i in range(dq.size):
        fill_block(settings, i, tau[i], dq[i], Yr)


@inner
def fill_compensated(
    settings: Settings,
    lag: float,
    tau: Array,
    dqr: Array,
    ddqr: Array,
    dt: float,
    H: Array,
) -> None:
    """Fill the block of H (n, m), at the velocity that the reference has when the torque acts.

    Torques act 1.5 samples and half of the `lag` [s] late.
    """
    lead = 1.5 * dt + 0.5 * lag
    for i in range(dqr.size):
        fill_block(settings, i, tau[i], dqr[i] + lead * ddqr[i], H)
