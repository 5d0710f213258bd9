# SPDX-License-Identifier: Apache-2.0
"""The comparison of the paper as a folder of runs, figures, claims and tables, with a page."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from blf_dsc_controller.analysis.figures import draw_panels
from blf_dsc_controller.analysis.metrics import MOMENTS, Metrics
from blf_dsc_controller.analysis.page import Cell, write_page
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.analysis.style import ALARM, COLOURS, MUTED, Picture
from blf_dsc_controller.analysis.summary import plain
from blf_dsc_controller.configuration.nodes import dump
from blf_dsc_controller.studies import tuning as tune
from blf_dsc_controller.studies.paper_cases import (
    CASES,
    LAWS,
    SIDE_BY_SIDE,
    SWEEPS,
    Results,
    Sweep,
    case_name,
    run_all,
)
from blf_dsc_controller.studies.paper_claims import FAILS, HOLDS, ONLY_IF, Claim, claims
from blf_dsc_controller.supervision.config_warnings import config_warnings

_STYLES = {HOLDS: 'good', ONLY_IF: 'partly', FAILS: 'bad'}
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


def compare(folder: Path) -> list[Claim]:
    """Run every case, write the report into an empty folder and return the claims."""
    (folder / 'configurations').mkdir()
    for case in CASES:
        name = case.name.replace(' ', '_')
        dump(folder / 'configurations' / f'{name}.yaml', case.loop().by_node)
    results = run_all()
    found = claims(results)
    laws = list(side_by_side(results))
    _write_csv(folder / 'side_by_side.csv', laws)
    _write_csv(folder / 'claims.csv', [Claim._fields, *found])
    _write_csv(folder / 'robustness.csv', _robustness(results))
    metrics = {name: plain(asdict(metrics)) for name, metrics in sorted(results.metrics.items())}
    text = json.dumps(metrics, indent=1) + '\n'
    (folder / 'metrics.json').write_text(text, encoding='utf-8')
    write_page(
        folder / 'index.html',
        'paper.html',
        'The paper, side by side',
        claims=[
            (*claim[:3], Cell(claim.full_verdict, _STYLES[claim.verdict]), Cell(claim[-1], 'code'))
            for claim in found
        ],
        laws=laws,
        presets=', '.join(f'{case.label}: {case.preset}' for case in SIDE_BY_SIDE),
        warnings=[
            f'{case.label}: {warning}'
            for case in SIDE_BY_SIDE
            for warning in config_warnings(case.loop().controller)
        ],
        tune=tune,
        figures=list(draw_pairs(results, folder)),
        kept=kept_bounds(results),
        robustness=draw_robustness(results, folder),
        runs=len(CASES),
        folder=folder.name,
    )
    return found


def side_by_side(results: Results) -> Iterator[list[str]]:
    """Yield a header and a row for each law; values of the joints are separated by `/`."""
    columns = {  # title: field of the metrics, factor, decimals
        'max |xi1| [mrad]': ('max_error', 1e3, 3),
        'rms xi1 [mrad]': ('rms_error', 1e3, 4),
        'peak torque [N m]': ('peak_torque', 1.0, 2),
        'rms torque [N m]': ('rms_torque', 1.0, 2),
        'torque rate [N m/s]': ('torque_rate', 1.0, 1),
    }
    yield ['law', *columns, *(f'error at {t} s' for t in MOMENTS), 'below 1 % from', 'bound']
    for case in SIDE_BY_SIDE:
        metrics = results.metrics[case.name]
        settled = metrics.time_to_1_percent
        yield [
            case.label,
            *(
                ' / '.join(f'{factor * value:.{decimals}f}' for value in getattr(metrics, name))
                for name, factor, decimals in columns.values()
            ),
            *(f'{100 * error:.2g} %' for error in metrics.parameter_error.values()),
            'never' if math.isnan(settled) else f'{settled:.2f} s',
            'kept' if metrics.held else f'left at {metrics.first_violation:.3f} s',
        ]


def kept_bounds(results: Results) -> list[list[str]]:
    """Return a header and, by condition, the values at which each law kept its bound."""
    rows = [[sweep.label, *(_kept(results, sweep, law) for law in LAWS)] for sweep in SWEEPS]
    return [['bound kept at', *LAWS.values()], *rows]


def _kept(results: Results, sweep: Sweep, law: str) -> str:
    if law not in sweep.laws:
        return '-'
    held = results.held(sweep.name, law)
    if len(held) == len(sweep.values):
        return 'all'
    return ', '.join(f'{value:g}' for value in held) or 'none'


def _robustness(results: Results) -> Iterator[tuple[object, ...]]:
    yield 'condition', 'law', 'value', 'max |xi1| / k_c', 'parameter error', 'bound'
    for sweep in SWEEPS:
        for law in sweep.laws:
            for value in sweep.values:
                metrics = results.metrics[case_name(sweep.name, law, value)]
                numbers = value, metrics.max_error_ratio, metrics.tail_parameter_error
                yield sweep.label, law, *numbers, 'kept' if metrics.held else 'left'


def _write_csv(path: Path, rows: Iterable[Iterable[object]]) -> None:
    with path.open('w', encoding='utf-8', newline='') as file:
        csv.writer(file).writerows(rows)


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
    _draw_sweeps(
        title, results, lambda metrics: min(metrics.max_error_ratio, _BROKEN), _ratio, tracking
    )
    title = 'Parameter error over the last ten of 30 s'
    _draw_sweeps(title, results, lambda metrics: metrics.tail_parameter_error, _learning, learning)
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
