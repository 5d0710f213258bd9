# SPDX-License-Identifier: Apache-2.0
"""One-line progress of a running loop or of a bag being played."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from blf_dsc_controller.configuration.plant import PlantConfig
from sim_plant.plant import parameter_order, parameters_of

_FORMAT = '{desc} |{bar}| {n:.1f}/{total:g} s [{elapsed}<{remaining}]{postfix}'
_LINE_PERIOD = 10.0  # s between two lines if stderr is not a terminal


class Progress:
    """Progress over time: a bar on a terminal, otherwise (as in a log) a line every few seconds."""

    def __init__(self, title: str, seconds: float) -> None:
        """Begin at 0 of `seconds`, which is 0 if the end is open."""
        self._title, self._seconds = title, seconds
        self._line = ''
        self._due = time.monotonic() + _LINE_PERIOD
        self._bar = tqdm(
            total=seconds,
            desc=title,
            bar_format=_FORMAT,
            mininterval=0.2,
            disable=not sys.stderr.isatty(),
        )

    def show(self, elapsed: float, status: str = '') -> None:
        """Show the elapsed time [s] and a short status."""
        self._bar.set_postfix_str(status, refresh=False)
        self._bar.update(min(elapsed, self._seconds) - self._bar.n)
        self._line = f'{self._title} {elapsed:.1f}/{self._seconds:g} s' + (status and f', {status}')
        if time.monotonic() >= self._due:
            self._print_line()

    def write(self, text: str) -> None:
        """Print a line without disturbing the bar."""
        self._bar.write(text, file=sys.stderr)
        sys.stderr.flush()

    def close(self) -> None:
        """Close the bar, or print the last line."""
        self._bar.close()
        self._print_line()

    def _print_line(self) -> None:
        if self._bar.disable and self._line:
            print(self._line, file=sys.stderr, flush=True)
            self._line = ''
            self._due = time.monotonic() + _LINE_PERIOD


class LoopProgress(Progress):
    """Progress over simulated time, with the largest |xi1| / k_c and the parameter error."""

    def __init__(self, config: PlantConfig, parameters: Sequence[str]) -> None:
        """Begin at 0 s; `parameters` are the names of the estimates."""
        super().__init__('closed loop', config.duration)
        self._order = parameter_order(parameters, config)
        self._config = config

    def show_loop(self, elapsed: float, ratio: float, estimate: ArrayLike) -> None:
        """Show the simulated time [s], the largest |xi1| / k_c so far, and P^ (p,)."""
        P = parameters_of(self._config, elapsed)[self._order]
        error = np.linalg.norm(np.asarray(estimate) - P) / np.linalg.norm(P)
        status = f'max|xi1|/bound {ratio:.2f}'
        if np.all(self._order >= 0) and not self._config.robot.urdf:  # else P has mixed units
            status += f', parameter error {100 * error:.2f} %'
        self.show(elapsed, status)
