# SPDX-License-Identifier: Apache-2.0
"""Summary of a run: metrics and timing as JSON (summary.json), and as a table for the terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.metrics import (
    Estimates,
    Metrics,
    change_times,
    estimates_of,
    measure,
    rejected_columns,
)
from blf_dsc_controller.law.telemetry import load_text
from blf_dsc_controller.messages.topics import COMPUTE_TIME, LATE_STEPS, LATENCY, LOAD
from blf_dsc_controller.run import Floats, Run, Series

Summary = dict[str, Any]

_PERCENTILES = {'p50': 50.0, 'p99': 99.0, 'p99.9': 99.9, 'max': 100.0}
_MICROSECONDS = 1e6
_JOINT = {  # entry of the summary: metric; title, unit, factor and decimals in the table
    'max_abs_error_rad': ('max_error', 'max |xi1|', 'mrad', 1e3, 3),
    'rms_error_rad': ('rms_error', 'rms xi1', 'mrad', 1e3, 3),
    'bound_rad': ('bound', 'bound', 'mrad', 1e3, 3),
    'peak_torque_nm': ('peak_torque', 'peak torque', 'N m', 1.0, 2),
    'rms_torque_nm': ('rms_torque', 'rms torque', 'N m', 1.0, 2),
    'torque_limit_nm': ('torque_limit', 'limit', 'N m', 1.0, 2),
}

_OFTEN = 0.01  # of the samples
_WIDEST = 'widest_bound_rad'
_WIDTH = 40  # characters of the names, where those of model and plant differ
_MEASURED = {  # comparison with the truth: entry of the summary, its line of the table
    'relative_error': 'parameters  error',
    'torque_error': 'model       torque error of the learned model',
}


def summarize(run: Run) -> Summary:
    """Return the summary of a run as plain data for JSON; units are part of the names.

    Values that are unknown or were not reached are None.
    """
    metrics = measure(run)
    estimates = estimates_of(run)
    entries = {entry: metric for entry, (metric, *_) in _JOINT.items()}
    entries[_WIDEST] = 'widest_bound'
    violated = {'time_s': metrics.first_violation, 'joint': metrics.violating_joint}
    return {
        'duration_s': run.duration,
        'samples': int(run.stamp.size),
        'tracking': {
            'held': metrics.held,
            'first_violation': None if math.isnan(metrics.first_violation) else violated,
            'stops': [
                {'time_s': time, 'stamp_ns': stop.stamp, 'reason': stop.reason, 'text': stop.text}
                for time, stop in run.timed_stops
            ],
            'joints': {
                joint: {entry: plain(getattr(metrics, name)[i]) for entry, name in entries.items()}
                for i, joint in enumerate(run.joints)
            },
        },
        'learning': None if estimates is None else _learning(run, estimates, metrics),
        'loads': _loads(run),
        'timing': _timing(run),
        'compute_time_us': _percentiles(run.monitor, COMPUTE_TIME),
        'messages': dict(run.message_counts),
    }


def write_summary(summary: Summary, path: Path) -> None:
    """Write a summary as JSON."""
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + '\n', encoding='utf-8')


def plain(value: Any) -> Any:
    """Convert to data for JSON: lists and dictionaries, None instead of NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _learning(run: Run, estimates: Estimates, metrics: Metrics) -> Summary:
    reached = {t: error for t, error in metrics.parameter_error.items() if not math.isnan(error)}
    measured = 'torque_error' if estimates.of_torques else 'relative_error'
    learning: Summary = plain(
        {
            'used': run.learns,
            'latch_time_s': metrics.latch_time,
            'model_changes_s': change_times(run),
            f'{measured}_at_s': None if estimates.relative_error is None else reached,
            f'final_{measured}': metrics.final_parameter_error,
            'time_to_1_percent_s': metrics.time_to_1_percent,
            'final_estimate': _named(estimates, estimates.estimate),
            'rejected_columns': rejected_columns(run),
            'true': None if estimates.true is None else _named(estimates, estimates.true),
            'true_parameters_of_other_names': list(estimates.unlike),
        }
    )
    return learning


def _loads(run: Run) -> list[Summary]:
    """Return what the tip held, each at the end of a time in which it was known."""
    if run.monitor is None or LOAD[0] not in run.monitor.names:
        return []
    values = run.monitor.select(LOAD)
    known = np.append(np.isfinite(values[:, 0]), False)
    ends = np.flatnonzero(known[:-1] & ~known[1:])
    times = run.time_of(run.monitor.stamp[ends])
    return [
        {'until_s': float(t), **plain(dict(zip(LOAD, load.tolist(), strict=True)))}
        for t, load in zip(times, values[ends], strict=True)
    ]


def _named(estimates: Estimates, values: Floats) -> dict[str, float]:
    return dict(zip(estimates.names, values[-1].tolist(), strict=True))


