# SPDX-License-Identifier: Apache-2.0
"""Readings that a driver sends once more, bridged at the velocity of the arm.

Drivers that do not wait for their arm send a reading once more, with a new stamp: an
arm in motion that seems to stand still for a sample.  It is continued at its velocity.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell

BRIDGED = 3.5
"""Samples for which a reading may be repeated."""


class State(NamedTuple):
    """The last reading, and what the law uses of it."""

    read: Annotated[Array, '2 * n']  # q and dq as last read
    age: Cell  # s, since they were new
    used: Annotated[Array, '3 * n']  # the measurement that the law uses


@inner
def bridge(
    state: State, measurement: Array, begins: bool, sample_time: float, dt: float
) -> None:
    """Write the measurement (3 n,) [q, dq, effort] that the law uses to `state.used`.

    It comes `dt` [s] after the last, usually a `sample_time` [s]; none repeats what was
    before it `begins`.
    """
    n = measurement.size // 3
    repeats = not begins
    for i in range(2 * n):
        repeats = repeats and measurement[i] == state.read[i]
        state.read[i] = measurement[i]
    state.age[0] = state.age[0] + dt if repeats else 0.0
    is_bridged = repeats and state.age[0] < BRIDGED * sample_time
    for i in range(n):
        state.used[i] = measurement[i]
        state.used[n + i] = measurement[n + i]
        state.used[2 * n + i] = measurement[2 * n + i]
        if is_bridged:
            state.used[i] += state.age[0] * measurement[n + i]
