# SPDX-License-Identifier: Apache-2.0
"""Measuring in turns, and Markdown tables.

Each figure is the ratio of interleaved measurements: on a shared machine only they can
be compared. Contestants may be processes.
"""

from __future__ import annotations

import gc
import importlib.metadata
import itertools
import os
import platform
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

from blf_dsc_controller import __version__

_PACKAGES = ('numpy', 'numba', 'scipy', 'mujoco', 'pin', 'ros-jazzy-rclpy')

FULL = 10.0
"""Time [s] after which learning has begun and its window is full."""


class Ratio(NamedTuple):
    """Ratio of a contestant's measurement to the baseline of its group."""

    group: str
    what: str  # the contestant
    median: float  # of the ratios of all rounds; a round measures both within seconds
    low: float
    high: float
    baseline: str
    note: str = ''


def ratio(
    group: str,
    what: str,
    baseline: str,
    mine: np.ndarray,
    theirs: np.ndarray,
    note: str = '',
) -> Ratio:
    """Return the ratio of two interleaved series (rounds,)."""
    low, median, high = np.quantile(mine / theirs, (0.0, 0.5, 1.0)).tolist()
    return Ratio(group, what, median, low, high, baseline, note)


def interleaved(
    contestants: Mapping[str, Callable[[], int]], rounds: int
) -> dict[str, np.ndarray]:
    """Return seconds per unit of work (rounds,) of each contestant, all run in each round.

    A contestant does its work and returns the number of units. The first round is a
    warm-up.
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


def print_table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], file: TextIO | None = None
) -> None:
    """Print a Markdown table, each row as soon as it is known."""
    for row in itertools.chain([heads, ['---'] * len(heads)], rows):
        print(f'| {" | ".join(row)} |', file=file, flush=True)


def machine() -> str:
    """Describe the machine and the versions, without the host name."""
    models = re.findall(r'model name\s*:\s*(.*)', Path('/proc/cpuinfo').read_text())
    model = models[0] if models else 'unknown processor'
    versions = [
        f'Python {platform.python_version()}',
        f'blf_dsc_controller {__version__}',
    ]
    for package in _PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions.append(f'{package} {importlib.metadata.version(package)}')
    return (
        f'{model}, {os.cpu_count()} cores, {platform.system()}; {", ".join(versions)}'
    )
