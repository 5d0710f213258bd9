# SPDX-License-Identifier: Apache-2.0
"""The words for what the controller is doing, what was done to it, and why it stopped."""

from __future__ import annotations

from enum import Enum


class Phase(Enum):
    """What the controller is doing; the value is what `~/state` says."""

    INACTIVE = 'inactive'  # not in command: ramped, or ramping, to the safe torque
    STARTING = 'starting'  # waiting for the first state to start from
    APPROACHING = 'approaching'  # on the way to the reference
    TRACKING = 'tracking'
    SAFE_STOP = 'safe stop'  # the safe torque until reset or activated again


class Operation(Enum):
    """What an operator did last; the value is what `~/state` says."""

    NONE = 'none'
    ACTIVATE = 'activate'
    DEACTIVATE = 'deactivate'
    RESET = 'reset'


class Reason(Enum):
    """Why the controller stopped; the value is what `~/state` says."""

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
    START_REFUSED = 'start refused'
    OUTSIDE_BOUND = 'error past the bound'
    SATURATED = 'torque saturated'
    OVERRUN = 'loop overrun'
    ESTIMATE = 'estimate not finite'
    TORQUE = 'torque not finite'
    FAILED = 'failed'
