# SPDX-License-Identifier: Apache-2.0
"""The paper's Fig. 2 and 3 with two laws each, and small multiples of the sweeps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from blf_dsc_controller.analysis.figures import draw_panels
from blf_dsc_controller.analysis.metrics import Metrics
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.analysis.style import ALARM, COLOURS, MUTED, Picture
from blf_dsc_controller.paper.cases import LAWS, SWEEPS, case_name
from blf_dsc_controller.paper.results import Results

_PAIRS = (  # name, caption, labels and cases
    (
        'tuned',
        'both laws tuned by the same procedure',
        {'proposed': 'paper_tuned', 'comparison': 'comparison'},
    ),
    (
        'low_gains',
        "the paper's choices against a comparison with low gains",
        {'proposed': 'paper', 'comparison': 'comparison_detuned'},
    ),
    (
        'recommended',
        'the recommended form against the tuned comparison',
        {'recommended': 'recommended', 'comparison': 'comparison'},
    ),
)
_TRACKING = (6.4, 2.5)  # inches
_ESTIMATES = (8.6, 2.4)
_PANEL = (4.6, 2.9)
_COLUMNS = 3
_UNTIL = 10.0  # s, end of Fig. 2
_BROKEN = 10.0  # multiple of the bound at which all larger ratios are drawn
_MARKS = 'os^D'


def draw_pairs(results: Results, folder: Path) -> Iterator[tuple[Path, str]]:
    """Draw Fig. 2 and 3 of each pair of laws; yield their paths and captions."""
    for name, caption, pair in _PAIRS:
        runs = [replace(results.runs[case], torque_limit=None) for case in pair.values()]
        shown = panels(runs)
        linear = [panel for panel in shown if not panel.log]
        tracking = [
            replace(panel, title=f'({letter}) {panel.title}')
            for letter, panel in zip('abcdef', linear, strict=False)
        ]
        estimates = [panel for panel in shown if panel.group == 'Parameters' and not panel.log]
        for number, drawn, columns, size, until, note in (
            (2, tracking, 2, _TRACKING, _UNTIL, '. Shaded: within the bound'),
            (3, estimates, 1, _ESTIMATES, math.inf, ''),
        ):
            path = folder / f'figure_{number}_{name}.png'
            title = f'Fig. {number}, {caption}'
            draw_panels(path, title, drawn, columns, size, list(pair), until)
            yield path, f'Fig. {number}: {caption}{note}.'


def draw_robustness(results: Results, folder: Path) -> list[Path]:
    """Draw the largest error and the parameter error of every sweep; return both paths."""
    tracking, learning = folder / 'robustness_tracking.png', folder / 'robustness_learning.png'
    title = 'Largest error, in units of the bound: above the red line it is violated'
    _draw_sweeps(title, results, lambda one: min(one.max_error_ratio, _BROKEN), _ratio, tracking)
    title = 'Parameter error over the last ten of 30 s'
    _draw_sweeps(title, results, lambda one: one.tail_parameter_error, _learning, learning)
    return [tracking, learning]


def _draw_sweeps(
    title: str,
    results: Results,
    value_of: Callable[[Metrics], float],
    dress: Callable[[Axes], None],
    path: Path,
) -> None:
    picture = Picture(-(-len(SWEEPS) // _COLUMNS), _COLUMNS, title, _PANEL, share_time=False)
    for sweep, axes in zip(SWEEPS, picture.axes.flat, strict=False):
        for law, colour, mark in zip(LAWS, COLOURS, _MARKS, strict=False):
            if law in sweep.laws:
                names = [case_name(sweep.name, law, value) for value in sweep.values]
                values = [value_of(results.metrics[name]) for name in names]
                axes.plot(sweep.values, values, color=colour, marker=mark, ms=4.5, label=LAWS[law])
        if sweep.logarithmic:
            axes.set_xscale('log')
            shown = sweep.values[:: 1 if len(sweep.values) <= 7 else 2]
            axes.set_xticks(shown, [f'{value:g}' for value in shown])
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(sweep.label)
        axes.set_yscale('log')
        dress(axes)
    picture.axes.flat[0].legend(frameon=False, fontsize=9, loc='best')
    picture.save(path)


def _ratio(axes: Axes) -> None:
    axes.set_ylim(0.15, 1.3 * _BROKEN)
    axes.axhline(1.0, color=ALARM, lw=1.2, ls='--')
    ticks = [0.2, 0.5, 1.0, 2.0, 5.0, _BROKEN]
    axes.set_yticks(ticks, [*(f'{tick:g}' for tick in ticks[:-1]), f'{_BROKEN:g}+'])
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel('max $|\\xi_1| / k_c$')


def _learning(axes: Axes) -> None:
    axes.set_ylim(3e-5, 5.0)
    axes.axhline(0.01, color=MUTED, lw=1.2, ls='--')
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{100 * value:g} %'))
    axes.set_ylabel(r'$\|\hat P - P\| \;/\; \|P\|$')
