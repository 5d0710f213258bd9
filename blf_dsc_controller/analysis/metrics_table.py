# SPDX-License-Identifier: Apache-2.0
"""Metrics of a run for the terminal: a table of the joints, and sentences below it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from blf_dsc_controller.analysis.metrics import Metrics
from blf_dsc_controller.analysis.output import aligned
from blf_dsc_controller.messages.named_values import load_text
from blf_dsc_controller.messages.topics import LOAD

_SHOWN_CONTACTS = 3
_OFTEN = 0.01  # of the samples
_TITLE = 12  # characters
_TABLE = {  # title: metric, unit, factor, decimals
    'max |xi1|': ('max_error', 'mrad', 1e3, 3),
    'rms xi1': ('rms_error', 'mrad', 1e3, 3),
    'bound': ('bound', 'mrad', 1e3, 3),
    'peak torque': ('peak_torque', 'N m', 1.0, 2),
    'rms torque': ('rms_torque', 'N m', 1.0, 2),
    'limit': ('torque_limit', 'N m', 1.0, 2),
}


def format_table(metrics: Metrics) -> str:
    """Format metrics as a few lines for the terminal, without a newline at the end."""
    lines = (f'{title:{_TITLE}}{text}' for title, text in sentences(metrics))
    return '\n'.join([aligned(rows(metrics)), '', *lines])


def rows(metrics: Metrics) -> list[list[str]]:
    """Return the table of the joints, with its heading."""
    found = [['', *_TABLE]]
    for i, joint in enumerate(metrics.joints):
        units = metrics.units(joint)
        values = ((getattr(metrics, name)[i], *form) for name, *form in _TABLE.values())
        cells = (
            f'{factor * value:.{decimals}f} {units.of(unit)}'
            if math.isfinite(value)
            else '-'
            for value, unit, factor, decimals in values
        )
        found.append([joint, *cells])
    return found


def sentences(of: Metrics) -> Iterator[tuple[str, str]]:
    """Yield a title and a sentence for each of what was measured."""
    yield 'run', f'{of.duration:.3f} s, {of.samples} samples'
    yield 'bound', _bound_text(of)
    bounds = zip(of.joints, of.widest_bound, of.bound, strict=True)
    wider = [
        f'{joint} {1e3 * widest:.3g} {of.units(joint).of("mrad")}'
        for joint, widest, bound in bounds
        if widest > bound
    ]
    if wider:
        yield 'at widest', ', '.join(wider)
    if of.tool is not None:
        yield 'tool', tool_text(of.tool)
    for stop in of.stops:
        yield 'stopped', f'at {stop["time"]:.3f} s, {stop["reason"]}: {stop["text"]}'
    if of.contacts is not None:
        yield 'contacts', contacts_text(of)
    if of.estimate is not None:
        yield from _learning_lines(of)
    for load in of.loads:
        yield (
            'held',
            f'{load_text([load[name] for name in LOAD])}, until {load["until"]:.1f} s',
        )
    if of.timing is not None:
        yield 'real time', _timing_text(of.timing, of.samples)


def _bound_text(of: Metrics) -> str:
    """Return whether the bound was held, or which joint left it and when."""
    kept = 'unknown' if of.held is None else 'held by every joint'
    if not math.isnan(of.first_violation):
        kept = f'VIOLATED, first by {of.violating_joint} at {of.first_violation:.3f} s'
    if of.left_at_stop:
        kept += ', by the error of the stop; the table ends with the sample before'
    if of.stops and of.held:
        kept += ' until the stop'
    return kept


def _timing_text(timing: Mapping[str, Any], samples: int) -> str:
    """Return `Metrics.timing` in words; `samples` are those of the run."""
    figures = []
    if not math.isnan(timing['rate']):
        figures.append(f'{timing["rate"]:.2f} Hz')
    latency = timing['latency']
    if not math.isnan(latency['max']):
        microseconds = '/'.join(f'{1e6 * each:.1f}' for each in latency.values())
        figures.append(f'state to torque {microseconds} us ({"/".join(latency)})')
    late = timing['late_steps']
    figures.append(f'{late} late steps')
    text = ', '.join(figures)
    if late > _OFTEN * samples:
        text += ': the computer was too busy for real time (--mode lockstep waits)'
    return text


def tool_text(tool: Mapping[str, float]) -> str:
    """Return `Metrics.tool` in words."""
    mm = f'at most {1e3 * tool["error"]:.3g} mm off, {1e3 * tool["bound"]:.3g} mm certified there'
    mrad = (
        f'at most {1e3 * tool["angle"]:.3g} mrad turned, '
        f'{1e3 * tool["angle_bound"]:.3g} mrad certified there'
    )
    share = f'{100.0 * tool["ratio"]:.3g} % and {100.0 * tool["angle_ratio"]:.3g} % of the bounds'
    return f'{mm}; {mrad}; at most {share}'


def contacts_text(of: Metrics) -> str:
    """Return `Metrics.contacts` in words."""
    contacts = of.contacts or []
    if not contacts:
        return '0'
    shown = []
    for each in contacts[:_SHOWN_CONTACTS]:
        unit = of.units(each['joint']).torque
        shown.append(
            f'at {each["time"]:.3f} s {each["torque"]:+.3g} {unit} on {each["joint"]} (model error '
            f'and noise: {each["interval"]:.2g} {unit})'
        )
    more = len(contacts) - len(shown)
    if more:
        shown.append(f'{more} more')
    return f'{len(contacts)}: {"; ".join(shown)}'


def _learning_lines(of: Metrics) -> Iterator[tuple[str, str]]:
    """Yield what was learned, and how well where the truth is known."""
    if not of.learns:
        begun = 'not used by this law'
    elif math.isnan(of.latch_time):
        begun = 'never began'
    else:
        begun = f'began at {of.latch_time:.3f} s'
    yield 'learning', begun
    if of.model_changes:
        times = ', '.join(f'{t:.3f} s' for t in of.model_changes)
        yield 'arm', f'changed at {times}: learning restarted'
    if of.rejected_columns:
        columns = ', '.join(of.rejected_columns)
        yield (
            'rejected',
            f'{columns}: this motion cannot distinguish them from the other columns',
        )
    off = of.parameter_error
    if math.isnan(off.end):
        return
    title, what = 'parameters', 'error'
    if off.of_torques:
        title, what = 'model', 'torque error of the learned model'
    shown = [
        f'{t} s {100 * error:.3g} %'
        for t, error in off.at.items()
        if not math.isnan(error)
    ]
    shown.append(f'end {100 * off.end:.3g} %')
    ending = 'not below 1 %'
    if not math.isnan(off.time_to_1_percent):
        ending = f'below 1 % from {off.time_to_1_percent:.3f} s on'
    yield title, f'{what} {", ".join(shown)}; {ending}'
