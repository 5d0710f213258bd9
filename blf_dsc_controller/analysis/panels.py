# SPDX-License-Identifier: Apache-2.0
"""The panels of runs, plotted by matplotlib in `figures` and by plotly in `report`.

Long series are thinned, without losing a peak.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from math import inf, isnan
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.analysis.estimates import (
    Estimates,
    bodies_of,
    errors_of_bodies,
    estimates_of,
)
from blf_dsc_controller.analysis.event_times import (
    latch_time,
    outside,
    true_change_times,
)
from blf_dsc_controller.analysis.lyapunov import energies
from blf_dsc_controller.analysis.metrics import rms, tool_errors
from blf_dsc_controller.messages.topics import (
    DISTURBANCE,
    INTERVAL,
    LAMBDA_MIN,
)
from blf_dsc_controller.run import Floats, LearnedArm, Run, Series

BLUE = '#0072B2'
ORANGE = '#D55E00'
GREEN = '#009E73'
COLOURS = (BLUE, ORANGE, GREEN, '#CC79A7', '#E69F00', '#56B4E9', '#7F3C8D', '#000000')
INK = '#22272E'
MUTED = '#6B7280'
SHADE = '#DCE9F5'
ALARM = '#B3001B'

GROUPS = (
    'Motion',
    'Tracking',
    'Torque',
    'Contact',
    'Parameters',
    'Disturbance',
    'Excitation',
    'Monitors',
)
_STOPPED = GROUPS[:4]
_CHANGED = ('Tracking', 'Parameters')
_LEARNING = GROUPS[4:]
_LEAST = 1e-12  # J, the smallest value on a logarithmic axis
_AXIS_MARGIN = 1.2  # limit of an axis as a multiple of the largest value
_LEAST_ERROR = 1e-5  # %
_PIECES = 300  # of a run, each with its largest error
_LARGEST = 1e100

PIECES = 1500
"""Parts of a series of which the lowest and the highest sample are drawn."""


class Line(NamedTuple):
    """A line of a panel, in the colour of its run if `colour` is empty."""

    name: str  # in the legend
    time: Floats  # s
    values: Floats  # NaN: a gap
    colour: str = ''
    dashed: bool = False
    mirrored: bool = False  # drawn with both signs
    shaded: bool = False  # between both signs
    run: int = 0


class Mark(NamedTuple):
    """A vertical line, with the area up to `until` shaded if that is later."""

    time: float
    text: str
    colour: str = ''
    run: int = 0
    until: float = 0.0


@dataclass(frozen=True)
class Panel:
    """Lines over time."""

    group: str
    title: str
    unit: str
    lines: Iterable[Line]  # long ones are made as they are drawn
    note: str = ''  # only if a single run is shown
    log: bool = False
    marks: tuple[Mark, ...] = ()
    # limit of the axis in pictures, in both directions; 0: everything
    span: float = 0.0


@np.errstate(over='ignore', invalid='ignore')  # a bag may hold any number
def panels(runs: Sequence[Run], begin: float = -inf, end: float = inf) -> list[Panel]:
    """Return every panel that a run has data for from `begin` to `end` [s].

    Runs are overlaid.
    """
    found: dict[tuple[str, str], Panel] = {}
    for k, run in enumerate(runs):
        for panel in _panels_of(run):
            marks = tuple(
                mark._replace(run=k)
                for mark in panel.marks
                if begin <= mark.time <= end
            )
            lines = tuple(
                _drawn(line, begin, end)._replace(run=k) for line in panel.lines
            )
            key = panel.group, panel.title
            own = replace(panel, lines=lines, marks=marks)
            found[key] = _overlaid(found[key], own) if key in found else own
    if len(runs) > 1:
        found = {key: replace(panel, note='', span=0.0) for key, panel in found.items()}
    drawn = [panel for panel in found.values() if panel.lines]
    return sorted(drawn, key=lambda panel: GROUPS.index(panel.group))


def _overlaid(before: Panel, panel: Panel) -> Panel:
    """Return a panel with the lines and marks of another one before its own."""
    return replace(
        panel,
        lines=(*before.lines, *panel.lines),
        marks=(*before.marks, *panel.marks),
    )


def _panels_of(run: Run) -> Iterator[Panel]:
    """Yield the panels of a run with all their marks: latch, stops and changes of the arm."""
    latched = latch_time(run)
    latch = () if isnan(latched) else (Mark(latched, 'latch'),)
    stops = tuple(_stops(run))
    changes = true_change_times(run)
    unnamed = set(_CHANGED)  # groups in which no mark says yet what the changes are
    for panel in chain(_motion(run), _contact(run), _learning(run), _monitors(run)):
        marks = latch if panel.group in _LEARNING else panel.marks
        if panel.group in _STOPPED:
            marks = (*marks, *stops)
        if panel.group in _CHANGED:
            text = 'the arm changes' if panel.group in unnamed else ''
            unnamed.discard(panel.group)
            marks = (*marks, *_marks_at(changes, text))
        yield replace(panel, marks=marks)


def _marks_at(times: Sequence[float], text: str) -> Iterator[Mark]:
    """Yield marks at times [s], the first one with a text."""
    for k, time in enumerate(times):
        yield Mark(time, '' if k else text, INK)


def _drawn(line: Line, begin: float, end: float) -> Line:
    """Return what is drawn of a line between two times.

    It is finite, and thinned without losing a peak.
    """
    shown = slice(
        np.searchsorted(line.time, begin), np.searchsorted(line.time, end, side='right')
    )
    time, values = line.time[shown], line.values[shown]
    values = np.where(np.abs(values) < _LARGEST, values, np.nan)
    changes = np.flatnonzero(np.diff(values) != 0.0)
    if changes.size < values.size // 100:  # mostly constant: its corners
        kept = np.unique(np.concatenate([[0], changes, changes + 1, [values.size - 1]]))
        return line._replace(time=time[kept], values=values[kept])
    time, values = envelope(time, values)
    return line._replace(time=time, values=values)


def envelope(
    time: Floats, values: Floats, pieces: int = PIECES
) -> tuple[Floats, Floats]:
    """Return the lowest and highest sample of each piece of a series (N,), by time.

    NaN is unknown; a piece without known values stays a gap. A series of at most two
    samples per piece is returned unchanged.
    """
    if values.size <= 2 * pieces:
        return time, values
    length = -(-values.size // pieces)
    begins = np.arange(0, values.size, length)
    padded = np.append(values, np.full(begins.size * length - values.size, np.nan))
    rows = padded.reshape(-1, length)
    low = begins + np.where(np.isnan(rows), inf, rows).argmin(axis=1)
    high = begins + np.where(np.isnan(rows), -inf, rows).argmax(axis=1)
    kept = np.sort(np.stack([low, high]), axis=0).T.ravel()
    return time[kept], values[kept]


def _stops(run: Run) -> Iterator[Mark]:
    """Yield the safe stops, each until the next start or the end."""
    for time, stop in run.timed_stops:
        until = run.duration
        if stop.until is not None:
            until = (stop.until - int(run.stamp[0])) * 1e-9
        yield Mark(time, f'stop: {stop.reason}', ALARM, until=until)


def _motion(run: Run) -> Iterator[Panel]:
    t = run.time
    for i in range(len(run.joints)):
        yield _position(run, t, i)
        error = run.column('error', i)
        if error is not None:
            yield _error(run, t, i, 1e3 * error)
        yield from _torque(run, t, i)
    if t.size > _PIECES:
        for i in range(len(run.joints)):
            error = run.column('error', i)
            if error is not None:
                yield _error_size(run, t, i, 1e3 * error)
    yield from _tool(run, t)


def _position(run: Run, t: Floats, i: int) -> Panel:
    joint = run.joints[i]
    lines = [Line('measured', t, np.asarray(run.column('position', i)))]
    reference = run.column('reference', i)
    if reference is not None:
        lines.append(Line('reference', t, reference, INK, dashed=True))
    return Panel('Motion', f'position of {joint}', run.units(joint).position, lines)


def _torque(run: Run, t: Floats, i: int) -> Iterator[Panel]:
    """Yield the panel of the torque with its limit, if there is a torque."""
    joint = run.joints[i]
    torque = run.column('torque', i)
    if torque is None or np.isnan(torque).all():
        return
    lines = [Line('torque', t, torque)]
    limit = run.column('torque_limit', i)
    if limit is not None and not np.isnan(limit).all():
        lines.append(Line('limit', t, limit, MUTED, dashed=True, mirrored=True))
    note = f'peak {np.nanmax(np.abs(torque)):.3g}'
    yield Panel('Torque', f'torque of {joint}', run.units(joint).torque, lines, note)


def _tool(run: Run, t: Floats) -> Iterator[Panel]:
    """Yield panels of error and angle at the tool, with certified bounds."""
    values = tool_errors(run)
    if values is None:
        return
    for title, unit, column in (('error', 'mm', 0), ('angle', 'mrad', 2)):
        error = 1e3 * values[:, column]
        bound = 1e3 * values[:, column + 1]
        lines = [
            Line('error', t, error),
            Line('certified bound', t, bound, MUTED, dashed=True),
        ]
        note = '' if np.isnan(error).all() else f'max {np.nanmax(error):.3g}'
        yield Panel('Tracking', f'{title} at the tool', unit, lines, note)


def _contact(run: Run) -> Iterator[Panel]:
    """Yield the external torque on each joint with its interval, and the contacts."""
    if run.external is None:
        return
    t = run.time_of(run.external.stamp)
    marks = tuple(
        Mark(time, f'contact: {contact.joint}', ORANGE)
        for time, contact in run.timed_contacts
    )
    for joint in run.joints:
        torque = run.external.column(joint)
        interval = run.external.column(joint + INTERVAL)
        lines = [
            Line('torque', t, torque),
            Line('model error and noise', t, interval, MUTED, True, True, True),  # noqa: FBT003
        ]
        note = '' if np.isnan(torque).all() else f'peak {np.nanmax(np.abs(torque)):.3g}'
        title = f'external torque on {joint}'
        unit = run.units(joint).torque
        yield Panel('Contact', title, unit, lines, note, marks=marks)


def _error(run: Run, t: Floats, i: int, error: Floats) -> Panel:
    lines = [Line('error', t, error)]
    marks = []
    note = ''
    bound = run.column('bound', i)
    violated = outside(run, i)
    if bound is not None and violated is not None:
        lines.append(Line('bound', t, 1e3 * bound, MUTED, True, True, True))  # noqa: FBT003
        first = t[violated][:1].tolist()
        marks = [Mark(time, f'outside from {time:.3f} s', ALARM) for time in first]
    if not np.isnan(error).all():
        note = f'max {np.nanmax(np.abs(error)):.3g}, rms {rms(error):.3g}'
    title = f'error of {run.joints[i]}'
    span = _span(bound, error)
    unit = run.units(run.joints[i]).of('mrad')
    return Panel('Tracking', title, unit, lines, note, marks=tuple(marks), span=span)


def _span(bound: Floats | None, error: Floats) -> float:
    """Return the axis limit for a funnel, whose wide start would hide the error; else 0."""
    if bound is None or bound[0] <= bound[-1]:
        return 0.0
    known = np.abs(error[np.abs(error) < _LARGEST])
    return float(_AXIS_MARGIN * known.max(initial=1e3 * bound[-1]))


def _error_size(run: Run, t: Floats, i: int, error: Floats) -> Panel:
    """Return the panel of the largest error in each piece of the run, logarithmic."""
    begins = np.linspace(0, error.size, _PIECES, endpoint=False).astype(np.intp)
    size = np.fmax.reduceat(np.abs(error), begins)
    size[size == 0.0] = np.nan
    lines = [Line('error', t[begins], size)]
    bound = run.column('bound', i)
    if bound is not None:
        lines.append(Line('bound', t[begins], 1e3 * bound[begins], MUTED, dashed=True))
    known = size[np.isfinite(size)]
    note = f'end {known[-1]:.2g}' if known.size else ''
    title = f'|error| of {run.joints[i]}'
    span = _span(bound, error)
    unit = run.units(run.joints[i]).of('mrad')
    return Panel('Tracking', title, unit, lines, note, log=True, span=span)


def _learning(run: Run) -> Iterator[Panel]:
    estimates = estimates_of(run)
    if estimates is None or run.monitor is None:
        return
    if estimates.relative_error is not None:
        yield _relative_error(estimates)
    if run.arm is not None:
        yield _of_links(run.arm, estimates)
    elif len(estimates.names) <= len(COLOURS):
        for j, name in enumerate(estimates.names):
            lines = [Line('estimate', estimates.time, estimates.estimate[:, j])]
            if estimates.true is not None:
                lines.append(
                    Line('true', estimates.time, estimates.true[:, j], INK, dashed=True)
                )
            yield Panel('Parameters', name, 'kg m²', lines)
    yield Panel(
        'Disturbance', 'disturbance estimates', 'N m', _disturbances(run, run.monitor)
    )


def _disturbances(run: Run, learning: Series) -> Iterator[Line]:
    for name in learning.names:
        if name.startswith(DISTURBANCE):
            yield from _column(run, learning, name, name.removeprefix(DISTURBANCE))
            if run.arm is None:  # else it includes the learned friction
                yield from _column(
                    run, run.truth, name, 'true', colour=INK, dashed=True
                )


def _of_links(arm: LearnedArm, estimates: Estimates) -> Panel:
    """Return the panel of the errors by link and kind of friction.

    They are in standard deviations of the prior.
    """
    bodies = bodies_of(estimates.names)
    prior = np.array([arm.deviations[name] for name in estimates.names])
    off = errors_of_bodies(bodies, estimates.estimate, estimates.true, prior)
    lines = [
        Line(body, estimates.time, each) for body, each in zip(bodies, off, strict=True)
    ]
    what = 'changes' if estimates.true is None else 'errors'
    return Panel('Parameters', f'{what} of the estimates, by link', '% of prior', lines)


def _relative_error(estimates: Estimates) -> Panel:
    error = np.maximum(100.0 * np.asarray(estimates.relative_error), _LEAST_ERROR)
    limit = Line('1 %', estimates.time, np.ones_like(error), MUTED, dashed=True)
    lines = (Line('relative error', estimates.time, error), limit)
    title = 'torque error' if estimates.of_torques else 'relative parameter error'
    return Panel('Parameters', title, '%', lines, log=True)


def _monitors(run: Run) -> Iterator[Panel]:
    latched = latch_time(run)
    note = (
        'learning never began'
        if isnan(latched)
        else f'learning from {latched:.4g} s on'
    )
    note = note if run.learns else 'not used by this law'
    title = 'minimum eigenvalue of Φ'
    excitation = [
        # 0: no update yet
        line._replace(values=np.where(line.values > 0.0, line.values, np.nan))
        for line in _column(run, run.monitor, LAMBDA_MIN, title)
    ]
    yield Panel('Excitation', title, '', excitation, note, log=True)
    found = energies(run)
    if found is not None:
        yield _lyapunov(run, found)


def _lyapunov(run: Run, energy: Series) -> Panel:
    """Return the panel of V (29) and its terms."""
    time = run.time_of(energy.stamp)
    V = Line('V', time, energy.values.sum(axis=1), INK)
    terms = [
        line
        for term in energy.names
        for line in _column(run, energy, term, term)
        if np.any(line.values > 0.0)
    ]
    lines = [
        line._replace(values=np.maximum(line.values, _LEAST)) for line in (*terms, V)
    ]
    return Panel('Monitors', 'V (29) and its terms', 'J', lines, log=True)


def _column(
    run: Run, series: Series | None, column: str, name: str, **style: Any
) -> list[Line]:
    """Return a column as one line, if there is one."""
    if series is None or column not in series.names:
        return []
    return [Line(name, run.time_of(series.stamp), series.column(column), **style)]
