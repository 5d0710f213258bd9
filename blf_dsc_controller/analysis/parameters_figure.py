# SPDX-License-Identifier: Apache-2.0
"""The picture of the learning, after the paper's Fig. 3: estimates beside the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from blf_dsc_controller.analysis.envelope import envelope
from blf_dsc_controller.analysis.estimation import Estimation, latch_time
from blf_dsc_controller.analysis.style import (
    BLUE,
    COLOURS,
    GREEN,
    INK,
    MUTED,
    formula,
    head,
    save_panels,
)
from blf_dsc_controller.messages.names import DISTURBANCE, LAMBDA_MIN
from blf_dsc_controller.run import Floats, Run, Series

_PANEL = (6.2, 3.2)  # inches
_GOAL = 0.01  # relative error
_LEAST = 1e-7  # relative error that is drawn


def draw_parameters(run: Run, path: Path) -> bool:
    """Draw what the run tells of the learning; False, and no picture, if there was none."""
    estimation = Estimation.of(run)
    if estimation is None or not estimation.names:
        return False
    panels = list(_panels(run, estimation))
    save_panels(path, _title(estimation), panels, _PANEL, latch_time(run))
    return True


def _title(estimation: Estimation) -> str:
    error = estimation.relative_error
    if error is None:
        return 'Learning'
    return f'Learning: relative parameter error {_percent(error[-1])} at the end'


def _panels(run: Run, estimation: Estimation) -> Iterator[Callable[[Axes], None]]:
    assert run.learning is not None  # noqa: S101 - there is an estimation
    yield partial(_estimates, estimation)
    if estimation.relative_error is not None:
        yield partial(_relative_error, estimation)
    if any(name.startswith(DISTURBANCE) for name in run.learning.names):
        yield partial(_disturbance, run, run.learning)
    if LAMBDA_MIN in run.learning.names:
        yield partial(_excitation, run, run.learning)


def _estimates(estimation: Estimation, axes: Axes) -> None:
    for j, name in enumerate(estimation.names):
        _estimate(axes, j, formula(name), envelope(estimation.time, estimation.estimate[:, j]))
    if estimation.true is not None:
        for true in estimation.true.T:
            _true(axes, envelope(estimation.time, true))
    axes.set_ylabel('parameters [kg m²]')
    head(axes, 'estimates')


def _relative_error(estimation: Estimation, axes: Axes) -> None:
    error = estimation.relative_error
    assert error is not None  # noqa: S101 - the panel is drawn only then
    axes.semilogy(*envelope(estimation.time, np.maximum(error, _LEAST)), color=BLUE)
    axes.axhline(_GOAL, color=MUTED, lw=1.2, ls='--', label=_percent(_GOAL))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{100 * value:g} %'))
    axes.set_ylabel(r'$\|\hat P - P\| \;/\; \|P\|$')
    head(axes, 'relative parameter error')


def _disturbance(run: Run, learning: Series, axes: Axes) -> None:
    names = [name for name in learning.names if name.startswith(DISTURBANCE)]
    for j, name in enumerate(names):
        values = envelope(run.time_of(learning.stamp), learning.column(name))
        _estimate(axes, j, name.removeprefix(DISTURBANCE), values)
    if run.truth is not None:
        for name in sorted(set(names).intersection(run.truth.names)):
            _true(axes, envelope(run.time_of(run.truth.stamp), run.truth.column(name)))
    axes.set_ylabel('disturbance [N m]')
    head(axes, 'disturbance estimates')


def _excitation(run: Run, learning: Series, axes: Axes) -> None:
    values = envelope(run.time_of(learning.stamp), learning.column(LAMBDA_MIN))
    axes.plot(*values, color=GREEN)
    axes.set_ylabel(r'$\lambda_{\min}(\Phi)$')
    latched = latch_time(run)
    began = 'learning never began' if latched is None else f'learning begins at {latched:.4g} s'
    head(axes, f'excitation; {began}')


def _estimate(axes: Axes, j: int, label: str, values: tuple[Floats, Floats]) -> None:
    axes.plot(*values, color=COLOURS[j % len(COLOURS)], lw=2.4, alpha=0.75, label=label)


def _true(axes: Axes, values: tuple[Floats, Floats]) -> None:
    is_first = 'true' not in axes.get_legend_handles_labels()[1]
    axes.plot(*values, color=INK, lw=1.2, ls='--', label='true' if is_first else None)


def _percent(value: float) -> str:
    return f'{100 * value:.2g} %'
