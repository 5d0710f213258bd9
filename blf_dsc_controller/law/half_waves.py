# SPDX-License-Identifier: Apache-2.0
"""Half waves of a signal of each joint: from one turning point to the next.

A half wave ends where the signal has turned back from its farthest value by more than its caller
takes for noise.  The next one has begun at that value.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array

TURNED_BACK = 0.25
"""Part of a half wave by which a signal turns back at its end, at least."""


class State(NamedTuple):
    """The present half wave of each joint."""

    direction: Annotated[Array, 'n']  # 1, -1; 0: none yet
    turn: Annotated[Array, 'n']  # value at its beginning
    farthest: Annotated[Array, 'n']  # value farthest from there so far
    since: Annotated[Array, 'n']  # s, since the beginning
    farthest_at: Annotated[Array, 'n']  # s, of `farthest`, likewise


@inner
def begin(state: State, i: int, x: float) -> None:
    """Begin the next half wave of joint i at x, in the direction of before."""
    state.turn[i] = state.farthest[i] = x
    state.since[i] = state.farthest_at[i] = 0.0


@inner
def follow(state: State, i: int, x: float) -> float:
    """Follow the signal x of joint i; return by how much it has turned back.

    `since` is that of x.
    """
    ahead = float(state.direction[i] * (x - state.farthest[i]))
    if ahead >= 0.0:
        state.farthest[i] = x
        state.farthest_at[i] = state.since[i]
        if state.direction[i] == 0.0:
            state.direction[i] = 1.0
        return 0.0
    return -ahead


@inner
def travel(state: State, i: int) -> float:
    """Return the height of the present half wave of joint i."""
    return abs(float(state.farthest[i] - state.turn[i]))


@inner
def end(state: State, i: int, x: float) -> None:
    """End the half wave of joint i, whose signal is x now, and begin the next."""
    state.turn[i] = state.farthest[i]
    state.since[i] -= state.farthest_at[i]
    state.direction[i] = -state.direction[i]
    state.farthest[i] = x
    state.farthest_at[i] = state.since[i]
