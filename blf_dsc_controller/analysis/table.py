# SPDX-License-Identifier: Apache-2.0
"""A summary as a short table for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

_COLUMNS = (  # title, entry of the summary, unit, how many units to 1, decimals
    ('max |xi1|', 'max_abs_error_rad', 'mrad', 1e3, 3),
    ('rms xi1', 'rms_error_rad', 'mrad', 1e3, 3),
    ('bound', 'bound_rad', 'mrad', 1e3, 3),
    ('peak torque', 'peak_torque_nm', 'N m', 1.0, 2),
    ('rms torque', 'rms_torque_nm', 'N m', 1.0, 2),
    ('limit', 'torque_limit_nm', 'N m', 1.0, 2),
)
_UNKNOWN = '-'


def format_table(summary: dict[str, Any]) -> str:
    """Text of a few lines, without a newline at the end."""
    lines = [*_joints(summary['tracking']['joints']), '', *_sentences(summary)]
    return '\n'.join(lines)


def _joints(joints: dict[str, Any]) -> Iterator[str]:
    rows = [
        ['', *(title for title, *_ in _COLUMNS)],
        *(
            [
                name,
                *(
                    _number(joint[key], factor, decimals, unit)
                    for _, key, unit, factor, decimals in _COLUMNS
                ),
            ]
            for name, joint in joints.items()
        ),
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        name, *cells = (cell for cell in row)
        padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        yield '  '.join([name.ljust(widths[0]), *padded])


def _sentences(summary: dict[str, Any]) -> Iterator[str]:
    seconds, samples = summary['duration_s'], summary['samples']
    yield f'run         {seconds:.3f} s, {samples} samples'
    yield f'bound       {_verdict(summary["tracking"])}'
    if summary['learning'] is not None:
        yield from _learning(summary['learning'])
    if summary['timing'] is not None:
        yield f'real time   {_real_time(summary["timing"])}'
    if summary['compute_time_us'] is not None:
        yield f'law         {_percentiles(summary["compute_time_us"])}'


def _verdict(tracking: dict[str, Any]) -> str:
    if tracking['held'] is None:
        return 'not told'
    if tracking['held']:
        return 'held by every joint'
    first = tracking['first_violation']
    return f'VIOLATED, first by {first["joint"]} at {first["time_s"]:.3f} s'


def _learning(learning: dict[str, Any]) -> Iterator[str]:
    latched = learning['latch_time_s']
    yield f'learning    {"never began" if latched is None else f"began at {latched:.3f} s"}'
    for column, reason in learning['refused_columns'].items():
        yield f'refused     {reason or f"{column}: see the log for the reason"}'
    if learning['final_relative_error'] is None:
        return
    moments = [f'{moment} s {_percent(e)}' for moment, e in learning['relative_error_at_s'].items()]
    moments.append(f'end {_percent(learning["final_relative_error"])}')
    settled = learning['time_to_1_percent_s']
    ending = 'not below 1 %' if settled is None else f'below 1 % from {settled:.3f} s on'
    yield f'parameters  error {", ".join(moments)}; {ending}'


def _real_time(timing: dict[str, Any]) -> str:
    parts = []
    if timing['rate_hz'] is not None:
        parts.append(f'{timing["rate_hz"]:.2f} Hz')
    if timing['latency_us'] is not None:
        parts.append(f'state to torque {_percentiles(timing["latency_us"])}')
    if timing['late_steps'] is not None:
        parts.append(f'{timing["late_steps"]} late steps')
    return ', '.join(parts)


def _percentiles(values: dict[str, float]) -> str:
    figures = '/'.join(f'{value:.1f}' for value in values.values())
    return f'{figures} us ({"/".join(values)})'


def _percent(value: float) -> str:
    return f'{100 * value:.3g} %'


def _number(value: float | None, factor: float, decimals: int, unit: str) -> str:
    return _UNKNOWN if value is None else f'{factor * value:.{decimals}f} {unit}'
