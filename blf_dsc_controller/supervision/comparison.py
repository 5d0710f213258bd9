# SPDX-License-Identifier: Apache-2.0
"""A joint state beside the ones before it, and a torque beside the last: compiled comparisons.

They run before and after the law in every sample, so one pass over the joints answers all
questions; what follows from the answers is decided where they are asked.
"""

from __future__ import annotations

from math import inf, isfinite

from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.compiled.layout import Array

NOT_FINITE, FAR, OUT_OF_REACH, NEW, MOVES, LEAPS = 1, 2, 4, 8, 16, 32
"""Answers of `compare_state`: a sum of them."""

ALONE = 0.5
"""Time [s] after which states that follow from each other are trusted, wherever they began.

In it, a joint that nobody sees is taken to reach twice its largest speed from rest.
"""

_MOVED_STEPS = 3.0  # of the sensor: an arm that has moved by more reads otherwise
_FINEST_STEP = 1e-4  # rad, a count of an encoder of 16 bits: no step counts as less


@kernel
def compare_state(
    measurement: Array,
    read: Array,
    at: Array,
    last: Array,
    speed: Array,
    fastest: Array,
    resolution: Array,
    step: float,
    elapsed: float,
    age: float,
) -> int:
    """Return what a measurement [q, dq, ...] (3 n,) says.

    NOT_FINITE: a position is not.
    FAR: from the positions `at` (n,) [rad] a joint has gone, in a `step` [s], more than twice
        as fast as the `fastest` (n,) [rad/s] that it may be.
    LEAPS: it has, and more than twice as fast as its own velocity.
    OUT_OF_REACH: likewise from the `last` trusted positions (n,) [rad], `elapsed` [s] ago,
        with twice its `speed` (n,) [rad/s] there added, and an acceleration that takes it to
        twice the `fastest` within ALONE.
    NEW: it differs from `read`, q and dq (2 n,).
    MOVES: at its velocity the arm has gone farther in `age` [s] than the steps of its sensor,
        with their `resolution` (n,) [rad], hide.
    """
    n = last.size
    found = 0
    for i in range(n):
        q, dq = measurement[i], measurement[n + i]
        least_step = _MOVED_STEPS * max(resolution[i], _FINEST_STEP)
        reach = 2.0 * fastest[i] * step + least_step
        if not isfinite(q):
            found |= NOT_FINITE
        if abs(q - at[i]) > reach:
            found |= FAR
            if not abs(q - at[i]) <= 2.0 * abs(dq) * step < inf:
                found |= LEAPS
        gone_on = 2.0 * speed[i] * elapsed + fastest[i] * elapsed**2 / ALONE
        if abs(q - last[i]) > reach + gone_on:
            found |= OUT_OF_REACH
        if not (q == read[i] and dq == read[n + i]):
            found |= NEW
        if abs(dq) * age > least_step:
            found |= MOVES
    return found


@kernel
def limit_torque(torque: Array, last: Array, limit: Array, step: Array) -> None:
    """Keep a torque (n,) [N m] finite, within its `limit`, and a `step` from the `last`.

    Where any is not finite, the last one stays.  The level takes precedence, for example if
    it is lowered below the last torque.
    """
    is_finite = True
    for i in range(torque.size):
        is_finite = is_finite and isfinite(torque[i])
    for i in range(torque.size):
        now = torque[i] if is_finite else last[i]
        now = min(max(now, last[i] - step[i]), last[i] + step[i])
        now = min(max(now, -limit[i]), limit[i])
        torque[i] = now
