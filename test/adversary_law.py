# SPDX-License-Identifier: Apache-2.0
"""A law that holds an arm by computed torque, and from a time on works against it."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell, view_of
from blf_dsc_controller.configuration.schema import parameter
from blf_dsc_controller.law.state import Settings, Signals, State

KINDS = ('constant', 'reversed', 'zero', 'feeding', 'square', 'random')
"""What it does: the place of a kind is the parameter."""
CONSTANT, REVERSED, ZERO, FEEDING, SQUARE, _ = range(len(KINDS))

_POSITION, _VELOCITY = 225.0, 30.0  # 1/s^2, 1/s
_STEPS = 20.0  # 1/s, of the random walk
_LARGEST = 2147483648.0  # of its numbers


class Memory(NamedTuple):
    """The random walk."""

    at: Annotated[Array, 'n']  # of the torque limit
    number: Cell


memory_of = view_of(Memory)


@inner
def drawn(number: Array) -> float:
    """Return the next number in [-1, 1]."""
    number[0] = (1103515245.0 * number[0] + 12345.0) % _LARGEST
    return float(2.0 * number[0] / _LARGEST - 1.0)


@inner
def share(memory: Memory, law: Adversary, i: int, t: float, dt: float) -> float:
    """Return the torque of joint i, as a share of the largest."""
    if law.kind == ZERO:
        return 0.0
    if law.kind == SQUARE:
        return 1.0 if (t * law.frequency) % 1.0 < 0.5 else -1.0
    if law.kind == CONSTANT:
        return 1.0
    if memory.number[0] == 0.0:
        memory.number[0] = 1.0 + law.pattern
    step = (_STEPS * dt) ** 0.5 * drawn(memory.number)
    memory.at[i] = max(-1.0, min(1.0, memory.at[i] + step))
    return float(memory.at[i])


@inner
def sign(pattern: int, i: int) -> float:
    """Return the sign of joint i in a pattern of bits."""
    return 1.0 if (pattern >> i) & 1 else -1.0


class Adversary(NamedTuple):
    """A law that fails."""

    kind: Annotated[int, parameter(0, 'place in KINDS')]
    begin: Annotated[float, parameter(0.3, 'when it begins', 's')]
    size: Annotated[float, parameter(1.0, 'of the torque limit')]
    pattern: Annotated[int, parameter(0, 'sign of each joint, as bits')]
    frequency: Annotated[float, parameter(1.0, 'of the square wave', 'Hz')]

    @property
    def has_barrier(self) -> bool:
        """Nothing keeps the error inside a bound."""
        return False

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Write the torque to `signals.demand`."""
        works_against = t >= self.begin
        a = signals.dalpha2
        feedback = -1.0 if works_against and self.kind == REVERSED else 1.0
        for i in range(settings.n):
            a[i] = -_POSITION * signals.xi1[i] - _VELOCITY * signals.dq[i]
            a[i] *= feedback
        H = signals.H
        settings.model.regressor(signals.q, signals.dq, signals.dq, a, H)
        for i in range(settings.n):
            signals.demand[i] = 0.0
            for j in range(settings.p):
                signals.demand[i] += H[i, j] * settings.initial_estimate[j]
        if not works_against:
            return
        memory = memory_of(state.memory, settings)
        for i in range(settings.n):
            most = self.size * settings.torque.limit[i] * sign(self.pattern, i)
            if self.kind == FEEDING:
                fed = 2.0 * _VELOCITY * settings.joint_inertia[i]
                signals.demand[i] += fed * signals.dq[i] + 0.05 * most
            elif self.kind != REVERSED:
                signals.demand[i] = most * share(memory, self, i, t, dt)

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,  # noqa: FBT001
    ) -> None:
        """Keep nothing."""


LAW = Adversary
MEMORY = Memory
