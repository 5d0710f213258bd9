# SPDX-License-Identifier: Apache-2.0
"""What `drive` says of the motors of an arm: their models, and how they sit at the joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.motors import damiao
from blf_dsc_controller.motors.damiao import Limits
from blf_dsc_controller.motors.mounting import Mounting

T = TypeVar('T')


def mounting_of(config: DriveConfig, joints: int) -> Mounting:
    """Return how the motors sit at so many joints.

    Raises:
        BlfDscError: there are not as many directions or offsets.
    """
    directions = config.motor_directions or (1,) * joints
    offsets = config.motor_offsets or (0.0,) * joints
    return Mounting(
        np.array(_for_each('motor_directions', directions, joints), np.float64),
        np.array(_for_each('motor_offsets', offsets, joints), np.float64),
    )


def limits_of(config: DriveConfig, joints: int) -> list[Limits]:
    """Return what the frames of simulated motors hold.

    Raises:
        BlfDscError: the models of so many motors are not given.
    """
    known = f', of {", ".join(damiao.MODELS)}'
    models = _for_each('motor_models', config.motor_models, joints, known)
    return [damiao.MODELS[each] for each in models]


def _for_each(
    name: str, given: Sequence[T], joints: int, known: str = ''
) -> Sequence[T]:
    if len(given) != joints:
        raise BlfDscError(
            f'drive.{name}: got {len(given)}, but the arm has {joints} joints: give one for '
            f'each{known}'
        )
    return given
