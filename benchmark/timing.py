# SPDX-License-Identifier: Apache-2.0
"""Ratios measured side by side: everything else on a shared machine is weather."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np


class Ratio(NamedTuple):
    """How much more than the baseline of its group something takes.

    Attributes:
        group: which comparison it belongs to.
        what: the contestant.
        baseline: whom it is compared with.
        median: of the ratios of all rounds; a round measures both within seconds.
        low: smallest ratio.
        high: largest ratio.
        note: what to know when reading it.
    """

    group: str
    what: str
    baseline: str
    median: float
    low: float
    high: float
    note: str = ''


def ratio(
    group: str, what: str, baseline: str, mine: np.ndarray, theirs: np.ndarray, note: str = ''
) -> Ratio:
    """Ratio of two series (rounds,) that were measured in turns."""
    quotients = mine / theirs
    return Ratio(
        group,
        what,
        baseline,
        float(np.median(quotients)),
        float(quotients.min()),
        float(quotients.max()),
        note,
    )


def interleaved(contestants: Mapping[str, Callable[[], int]], rounds: int) -> dict[str, np.ndarray]:
    """Seconds per unit of work (rounds,) of each contestant, all of them in each round.

    A contestant does its work and returns how many units that was.  One round is not counted.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for counted in range(-1, rounds):
        for name, work in contestants.items():
            gc.collect()
            begin = time.perf_counter()
            units = work()
            elapsed = time.perf_counter() - begin
            if counted >= 0:
                seconds[name].append(elapsed / units)
    return {name: np.array(values) for name, values in seconds.items()}
