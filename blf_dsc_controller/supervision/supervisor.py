# SPDX-License-Identifier: Apache-2.0
"""The phase of the controller, and the reason of its last stop."""

from __future__ import annotations

from enum import Enum, Flag, auto
from typing import NamedTuple

from blf_dsc_controller.messages.journal import OUTSIDE_BOUND


class Phase(str, Enum):
    """What the controller is doing."""

    __str__ = str.__str__

    INACTIVE = 'inactive'  # not in command: the safe torque, or on the ramp to it
    STARTING = 'starting'  # waiting for the first joint state
    APPROACHING = 'approaching'  # on the way to the reference
    TRACKING = 'tracking'
    SAFE_STOP = 'safe stop'  # the safe torque until the next reset or activation


class Reason(str, Enum):
    """Why the controller stopped."""

    __str__ = str.__str__

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
    WRAPPED = 'position wrapped'
    JUMPED = 'position jumped'
    START_REJECTED = 'start rejected'
    OUTSIDE_BOUND = OUTSIDE_BOUND
    NO_EFFECT = 'commands without effect'
    SATURATED = 'torque saturated'
    OVERRUN = 'loop overrun'
    CONTACT = 'contact'
    OSCILLATION = 'oscillation'
    ESTIMATE = 'estimate not finite'
    TORQUE = 'torque not finite'
    FAILED = 'failed'


class Doubtful(Flag):
    """What was not in order before a stop, so that the torque without the law rests on less."""

    MOTION = auto()  # the last motion of the law: no load follows from it
    ESTIMATES = auto()  # those since the error grew, which have wound up
    EFFECT = auto()  # that commands reach the arm: its motion has to prove that first


DOUBTFUL: dict[Reason, Doubtful] = {
    # commands that do not reach the arm
    Reason.OUTSIDE_BOUND: Doubtful.MOTION | Doubtful.ESTIMATES | Doubtful.EFFECT,
    Reason.SATURATED: Doubtful.MOTION | Doubtful.ESTIMATES | Doubtful.EFFECT,
    Reason.NO_EFFECT: Doubtful.MOTION | Doubtful.EFFECT,
    # wrong velocities, or a law that has fought against something
    Reason.VELOCITY: Doubtful.MOTION | Doubtful.ESTIMATES,
    Reason.CONTACT: Doubtful.MOTION | Doubtful.ESTIMATES,
    Reason.OSCILLATION: Doubtful.MOTION | Doubtful.ESTIMATES,
}
"""By the reason of the stop; after any other one, all was in order.

Estimates of a stop without effect are those of when a joint last moved, which its check finds.
"""

STAMPS = (Reason.STAMP_REPEATED, Reason.STAMP_BACKWARD, Reason.STAMP_JUMP)
"""What the states of two publishers on one topic look like, among others."""


class Fault(NamedTuple):
    """Why the controller must stop: the reason, and a sentence with the values."""

    reason: Reason
    text: str


def is_in_doubt(reason: Reason, what: Doubtful) -> bool:
    """Whether a stop of this reason leaves something in doubt."""
    return what in DOUBTFUL.get(reason, Doubtful(0))


class Supervisor:
    """Phase of the controller and the reason of its last stop.

    Attributes:
        phase: what the controller is doing.
        reason, text: why it stopped; `NONE` and empty if it did not.
        stops: number of stops since the controller was configured.
        revision: how often phase, reason or text have been set.
        running: whether the law is in command.
        uses_states: whether the law uses joint states: it runs or is about to start.
    """

    def __init__(self) -> None:
        self.stops = self.revision = 0
        self.enter(Phase.INACTIVE)

    def enter(self, phase: Phase) -> None:
        """Begin a phase other than the safe stop, and clear the reason."""
        self._set(phase, Reason.NONE, '')

    def stop(self, reason: Reason, text: str) -> bool:
        """Enter the safe stop; return False if already stopped or inactive."""
        if not self.uses_states:
            return False
        self._set(Phase.SAFE_STOP, reason, text)
        self.stops += 1
        return True

    def add(self, text: str) -> None:
        """Add to the text, without changing phase or reason."""
        self._set(self.phase, self.reason, '; '.join(filter(None, (self.text, text))))

    def _set(self, phase: Phase, reason: Reason, text: str) -> None:
        """Set phase, reason and text, and what follows from them."""
        self.phase = phase
        self.reason = reason
        self.text = text
        self.running = phase in (Phase.TRACKING, Phase.APPROACHING)
        self.uses_states = self.running or phase is Phase.STARTING
        self.revision += 1
