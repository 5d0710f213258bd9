# SPDX-License-Identifier: Apache-2.0
"""Small multiples of the robustness study: a panel for each condition, a line for each law."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from blf_dsc_controller.analysis.style import ALARM, COLOURS, MUTED, Picture
from blf_dsc_controller.paper.metrics import Metrics
from blf_dsc_controller.paper.runs import Outcome
from blf_dsc_controller.paper.sweeps import LAWS, SWEEPS, Sweep, case_name

_PANEL = (4.6, 2.9)  # inches
_COLUMNS = 3
_BROKEN = 10.0  # of the bound: larger ratios are drawn there
_MARKS = 'os^D'


def draw_robustness(outcomes: Mapping[str, Outcome], folder: Path) -> list[Path]:
    """Draw the largest error and the parameter error of every sweep; return both paths."""
    tracking, learning = folder / 'robustness_tracking.png', folder / 'robustness_learning.png'
    _draw(
        'Largest error, in units of the bound: above the red line it was left',
        outcomes,
        lambda metrics: min(metrics.largest_ratio, _BROKEN),
        _dress_ratio,
        tracking,
    )
    _draw(
        'Parameter error over the last ten of 30 s',
        outcomes,
        lambda metrics: metrics.tail_error,
        _dress_learning,
        learning,
    )
    return [tracking, learning]


def _draw(
    title: str,
    outcomes: Mapping[str, Outcome],
    value_of: Callable[[Metrics], float],
    dress: Callable[[Axes], None],
    path: Path,
) -> None:
    rows = -(-len(SWEEPS) // _COLUMNS)
    picture = Picture(rows, _COLUMNS, title, _PANEL, share_time=False)
    for sweep, axes in zip(SWEEPS, picture.axes.flat, strict=False):
        _panel(sweep, outcomes, value_of, axes)
        dress(axes)
    picture.axes.flat[0].legend(frameon=False, fontsize=9, loc='best')
    picture.save(path)


def _panel(
    sweep: Sweep,
    outcomes: Mapping[str, Outcome],
    value_of: Callable[[Metrics], float],
    axes: Axes,
) -> None:
    for law, colour, mark in zip(LAWS, COLOURS, _MARKS, strict=False):
        if law not in sweep.laws:
            continue
        found = [outcomes[case_name(sweep.name, law, value)].metrics for value in sweep.values]
        values = [math.nan if metrics is None else value_of(metrics) for metrics in found]
        axes.plot(sweep.values, values, color=colour, marker=mark, ms=4.5, label=LAWS[law])
    if sweep.logarithmic:
        axes.set_xscale('log')
        shown = sweep.values[:: 1 if len(sweep.values) <= 7 else 2]
        axes.set_xticks(shown, [f'{value:g}' for value in shown])
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(sweep.label)


def _dress_ratio(axes: Axes) -> None:
    axes.set_yscale('log')
    axes.set_ylim(0.15, 1.3 * _BROKEN)
    axes.axhline(1.0, color=ALARM, lw=1.2, ls='--')
    ticks = [0.2, 0.5, 1.0, 2.0, 5.0, _BROKEN]
    axes.set_yticks(ticks, [*(f'{tick:g}' for tick in ticks[:-1]), f'{_BROKEN:g}+'])
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel('max $|\\xi_1| / k_c$')


def _dress_learning(axes: Axes) -> None:
    axes.set_yscale('log')
    axes.set_ylim(3e-5, 5.0)
    axes.axhline(0.01, color=MUTED, lw=1.2, ls='--')
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{100 * value:g} %'))
    axes.set_ylabel(r'$\|\hat P - P\| \;/\; \|P\|$')
