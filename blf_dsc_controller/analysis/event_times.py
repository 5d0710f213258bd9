# SPDX-License-Identifier: Apache-2.0
"""Times of events in a run: learning began, the arm changed, a bound was left."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.analysis.estimates import parameters_in
from blf_dsc_controller.messages.journal import OUTSIDE_BOUND
from blf_dsc_controller.messages.topics import LATCHED, MODEL_CHANGES
from blf_dsc_controller.run import Run

_BLOCK = 8192


def latch_time(run: Run) -> float:
    """Return the time at which learning began [s].

    It is NaN if it never did, or is not recorded.
    """
    return next(iter(_rises(run, LATCHED)), math.nan) if run.learns else math.nan


def change_times(run: Run) -> list[float]:
    """Return the times [s] at which the controller detected a change of the arm."""
    return _rises(run, MODEL_CHANGES)


def _rises(run: Run, name: str) -> list[float]:
    """Return the times [s] at which a count of the learning rises."""
    if run.monitor is None or name not in run.monitor.names:
        return []
    rises = np.flatnonzero(
        np.diff(np.nan_to_num(run.monitor.column(name)), prepend=0.0) > 0.0
    )
    return [float(t) for t in run.time_of(run.monitor.stamp[rises])]


def true_change_times(run: Run) -> list[float]:
    """Return the times [s] at which the plant's true parameters began to change."""
    if run.truth is None:
        return []
    columns = run.truth.indices(parameters_in(run.truth.names))
    changes = [
        np.any(
            np.diff(run.truth.values[begin : begin + _BLOCK + 1, columns], axis=0), 1
        )
        for begin in range(0, run.truth.stamp.size, _BLOCK)
    ]
    changed = np.concatenate(changes)
    begins = np.flatnonzero(np.diff(changed, prepend=False) & changed) + 1
    return [float(t) for t in run.time_of(run.truth.stamp[begins])]


def outside(run: Run, i: int) -> NDArray[np.bool_] | None:
    """Return where |xi1| >= k_c for a joint, (N,); None if error or bound is unknown."""
    error = run.column('error', i)
    bound = run.column('bound', i)
    return (
        None if error is None or bound is None else np.asarray(np.abs(error) >= bound)
    )


def first_violation(run: Run) -> tuple[float, str]:
    """Return when [s] a joint first left its bound, and which; NaN and empty if none did.

    The error of the sample that causes a stop is not published, so the stop itself
    counts.
    """
    found = [
        (time, _left(run.joints, stop.text))
        for time, stop in run.timed_stops
        if stop.reason == OUTSIDE_BOUND
    ]
    for i, joint in enumerate(run.joints):
        violated = outside(run, i)
        if violated is not None and violated.any():
            found.append((float(run.time[violated.argmax()]), joint))
    return min(found, key=itemgetter(0), default=(math.nan, ''))


def _left(joints: Sequence[str], text: str) -> str:
    """Return the joint that is past its bound; a stop's text may name another as the cause."""
    return next((joint for joint in joints if f'joint {joint!r} is ' in text), '')
