# SPDX-License-Identifier: Apache-2.0
"""Messages over a `Link` between a script and the process of its loop.

Contents are JSON, except those of SAMPLE, POSITIONS and requests. A log entry is `topic_link`'s
LOG.
"""

from __future__ import annotations

from functools import cache
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.messages.topic_link import encode

Floats = NDArray[np.float64]

_NUMBER = Struct('<Q')

# To the loop.
START = 110
"""What to control: `config`, `overrides`, `robot`, `record`."""
POSITIONS = 113
"""The next target of a stream: float64 (n,) [rad]."""
CLOSE = 116
"""End at rest; a second one ends at once."""
RECOVER = 117
"""Start again after an end: {}."""
# Likewise, each a `request`, that gets a DONE.
MOVE = 111
"""Go straight to `positions` with a share `speed` of the limits."""
FOLLOW = 112
"""Follow `points` (time, positions, velocities, accelerations) of `joints`: JSON that may be
long, and is read where it is planned."""
BRAKE = 114
"""Brake and hold: null."""
LOAD = 115
"""The drives are to add a load: `mass` [kg], `centre` [m]."""
TARE = 118
"""Take the external torque for zero: null."""
EXPECT = 119
"""The tip takes up a load: `mass` [kg], `centre` [m], `interval` [s], or the last one weighed if
`remember`."""

# From the loop.
RUNNING = 120
"""The arm is in command: names of the joints."""
SAMPLE = 121
"""A state, as `encode_sample` packs it."""
DONE = 123
"""A request is done: its `number`, and the `problem` if it cannot be."""
ENDED = 124
"""The loop has ended: `end`, `text`, and whether it `waits` for RECOVER."""
FAILED = 125
"""It could not start: the sentence."""


def request(number: int, wanted: Any) -> bytes:
    """Return the content of a request: its number before JSON."""
    return _NUMBER.pack(number) + encode(wanted)


def request_in(content: bytes) -> tuple[int, bytes]:
    """Return number and JSON of a request."""
    return _NUMBER.unpack_from(content)[0], content[_NUMBER.size :]


class ArmState(NamedTuple):
    """What a loop says of its arm at one sample; arrays are (n,).

    `load` and its `load_interval`, half of a 95 % interval, are NaN until weighed.
    """

    time: float  #: s since the start, by the robot's clock
    phase: str  #: such as ``tracking``
    q: Floats  #: rad, measured
    dq: Floats  #: rad/s, measured
    tau: Floats  #: N m, commanded
    reference: Floats  #: rad
    error: Floats  #: rad, q - reference
    bound: Floats  #: rad, on the error
    external: Floats  #: N m, external torque; NaN unless `contact.enabled`
    load: float  #: kg more at the tip than at the start
    load_interval: float  #: kg
    contact: bool  #: whether something touches the arm; False unless `contact.enabled`


_SCALARS = {
    'time': 'f8',
    'phase': 'U16',
    'load': 'f8',
    'load_interval': 'f8',
    'contact': '?',
}


@cache
def _layout(joints: int) -> np.dtype[np.void]:
    """Return how a state of an arm with so many joints is sent."""
    return np.dtype(
        [
            (name, _SCALARS.get(name, 'f8'), () if name in _SCALARS else (joints,))
            for name in ArmState._fields
        ]
    )


def encode_sample(state: ArmState) -> bytes:
    """Return a state as bytes."""
    return np.array(tuple(state), _layout(len(state.q))).tobytes()


def decode_sample(raw: bytes, joints: int) -> ArmState:
    """Return the state of `encode_sample`, of an arm with so many joints."""
    return ArmState(*np.frombuffer(raw, _layout(joints)).item())
