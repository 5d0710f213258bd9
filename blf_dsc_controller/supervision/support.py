# SPDX-License-Identifier: Apache-2.0
"""Check before the start whether brakes or drives hold the resting arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.reference.approach import AT_REST
from blf_dsc_controller.supervision.first_torque import MATTERS, is_like
from blf_dsc_controller.supervision.model_torque import gravity_torque

Vector = NDArray[np.float64]


def check_support(
    controller: Controller, config: ControllerConfig, measurement: Vector
) -> None:
    """Raise StartError if it is unknown what holds the arm, and no step is limited.

    Brakes may hold it, or drives that compensate gravity, to which gravity would be
    added.
    """
    robot = config.robot
    is_known = robot.drive_compensates != 'none' or robot.effort in ('whole', 'current')
    if not robot.urdf or is_known or config.safety.first_torque == 'send':
        return
    q, dq, effort = measurement.reshape(3, -1)
    gravity = gravity_torque(controller.settings, controller.state.estimate, q)
    unlimited = np.where(np.array(config.torque.first_step) > 0.0, 0.0, np.abs(gravity))
    worst = int(np.argmax(unlimited))
    matters = unlimited[worst] > MATTERS * config.torque.limit[worst]
    # of an effort like gravity, `check_first_torque` says more
    is_held = np.isfinite(effort).all() and is_like(effort, gravity)
    if matters and not is_held and not np.abs(dq).max() > AT_REST:
        unit = config.units[worst].torque
        raise StartError(
            'what holds the arm? The arm rests, but the joint states do not show whether its '
            'brakes hold it, or drives that compensate gravity: on joint '
            f'{config.joints[worst]!r} gravity is {gravity[worst]:.4g} {unit}, and the effort is '
            f'{effort[worst]:.4g} {unit}. If the drives compensate gravity, set '
            'robot.drive_compensates. If not, set robot.effort to whole, if the drives measure '
            'torques, or set torque.first_step to the torques that may be sent at once'
        )
