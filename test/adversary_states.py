# SPDX-License-Identifier: Apache-2.0
"""States that are not the arm's, in every way that a sender, a driver or a sensor makes them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scenario import State


class Play(NamedTuple):
    """What happens to the states, and when."""

    kind: str
    size: float  # in [-1, 1]
    joint: int
    every: int  # samples: one of so many is concerned
    lasts: int  # samples in a row that are


def _moved(state: State, play: Play, *, q: float = 0.0, dq: float = 0.0) -> State:
    """Return a state with another position and velocity of one joint."""
    i = play.joint % state.q.size
    positions, velocities = state.q.copy(), state.dq.copy()
    positions[i] += q
    velocities[i] += dq
    return replace(state, q=positions, dq=velocities)


def _scaled(state: State, play: Play, q: float, dq: float) -> State:
    i = play.joint % state.q.size
    factor = np.ones((2, state.q.size))
    factor[:, i] = q, dq
    return replace(state, q=factor[0] * state.q, dq=factor[1] * state.dq)


def _swapped(state: State, play: Play) -> State:
    i = play.joint % state.q.size
    order = np.arange(state.q.size)
    order[[i, i - 1]] = order[[i - 1, i]]
    return replace(state, q=state.q[order], dq=state.dq[order])


def _of_another(state: State, play: Play) -> list[State]:
    """Return the state after one of another sender, whose joints rest elsewhere."""
    n = state.q.size
    nothing = np.zeros(n)
    q = nothing if play.joint == 0 else state.q + play.size
    stamp = state.stamp - 5e-4
    other = replace(state, stamp=stamp, q=q, dq=nothing, effort=nothing)
    return (
        [other, state]
        if play.size > 0.0
        else [state, replace(other, stamp=stamp + 6e-4)]
    )


def _rounded(state: State, play: Play) -> State:
    step = 5e-3 * abs(play.size) + 1e-6
    return replace(state, q=step * np.round(state.q / step))


CHANGES: dict[str, Callable[[State, Play], Iterable[State]]] = {
    'position': lambda s, p: [_moved(s, p, q=p.size**3)],
    'velocity': lambda s, p: [_moved(s, p, dq=5.0 * p.size**3)],
    'leap': lambda s, p: [_moved(s, p, q=p.size, dq=1e3 * p.size)],
    'not finite': lambda s, p: [_moved(s, p, q=np.nan if p.size > 0.0 else np.inf)],
    'no velocity': lambda s, p: [_moved(s, p, dq=np.nan)],
    'scaled': lambda s, p: [_scaled(s, p, 1.0 + 0.5 * p.size, 1.0 + 0.5 * p.size)],
    'velocity scaled': lambda s, p: [_scaled(s, p, 1.0, 2.0 * p.size)],
    'reversed': lambda s, p: [_scaled(s, p, -1.0, -1.0)],
    'velocity reversed': lambda s, p: [_scaled(s, p, 1.0, -1.0)],
    'swapped': lambda s, p: [_swapped(s, p)],
    'of another': _of_another,
    'rounded': lambda s, p: [_rounded(s, p)],
    'missing': lambda *_: [],
    'copied': lambda s, p: [s] * (2 + p.joint % 3),
    'stamp': lambda s, p: [replace(s, stamp=s.stamp + 0.02 * p.size)],
}
"""What becomes of one state."""

KINDS = (*CHANGES, 'frozen', 'frozen velocity')


class Spoiler:
    """Spoils the states of a run from a sample on.

    Attributes:
        trusted: number of the last sample that arrived as it was measured.
    """

    def __init__(self, play: Play, begin: int) -> None:
        self.trusted = -1
        self._play = play
        self._begin = begin
        self._sample = -1
        self._frozen: State | None = None

    def __call__(self, state: State) -> list[State]:
        """Return the states that arrive for one that is measured."""
        self._sample += 1
        play, since = self._play, self._sample - self._begin
        if since < 0 or since % (play.every + play.lasts) >= play.lasts:
            self._frozen = state
            self.trusted = self._sample
            return [state]
        last = self._frozen or state
        if play.kind == 'frozen':
            return [replace(last, stamp=state.stamp)]
        if play.kind == 'frozen velocity':
            return [replace(state, dq=last.dq)]
        return list(CHANGES[play.kind](state, play))
