# SPDX-License-Identifier: Apache-2.0
"""The numbers of the study as rows: for the page, for CSV and for the terminal."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, fields
from pathlib import Path

from blf_dsc_controller.paper.cases import SIDE_BY_SIDE
from blf_dsc_controller.paper.evidence import Claim
from blf_dsc_controller.paper.metrics import MOMENTS, Metrics
from blf_dsc_controller.paper.runs import Outcome
from blf_dsc_controller.paper.sweeps import LAWS, SWEEPS, Sweep, case_name

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


def side_by_side(outcomes: Mapping[str, Outcome]) -> list[list[str]]:
    """A row for each law; two joints are written as one / other."""
    rows = []
    for case in SIDE_BY_SIDE:
        metrics = outcomes[case.name].metrics
        rows.append([case.label, *(_cells(metrics) if metrics else [outcomes[case.name].failure])])
    return rows


def _cells(metrics: Metrics) -> list[str]:
    settled, violated = metrics.time_to_1_percent, metrics.first_violation
    return [
        _pair(metrics.max_error, _MILLI, 3),
        _pair(metrics.rms_error, _MILLI, 4),
        _pair(metrics.peak_torque, 1.0, 2),
        _pair(metrics.rms_torque, 1.0, 2),
        _pair(metrics.torque_rate, 1.0, 1),
        *(f'{100 * metrics.parameter_error[moment]:.2g} %' for moment in MOMENTS),
        'never' if math.isnan(settled) else f'{settled:.2f} s',
        'kept' if metrics.held else f'left at {violated:.3f} s',
    ]


def _pair(values: Iterable[float], factor: float, decimals: int) -> str:
    return ' / '.join(f'{factor * value:.{decimals}f}' for value in values)


def kept_bounds(outcomes: Mapping[str, Outcome]) -> tuple[list[str], list[list[str]]]:
    """Header and rows: at which values of each condition each law has kept its bound."""
    rows = [
        [sweep.label, *(_kept(outcomes, sweep, law) if law in sweep.laws else '-' for law in LAWS)]
        for sweep in SWEEPS
    ]
    return ['bound kept at', *LAWS.values()], rows


def _kept(outcomes: Mapping[str, Outcome], sweep: Sweep, law: str) -> str:
    held = []
    for value in sweep.values:
        metrics = outcomes[case_name(sweep.name, law, value)].metrics
        if metrics is not None and metrics.held:
            held.append(value)
    if len(held) == len(sweep.values):
        return 'all'
    return ', '.join(f'{value:g}' for value in held) or 'none'


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write rows below a header."""
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def write_tables(outcomes: Mapping[str, Outcome], found: Sequence[Claim], folder: Path) -> None:
    """side_by_side.csv, claims.csv and robustness.csv."""
    write_csv(folder / 'side_by_side.csv', HEADER, side_by_side(outcomes))
    names = [field.name for field in fields(Claim)]
    write_csv(folder / 'claims.csv', names, (astuple(claim) for claim in found))
    rows = []
    for sweep in SWEEPS:
        for law in sweep.laws:
            for value in sweep.values:
                outcome = outcomes[case_name(sweep.name, law, value)]
                if outcome.metrics is None:
                    rows.append([sweep.label, law, value, '', '', outcome.failure])
                    continue
                metrics = outcome.metrics
                rows.append(
                    [
                        sweep.label,
                        law,
                        value,
                        metrics.largest_ratio,
                        metrics.tail_error,
                        'kept' if metrics.held else 'left',
                    ]
                )
    header = ('condition', 'law', 'value', 'max |xi1| / k_c', 'parameter error', 'bound')
    write_csv(folder / 'robustness.csv', header, rows)