def _timing(run: Run) -> Summary | None:
    """Return the sample rate and the latency of the torques of a run in real time."""
    if run.timing is None or LATENCY not in run.timing.names:
        return None
    moving = run.received[1:]  # the first state waits, with brakes on, for the controller
    elapsed = float(moving[-1] - moving[0]) * 1e-9 if moving.size else 0.0
    late = run.timing.column(LATE_STEPS)[-1] if LATE_STEPS in run.timing.names else None
    return {
        'rate_hz': (moving.size - 1) / elapsed if elapsed > 0 else None,
        'latency_us': _percentiles(run.timing, LATENCY),
        'late_steps': None if late is None else int(late),
    }


def _percentiles(series: Series | None, name: str) -> Summary | None:
    if series is None or name not in series.names:
        return None
    known = _MICROSECONDS * series.column(name)
    known = known[np.isfinite(known)]
    if known.size == 0:
        return None
    return {name: float(np.percentile(known, q)) for name, q in _PERCENTILES.items()}


def format_table(summary: Summary) -> str:
    """Format a summary as a few lines for the terminal, without a newline at the end."""
    rows = [['', *(title for _, title, *_ in _JOINT.values())]]
    for name, joint in summary['tracking']['joints'].items():
        cells = (
            '-' if joint[entry] is None else f'{factor * joint[entry]:.{decimals}f} {unit}'
            for entry, (_, _, unit, factor, decimals) in _JOINT.items()
        )
        rows.append([name, *cells])
    return '\n'.join([aligned(rows), '', *_sentences(summary)])


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return a table for the terminal: the first column flush left, the others flush right."""
    first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    return '\n'.join(
        '  '.join([name.ljust(first), *map(str.rjust, values, widths)]) for name, *values in rows
    )


def _sentences(summary: Summary) -> Iterator[str]:
    yield f'run         {summary["duration_s"]:.3f} s, {summary["samples"]} samples'
    held, first = summary['tracking']['held'], summary['tracking']['first_violation']
    if first is not None:
        kept = f'VIOLATED, first by {first["joint"]} at {first["time_s"]:.3f} s'
    else:
        kept = 'unknown' if held is None else 'held by every joint'
    stops = summary['tracking']['stops']
    if stops and held:
        kept += ' until the stop'
    yield f'bound       {kept}'
    wider = [
        f'{name} {1e3 * joint[_WIDEST]:.3g} mrad'
        for name, joint in summary['tracking']['joints'].items()
        if joint[_WIDEST] is not None and joint[_WIDEST] > joint['bound_rad']
    ]
    if wider:
        yield f'at widest   {", ".join(wider)}'
    for stop in stops:
        yield f'stopped     at {stop["time_s"]:.3f} s, {stop["reason"]}: {stop["text"]}'
    if summary['learning'] is not None:
        yield from _learning_lines(summary['learning'])
    for load in summary['loads']:
        values = [math.nan if load[name] is None else load[name] for name in LOAD]
        yield f'held        {load_text(values)}, until {load["until_s"]:.1f} s'
    if summary['timing'] is not None:
        rate, latency, late = summary['timing'].values()
        figures = [
            *([] if rate is None else [f'{rate:.2f} Hz']),
            *([] if latency is None else [f'state to torque {_microseconds(latency)}']),
            *([] if late is None else [f'{late} late steps']),
        ]
        is_slow = (late or 0) > _OFTEN * summary['samples']
        busy = ': the computer was too busy for real time (--mode lockstep waits)' * is_slow
        yield f'real time   {", ".join(figures)}{busy}'
    if summary['compute_time_us'] is not None:
        times = _microseconds(summary['compute_time_us'])
        yield f'law         {times} of the longest update between two messages'


def _learning_lines(learning: Summary) -> Iterator[str]:
    latched = learning['latch_time_s']
    begun = 'never began' if latched is None else f'began at {latched:.3f} s'
    yield f'learning    {begun if learning["used"] else "not used by this law"}'
    if learning['model_changes_s']:
        times = ', '.join(f'{t:.3f} s' for t in learning['model_changes_s'])
        yield f'arm         changed at {times}: learning restarted'
    if learning['rejected_columns']:
        columns = ', '.join(learning['rejected_columns'])
        yield f'rejected    {columns}: the motion does not tell them from the other columns'
    unlike = learning['true_parameters_of_other_names']
    if unlike:
        model, plant = (
            shorten(', '.join(names), _WIDTH, placeholder=' ...')
            for names in (learning['final_estimate'], unlike)
        )
        yield (
            f'parameters  not comparable: the model has {model}, the plant {plant}; do gravity and '
            'joints agree?'
        )
    settled = learning['time_to_1_percent_s']
    ending = 'not below 1 %' if settled is None else f'below 1 % from {settled:.3f} s on'
    for measured, title in _MEASURED.items():
        end = learning.get(f'final_{measured}')
        if end is not None:
            moments = [f'{t} s {_percent(e)}' for t, e in learning[f'{measured}_at_s'].items()]
            yield f'{title} {", ".join([*moments, f"end {_percent(end)}"])}; {ending}'


def _microseconds(values: Summary) -> str:
    figures = '/'.join(f'{value:.1f}' for value in values.values())
    return f'{figures} us ({"/".join(values)})'


def _percent(value: float) -> str:
    return f'{100 * value:.3g} %'
