# SPDX-License-Identifier: Apache-2.0
"""The comparison of the paper as a folder of runs, figures, claims and tables, with a page."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path

from blf_dsc_controller.analysis.metrics import MOMENTS
from blf_dsc_controller.analysis.page import Cell, write_page
from blf_dsc_controller.analysis.summary import plain
from blf_dsc_controller.configuration.params_file import dump
from blf_dsc_controller.paper import tune
from blf_dsc_controller.paper.cases import CASES, LAWS, SIDE_BY_SIDE, SWEEPS, Sweep, case_name
from blf_dsc_controller.paper.claims import FAILS, HOLDS, ONLY_IF, Claim, claims
from blf_dsc_controller.paper.figures import draw_pairs, draw_robustness
from blf_dsc_controller.paper.results import Results, run_all
from blf_dsc_controller.supervision.config_warnings import config_warnings

_STYLES = {HOLDS: 'good', ONLY_IF: 'partly', FAILS: 'bad'}


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
    metrics = {name: plain(asdict(one)) for name, one in sorted(results.metrics.items())}
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
