# SPDX-License-Identifier: Apache-2.0
"""Estimates that a stop returns to: the last valid ones, and those from before a fault grew.

Commands that do not reach the arm make its error grow, and the disturbance estimate
with it.  What is learned while the arm may oscillate, or while no joint moves, is as
wrong; so is r of `load_observer` while it is being left out.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell

_RELAXED = 1.4  # s, in which the least error may double, nearly: an error grows faster
_SMALL = 0.01  # of the bound: an error that has not grown


class State(NamedTuple):
    """Estimates, and d^3 with r of `load_observer`, of some past samples."""

    kept: Annotated[Array, 'm + n']  # of the last sample that was not suspect
    moved: Annotated[Array, 'm + n']  # of when a joint last moved
    consistent: Annotated[Array, 'm + n']  # from before the error grew
    # |xi1| / k of the sample that `consistent` is of, relaxed since
    min_ratio: Cell


@inner
def keep(state: State, estimate: Array, disturbance: Array, observed: Array) -> None:
    """Keep theta^ (m,), and d^3 (n,) with r (n,) [N m], of a sample that is not suspect.

    `observed` is the steady r of `load_observer`, empty without sensors.
    """
    m = estimate.size
    for j in range(m):
        state.kept[j] = estimate[j]
    for i in range(disturbance.size):
        state.kept[m + i] = disturbance[i]
    for i in range(observed.size):
        state.kept[m + i] += observed[i]


@inner
def keep_moved(state: State) -> None:
    """Keep the same as those of when a joint last moved."""
    for j in range(state.kept.size):
        state.moved[j] = state.kept[j]


@inner
def keep_consistent(
    state: State,
    ratio: float,
    is_sound: bool,
    begins: bool,
    dt: float,
) -> None:
    """Keep the same as those from before the error grew: of the smallest recent error.

    Args:
        ratio: largest |xi1| / k of the sample.
        is_sound: the arm does not oscillate, and r of `load_observer` is not in doubt.
        begins: it is the first sample.
        dt: sample time [s].
    """
    threshold = state.min_ratio[0] * (1.0 + dt / _RELAXED)
    threshold = max(_SMALL, threshold)
    if (ratio > threshold or not is_sound) and not begins:
        state.min_ratio[0] = threshold
        return
    state.min_ratio[0] = ratio
    for j in range(state.kept.size):
        state.consistent[j] = state.kept[j]
