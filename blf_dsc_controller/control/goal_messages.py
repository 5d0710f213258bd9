# SPDX-License-Identifier: Apache-2.0
"""Messages between the controller and the process of its action.

Joint values are in the order of the controller's joints. They are sent as JSON: a
pickle could name code that the controller would run, and any DDS participant talks to
the action's process.
"""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple, TypeAlias

KIND = 0
"""Of all of them over a `Link`."""

SUCCESSFUL = 'SUCCESSFUL'
INVALID = 'INVALID_GOAL'
PATH_VIOLATED = 'PATH_TOLERANCE_VIOLATED'
GOAL_VIOLATED = 'GOAL_TOLERANCE_VIOLATED'


JointTolerance: TypeAlias = tuple[str, float, float]
"""Of a joint: position [rad] and velocity [rad/s], as sent: 0 is the default, -1 none."""


# From the process of the action.


class Goal(NamedTuple):
    """A goal that a client has sent."""

    number: int
    trajectory: bytes  # serialised trajectory_msgs/JointTrajectory
    path: Sequence[JointTolerance]
    goal: Sequence[JointTolerance]
    time: float  # s, as sent: 0 is the default, negative without end


class Cancel(NamedTuple):
    """A client cancels a goal."""

    number: int


# To the process of the action.


class Answer(NamedTuple):
    """Whether a goal is followed from now on."""

    number: int
    accepted: bool
    reason: str = ''  # why it is not


class Feedback(NamedTuple):
    """Where the arm is: reference [q, dq, ddq] and arm [q, dq]."""

    number: int
    stamp: int  # ns, of the joint state
    time: float  # s since the trajectory's beginning
    desired: list[list[float]]  # rad, rad/s, rad/s^2
    actual: list[list[float]]  # rad, rad/s


class Outcome(str, Enum):
    """The final state of a goal."""

    SUCCEEDED = 'succeeded'
    ABORTED = 'aborted'
    CANCELLED = 'cancelled'


class End(NamedTuple):
    """The end of a goal that was accepted."""

    number: int
    outcome: Outcome | str  # a text once it was sent
    code: str  # the name of an error code of the action's result
    text: str


Message: TypeAlias = Goal | Cancel | Answer | Feedback | End
_KINDS: dict[str, type[Message]] = {
    each.__name__: each for each in (Goal, Cancel, Answer, Feedback, End)
}


def encode(message: Message) -> bytes:
    """Return a message as JSON; every number keeps its bits."""
    fields = [type(message).__name__, *message]
    return json.dumps(fields, default=_as_text).encode()


def decode(raw: bytes) -> Message:
    """Return the message of `encode`."""
    kind, *fields = json.loads(raw)
    message = _KINDS[kind](*fields)
    if isinstance(message, Goal):
        return message._replace(trajectory=b64decode(message.trajectory))
    return message


def _as_text(trajectory: bytes) -> str:
    return b64encode(trajectory).decode('ascii')
