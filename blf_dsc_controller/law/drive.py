# SPDX-License-Identifier: Apache-2.0
"""The one place where torques of the law become commands of the drive, and back.

The law reckons with the whole torque of a joint.  A drive may add the torque that holds the arm
against gravity itself, by its own model of the arm and of the payload it has been told of:

    whole torque = command + G_d(q)

`find_added` computes G_d(q); `saturation` subtracts it from what leaves, and `find_applied` adds it
to what enters.  Friction that a drive compensates is not reckoned with on either side: the friction
columns then describe what is left of it (`Robot.friction`).  A drive that adds nothing has no
columns here, and all sums are with zero, which changes no bit.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.chain_kernels import fill_regressor
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array, part
from blf_dsc_controller.law.settings import EFFORT, Settings
from blf_dsc_controller.law.state import Signals, State


@inner
def find_added(settings: Settings, signals: Signals, q: np.ndarray) -> None:
    """Write G_d(q) to `signals.added` (n,) [N m]."""
    if settings.drive == 0:
        return
    still = signals.still
    fill_regressor(settings.drive_chain, q, still, still, still, signals.drive)
    for i in range(settings.n):
        signals.added[i] = 0.0
        for j in range(settings.drive):
            signals.added[i] += signals.drive[i, j] * settings.drive_inertias[j]


@inner
def find_applied(
    settings: Settings, state: State, signals: Signals, measurement: np.ndarray
) -> None:
    """Write the mean whole torque of the last interval to `signals.applied` (n,) [N m].

    It is the last command, or the measured effort, and the mean of G_d at both ends.
    """
    n = settings.n
    effort = part(measurement, 2 * n, (n,))
    for i in range(n):
        if settings.torque_source != EFFORT:
            signals.applied[i] = state.torque[i]
        else:
            signals.applied[i] = effort[i]
        if settings.torque_source != EFFORT or settings.effort_is_whole == 0:
            signals.applied[i] += 0.5 * (state.added[i] + signals.added[i])
        state.added[i] = signals.added[i]


def added_torque(settings: Settings, q: Array) -> Array:
    """Return G_d(q) (n,) [N m] at a position q (n,)."""
    added = np.zeros(settings.n)
    if settings.drive:
        H, still = np.zeros((settings.n, settings.drive)), np.zeros(settings.n)
        _fill_gravity(settings.drive_chain, q, still, H)
        added[:] = H @ settings.drive_inertias
    return added


@kernel
def _fill_gravity(chain: Array, q: Array, still: Array, H: Array) -> None:
    fill_regressor(chain, q, still, still, still, H)
