# SPDX-License-Identifier: Apache-2.0
"""What the page plots, as plain data for plotly: panels of traces, thinned without losing a peak.

Time panels share their time axis; several bags lie over each other, a colour each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from blf_dsc_controller.analysis.envelope import envelope
from blf_dsc_controller.analysis.estimation import Estimation, latch_time
from blf_dsc_controller.analysis.style import COLOURS, INK, MUTED
from blf_dsc_controller.analysis.subject import Subject
from blf_dsc_controller.messages.names import COMPUTE_TIME, DISTURBANCE, LAMBDA_MIN, LATENCY
from blf_dsc_controller.run import Floats, Run, Series

Trace: TypeAlias = dict[str, Any]
Panel: TypeAlias = dict[str, Any]
Lines: TypeAlias = Callable[[Run], Iterator[Trace]]

_MILLI = 1e3
_MICRO = 1e6
_BINS = 200
_TAIL = 99.9  # percentile up to which a histogram is drawn
_DIGITS = 7


def panels(subjects: Sequence[Subject]) -> list[Panel]:
    """Every panel that some bag has something for.

    Each is a dictionary: group, title, traces, the label of its values, whether it is over time,
    whether its values are drawn on a logarithmic axis, and times to mark.
    """
    found = [*_motion(subjects), *_learning(subjects), *_timing(subjects)]
    return [panel for panel in found if panel['traces']]


def colour(k: int) -> str:
    """Colour of the k-th bag."""
    return COLOURS[k % len(COLOURS)]


def _motion(subjects: Sequence[Subject]) -> Iterator[Panel]:
    joints = list(dict.fromkeys(joint for one in subjects for joint in one.run.joints))
    for group, what, unit, lines in (
        ('Tracking', 'error', 'mrad', _error),
        ('Motion', 'position', 'rad', _position),
        ('Torque', 'torque', 'N m', _torque),
    ):
        for joint in joints:
            yield _over_time(subjects, group, f'{what} of {joint}', unit, partial(lines, joint))


def _error(joint: str, run: Run) -> Iterator[Trace]:
    if run.error is None or joint not in run.joints:
        return
    i = run.joints.index(joint)
    yield _line('error', run.time, _MILLI * run.error[:, i])
    if run.bound is not None:
        yield from _limits('bound', run.time, _MILLI * run.bound[:, i])


def _position(joint: str, run: Run) -> Iterator[Trace]:
    if joint not in run.joints:
        return
    i = run.joints.index(joint)
    yield _line('measured', run.time, run.position[:, i])
    if run.reference is not None:
        yield _line('reference', run.time, run.reference[:, i], dash='dash', colour=INK)


def _torque(joint: str, run: Run) -> Iterator[Trace]:
    if joint not in run.joints or np.isnan(run.torque).all():
        return
    i = run.joints.index(joint)
    yield _line('torque', run.time, run.torque[:, i])
    if run.torque_limit is not None:
        yield from _limits('limit', run.time, run.torque_limit[:, i])


def _learning(subjects: Sequence[Subject]) -> Iterator[Panel]:
    known = [Estimation.of(one.run) for one in subjects]
    names = list(dict.fromkeys(name for one in known if one is not None for name in one.names))
    for name in names:
        yield _over_time(subjects, 'Parameters', name, 'kg m^2', partial(_parameter, name))
    yield _over_time(subjects, 'Parameters', 'relative parameter error', '', _relative, log=True)
    yield _over_time(subjects, 'Excitation', 'least eigenvalue', '', _excitation, log=True)
    told = [one.run.learning for one in subjects]
    columns = [name for one in told if one is not None for name in one.names]
    for name in dict.fromkeys(name for name in columns if name.startswith(DISTURBANCE)):
        yield _over_time(subjects, 'Disturbance', name, 'N m', partial(_disturbance, name))


def _parameter(name: str, run: Run) -> Iterator[Trace]:
    estimation = Estimation.of(run)
    if estimation is None or name not in estimation.names:
        return
    j = estimation.names.index(name)
    yield _line('estimate', estimation.time, estimation.estimate[:, j])
    if estimation.true is not None:
        yield _line('true', estimation.time, estimation.true[:, j], dash='dash', colour=INK)


def _relative(run: Run) -> Iterator[Trace]:
    estimation = Estimation.of(run)
    if estimation is not None and estimation.relative_error is not None:
        yield _line('relative error', estimation.time, estimation.relative_error)


def _excitation(run: Run) -> Iterator[Trace]:
    if run.learning is not None and LAMBDA_MIN in run.learning.names:
        yield _column(run, run.learning, LAMBDA_MIN, 'lambda_min')


def _disturbance(name: str, run: Run) -> Iterator[Trace]:
    if run.learning is not None and name in run.learning.names:
        yield _column(run, run.learning, name, 'estimate')
    if run.truth is not None and name in run.truth.names:
        yield {**_column(run, run.truth, name, 'true'), 'line': {'dash': 'dash', 'color': INK}}


def _timing(subjects: Sequence[Subject]) -> Iterator[Panel]:
    measured = (
        ('period of the joint states, as received', _period),
        ('state to torque', lambda run: _told(run.timing, LATENCY)),
        ('time that the law takes', lambda run: _told(run.learning, COMPUTE_TIME)),
    )
    for title, values_of in measured:
        traces = []
        for k, one in enumerate(subjects):
            values = values_of(one.run)
            known = values[np.isfinite(values)]
            if known.size:
                traces.append({**_histogram(known), **_identity(one, k, subjects, 'samples')})
        yield {
            'group': 'Timing',
            'title': title,
            'unit': 'us',
            'traces': traces,
            'time': False,
            'log': True,
            'marks': [],
        }


def _period(run: Run) -> Floats:
    return np.diff(run.received) * 1e-9


def _told(series: Series | None, name: str) -> Floats:
    return np.empty(0) if series is None or name not in series.names else series.column(name)


def _histogram(values: Floats) -> Trace:
    """Counts of values [s] up to the tail [us]; those beyond it fall into the last bin."""
    end = float(np.percentile(values, _TAIL)) * _MICRO
    counts, edges = np.histogram(np.minimum(values * _MICRO, end), _BINS)
    middle = (edges[1:] + edges[:-1]) / 2
    return {'x': _numbers(middle), 'y': counts.tolist(), 'type': 'bar', 'opacity': 0.7}


def _over_time(
    subjects: Sequence[Subject],
    group: str,
    title: str,
    unit: str,
    lines: Lines,
    *,
    log: bool = False,
) -> Panel:
    traces = []
    for k, one in enumerate(subjects):
        for trace in lines(one.run):
            line = {'width': 1.3, 'color': colour(k), **trace.get('line', {})}
            if len(subjects) > 1 and line['color'] == INK:
                line['color'] = colour(k)
            traces.append({**trace, **_identity(one, k, subjects, trace['name']), 'line': line})
    marks = [(latch_time(one.run), colour(k)) for k, one in enumerate(subjects)]
    learns = group in ('Parameters', 'Excitation', 'Disturbance')
    return {
        'group': group,
        'title': title,
        'unit': unit,
        'traces': traces,
        'time': True,
        'log': log,
        'marks': [mark for mark in marks if mark[0] is not None] if learns else [],
    }


def _identity(one: Subject, k: int, subjects: Sequence[Subject], name: str) -> Trace:
    if len(subjects) == 1:
        return {'name': name, 'marker': {'color': colour(k)}}
    return {'name': f'{one.name}: {name}', 'marker': {'color': colour(k)}}


def _column(run: Run, series: Series, column: str, name: str) -> Trace:
    return _line(name, run.time_of(series.stamp), series.column(column))


def _limits(name: str, time: Floats, values: Floats) -> Iterator[Trace]:
    for sign in (1.0, -1.0):
        line = _line(name, time, sign * values, dash='dash', colour=MUTED)
        yield {**line, 'showlegend': sign > 0}


def _line(name: str, time: Floats, values: Floats, dash: str = 'solid', colour: str = '') -> Trace:
    x, y = _corners(time, values)
    line = {'dash': dash, **({'color': colour} if colour else {})}
    return {'name': name, 'x': _numbers(x), 'y': _numbers(y), 'type': 'scatter', 'line': line}


def _corners(time: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Thin a series; where it is constant for long, its corners say all."""
    changes = np.flatnonzero(np.diff(values) != 0.0)
    if changes.size < values.size // 100:
        kept = np.unique(np.concatenate([[0], changes, changes + 1, [values.size - 1]]))
        return time[kept], values[kept]
    return envelope(time, values)


def _numbers(values: Floats) -> list[float | None]:
    return [float(f'{one:.{_DIGITS}g}') if np.isfinite(one) else None for one in values.tolist()]
