# SPDX-License-Identifier: Apache-2.0
"""What a law keeps at each start: parts of its state go on, all others begin as at the first."""

from __future__ import annotations

from enum import Enum

from blf_dsc_controller.law.state import State


class Start(Enum):
    """Why a law begins with the next sample."""

    FIRST = 'after configuration or reset'
    AFTER_STOP = 'in command again after a fault'
    ELSEWHERE = 'in command again, and the arm is not where the law left it'
    AGAIN = 'in command again, and the arm is where the law left it'
    AFTER_GAP = 'in command all along, after states that were missing'


_ESTIMATE = ('estimate',)
_POSTURE = ('disturbance',)
_LEARNED = (
    *_ESTIMATE,
    'motors',
    'sensors',
    'latch',
    'change',
    'friction',
    'memory',
    'window',
)
_MOTION = ('alpha2', 'torque', 'feedback', 'saturation', 'row', 'observer')
_AT_THE_TIP = ('frozen', 'external', 'contact', 'payload')

KEPT: dict[Start, tuple[str, ...]] = {
    Start.FIRST: (),
    Start.AFTER_STOP: (*_ESTIMATE, *_POSTURE),
    Start.ELSEWHERE: _LEARNED,
    Start.AGAIN: (*_LEARNED, *_POSTURE, *_MOTION),
    Start.AFTER_GAP: (*_LEARNED, *_POSTURE, *_MOTION, *_AT_THE_TIP),
}
"""Fields of `State` that go on at a start.

What was learned survives each start but that after a fault, which may be its doing: then the
last sound estimates remain.  d^3 and the load observer belong to the posture that the arm was
left in, and what the tip holds or touches is unknown after a time without command.
"""


def keep(start: Start, before: State, state: State) -> None:
    """Copy the parts that `KEPT` names from the state `before` to a reset `state`."""
    for name in KEPT[start]:
        _copy(getattr(before, name), getattr(state, name))


def _copy(before: object, target: object) -> None:
    """Copy the arrays of a part of the state, and of the parts in it."""
    if isinstance(before, tuple) and isinstance(target, tuple):
        for source, destination in zip(before, target, strict=True):
            _copy(source, destination)
    else:
        target[...] = before  # type: ignore[index]
