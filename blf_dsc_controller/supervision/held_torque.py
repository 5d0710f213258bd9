# SPDX-License-Identifier: Apache-2.0
"""The command that acts on an arm by its effort, whoever has sent it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.law.torque import added_torque

Vector = NDArray[np.float64]


def held_command(
    config: ControllerConfig, settings: Settings, measurement: Vector
) -> Vector | None:
    """Return the command (n,) [N m] that acts, within the torque limit; None: unknown.

    `measurement` is [q (n,) rad, dq (n,) rad/s, effort (n,) N m]; the effort may not be a
    torque, or missing.
    """
    q, _, effort = measurement.reshape(3, -1)
    if config.robot.effort not in ('whole', 'commanded') or not (
        np.isfinite(effort).all() and np.isfinite(q).all()
    ):
        return None
    held = effort.copy()
    if config.robot.effort == 'whole':
        held -= added_torque(settings.torque, q)
    limit = settings.torque.limit
    return np.asarray(np.clip(held, -limit, limit))
