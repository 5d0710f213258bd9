# SPDX-License-Identifier: Apache-2.0
"""The runs of the cases on all cores, and their metrics as rows for page, CSV and JSON."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from blf_dsc_controller.analysis.metrics import MOMENTS, Metrics, measure
from blf_dsc_controller.analysis.summary import plain
from blf_dsc_controller.paper.cases import (
    CASES,
    LAWS,
    SIDE_BY_SIDE,
    SWEEPS,
    Case,
    Sweep,
    case_name,
)
from blf_dsc_controller.run import Run
from blf_dsc_controller.simulation.loop import simulate

HEADER = (
    'law',
    'max |xi1| [mrad]',
    'rms xi1 [mrad]',
    'peak torque [N m]',
    'rms torque [N m]',
    'torque rate [N m/s]',
    *(f'error at {moment} s' for moment in MOMENTS),
    'below 1 % from',
    'bound',
)
_MILLI = 1e3
_SWEEPS = {sweep.name: sweep for sweep in SWEEPS}


class CaseResult(NamedTuple):
    """Metrics of a case, and its run where that is kept."""

    metrics: Metrics
    run: Run | None = None


@dataclass(frozen=True)
class Results:
    """Results by the names of the cases."""

    by_case: Mapping[str, CaseResult]

    def metrics(self, name: str) -> Metrics:
        """Metrics of a case."""
        return self.by_case[name].metrics

    def run(self, name: str) -> Run:
        """Run of a case, kept for those that are no part of a sweep."""
        run = self.by_case[name].run
        assert run is not None, name  # noqa: S101
        return run

    def held(self, sweep: str, law: str) -> list[float]:
        """Values of a sweep at which the law keeps its bound."""
        values = _SWEEPS[sweep].values
        return [value for value in values if self.metrics(case_name(sweep, law, value)).held]


def run_case(case: Case) -> CaseResult:
    """Simulate a case."""
    loop = case.loop()
    with np.errstate(all='ignore'):  # a run that diverges has metrics too
        run = simulate(loop.controller, loop.plant).run()
        return CaseResult(measure(run), run if case.keep_run else None)


def run_all() -> Results:
    """Simulate every case on all cores.

    The first one runs in this process: it compiles the kernels, which the workers then load.
    """
    first, *rest = CASES
    with ProcessPoolExecutor() as pool, tqdm(total=len(CASES), desc='runs', unit='run') as bar:
        results = {first.name: run_case(first)}
        bar.update()
        for case, result in zip(rest, pool.map(run_case, rest), strict=True):
            results[case.name] = result
            bar.update()
    return Results(results)


def side_by_side(results: Results) -> list[list[str]]:
    """A row for each law; two joints are written as one / other."""
    return [[case.label, *_cells(results.metrics(case.name))] for case in SIDE_BY_SIDE]


def _cells(metrics: Metrics) -> list[str]:
    settled, violated = metrics.time_to_1_percent, metrics.first_violation
    return [
        _pair(metrics.max_error, _MILLI, 3),
        _pair(metrics.rms_error, _MILLI, 4),
        _pair(metrics.peak_torque, 1.0, 2),
        _pair(metrics.rms_torque, 1.0, 2),
        _pair(metrics.torque_rate, 1.0, 1),
        *(f'{100 * error:.2g} %' for error in metrics.parameter_error.values()),
        'never' if math.isnan(settled) else f'{settled:.2f} s',
        'kept' if metrics.held else f'left at {violated:.3f} s',
    ]


def _pair(values: Iterable[float], factor: float, decimals: int) -> str:
    return ' / '.join(f'{factor * value:.{decimals}f}' for value in values)


def kept_bounds(results: Results) -> tuple[list[str], list[list[str]]]:
    """Header and rows: at which values of each condition each law has kept its bound."""
    rows = [[sweep.label, *(_kept(results, sweep, law) for law in LAWS)] for sweep in SWEEPS]
    return ['bound kept at', *LAWS.values()], rows


def _kept(results: Results, sweep: Sweep, law: str) -> str:
    if law not in sweep.laws:
        return '-'
    held = results.held(sweep.name, law)
    if len(held) == len(sweep.values):
        return 'all'
    return ', '.join(f'{value:g}' for value in held) or 'none'


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write rows below a header."""
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def write_tables(results: Results, folder: Path) -> None:
    """Write side_by_side.csv, robustness.csv and metrics.json."""
    write_csv(folder / 'side_by_side.csv', HEADER, side_by_side(results))
    rows: list[list[object]] = []
    for sweep in SWEEPS:
        for law in sweep.laws:
            for value in sweep.values:
                metrics = results.metrics(case_name(sweep.name, law, value))
                numbers = [value, metrics.max_error_ratio, metrics.tail_parameter_error]
                rows.append([sweep.label, law, *numbers, 'kept' if metrics.held else 'left'])
    header = ('condition', 'law', 'value', 'max |xi1| / k_c', 'parameter error', 'bound')
    write_csv(folder / 'robustness.csv', header, rows)
    metrics_of = {name: plain(asdict(one.metrics)) for name, one in sorted(results.by_case.items())}
    text = json.dumps(metrics_of, indent=1) + '\n'
    (folder / 'metrics.json').write_text(text, encoding='utf-8')
