# SPDX-License-Identifier: Apache-2.0
"""Phases of the controller and reasons of its safe stops, with their published names."""

from __future__ import annotations

from enum import StrEnum


class Phase(StrEnum):
    """What the controller is doing."""

    INACTIVE = 'inactive'  # not in command: the safe torque, or on the ramp to it
    STARTING = 'starting'  # waiting for the first joint state
    APPROACHING = 'approaching'  # on the way to the reference
    TRACKING = 'tracking'
    SAFE_STOP = 'safe stop'  # the safe torque until the next reset or activation


class Reason(StrEnum):
    """Why the controller stopped."""

    NONE = 'none'
    STATE_TIMEOUT = 'state timeout'
    STAMP_MISSING = 'stamp missing'
    STAMP_REPEATED = 'stamp repeated'
    STAMP_BACKWARD = 'stamp backward'
    STAMP_JUMP = 'stamp jump'
    BAD_MESSAGE = 'bad message'
    JOINT_MISSING = 'joint missing'
    JOINT_DUPLICATED = 'joint duplicated'
    FIELD_MISSING = 'field missing'
    NOT_FINITE = 'measurement not finite'
    VELOCITY = 'velocity not plausible'
    START_REJECTED = 'start rejected'
    OUTSIDE_BOUND = 'error past the bound'
    SATURATED = 'torque saturated'
    OVERRUN = 'loop overrun'
    ESTIMATE = 'estimate not finite'
    TORQUE = 'torque not finite'
    FAILED = 'failed'
