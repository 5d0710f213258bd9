# SPDX-License-Identifier: Apache-2.0
"""Bags with their events, and the HTML page of one or several.

The page embeds plotly, 4.8 MB.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from blf_dsc_controller.analysis.event_times import change_times, latch_time, outside
from blf_dsc_controller.analysis.metrics import measure
from blf_dsc_controller.analysis.metrics_table import rows, sentences
from blf_dsc_controller.analysis.panels import COLOURS, INK, PIECES, Panel, panels
from blf_dsc_controller.analysis.recorded import recorded_run
from blf_dsc_controller.analysis.verdict import figures_of, verdict_of
from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.extras import import_extra
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.topics import DIAGNOSTICS
from blf_dsc_controller.run import Floats, Run
from blf_dsc_controller.writing import write_text

_DIGITS = 7
_ALARMING = ('violation', 'stop', 'contact', 'oscillation', 'ERROR', 'lost')
_MOST_OF_A_KIND = 50
_LONGEST = 1000  # characters of a parameter that is shown in full
_AT_LIMIT = 1.0 - 1e-9

_TEMPLATES = Environment(
    loader=PackageLoader('blf_dsc_controller'),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.policies['json.dumps_kwargs'] = {
    'allow_nan': False,
    'separators': (',', ':'),
}
_TEMPLATES.filters['anchor'] = lambda title: title.lower().replace(' ', '-')
_TEMPLATES.filters['embedded'] = lambda png: (
    f'data:image/png;base64,{base64.b64encode(png.read_bytes()).decode("ascii")}'
)

LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
"""Levels of /diagnostics."""

TimedEvent = tuple[float, str, str]
"""An event: s since the first sample, kind, text."""


@dataclass(frozen=True)
class ReportedBag:
    """A bag with its name on the page."""

    name: str
    run: Run
    content: Content
    parameters: dict[str, str]  # `node name: parameter` to its value as text
    events: list[TimedEvent]  # by time


def read_bag(path: Path, namespace: str = '', names: NameMap = NO_NAMES) -> ReportedBag:
    """Read a bag, named by its folder and the folder above.

    Raises BlfDscError if it cannot.
    """
    content = read_content(path, namespace, names)
    run = recorded_run(content)
    events = [
        *((0.0, 'left out', note) for note in run.notes),
        *_events(run),
        *_diagnosed(content, run),
        *_changed(content, run),
        *((0.0, 'lost', f'{topic}: {text}') for topic, text in content.losses.items()),
    ]
    parameters = {
        f'{node}: {parameter}': _shown(value)
        for node, values in sorted(content.configurations.items())
        for parameter, value in sorted(values.items())
    }
    name = '/'.join(path.resolve().parts[-2:])
    return ReportedBag(
        name, run, content, parameters, sorted(events, key=itemgetter(0))
    )


def _events(run: Run) -> Iterator[TimedEvent]:
    latched = latch_time(run)
    if not math.isnan(latched):
        yield (latched, 'learning', 'first excited window: learning began')
    for t in change_times(run):
        yield (t, 'learning', 'the arm has changed: learning restarted')
    for t, stop in run.timed_stops:
        yield (t, 'stop', f'{stop.reason}: {stop.text}')
    for t, contact in run.timed_contacts:
        yield (t, 'contact', contact.text)
    for t, oscillation in run.timed_oscillations:
        yield (t, 'oscillation', oscillation.text)
    for i, joint in enumerate(run.joints):
        violated = outside(run, i)
        if violated is not None:
            yield from _intervals(
                run, violated, 'violation', joint, 'outside its bound'
            )
        torque = run.column('torque', i)
        limit = run.column('torque_limit', i)
        if torque is not None and limit is not None:
            limited = np.abs(torque) >= _AT_LIMIT * limit
            yield from _intervals(
                run, limited, 'saturation', joint, 'at its torque limit'
            )


def _intervals(
    run: Run, holds: np.ndarray, kind: str, joint: str, what: str
) -> Iterator[TimedEvent]:
    edges = np.flatnonzero(np.diff(holds, prepend=False, append=False))
    begins, ends = edges[::2], edges[1::2]
    times = run.time_of(run.stamp[begins])
    for time, begin, end in list(zip(times, begins, ends, strict=True))[
        :_MOST_OF_A_KIND
    ]:
        yield (float(time), kind, f'{joint} {what} for {end - begin} samples')
    if begins.size > _MOST_OF_A_KIND:
        text = f'{joint}: {begins.size - _MOST_OF_A_KIND} more intervals, not listed'
        yield (float(times[_MOST_OF_A_KIND]), kind, text)


def _diagnosed(content: Content, run: Run) -> Iterator[TimedEvent]:
    """Yield each change of a level or message, at the time of the last sample.

    Of those before the first one only errors count: every run waits before it begins.
    """
    shown: dict[str, tuple[int, str]] = {}
    messages = content.topics.get(DIAGNOSTICS)
    for received, raw in messages.raw() if messages else ():
        message: Any = typestore().deserialize_cdr(raw, DIAGNOSTICS.type)
        k = int(np.searchsorted(run.received, received)) - 1
        time = float(run.time[max(k, 0)])
        for status in message.status:
            now = (int(status.level), str(status.message))
            level = LEVELS[min(now[0], len(LEVELS) - 1)]
            if shown.get(status.name) != now and (k >= 0 or level == 'ERROR'):
                shown[status.name] = now
                yield (time, level, f'{status.name}: {now[1]}')


def _changed(content: Content, run: Run) -> Iterator[TimedEvent]:
    """Yield each change of the simulated plant's parameters during the run."""
    for change in content.changes:
        time = (change.stamp - int(run.stamp[0])) * 1e-9
        for parameter, value in () if change.configured else change.parameters.items():
            yield (time, 'plant', f'{parameter}: {_shown(value)}')


def _shown(value: object) -> str:
    text = f'{value}'
    if len(text) > _LONGEST:  # a URDF
        text = f'{text[:40]} ... ({len(text)} characters, CRC {zlib.crc32(text.encode()):08x})'
    return text


def write_report(bags: Sequence[ReportedBag], path: Path) -> None:
    """Write the page of some bags; raises MissingExtraError without plotly."""
    plotly = import_extra('plotly.offline', 'report', 'the page')
    write_page(
        path,
        'report.html',
        ' and '.join(bag.name for bag in bags),
        names=[bag.name for bag in bags],
        versions=sorted({bag.content.version or 'unknown' for bag in bags}),
        summaries=[_summary_of(bag) for bag in bags],
        data={
            'panels': plots(panels([bag.run for bag in bags]), bags),
            'seconds': max(bag.run.duration for bag in bags),
        },
        pieces=PIECES,
        plotly=plotly.get_plotlyjs(),
        colours=[_colour(k) for k in range(len(bags))],
        events=_events_by_time(bags),
        alarming=_ALARMING,
        parameters=_parameter_rows(bags),
    )


def _summary_of(bag: ReportedBag) -> tuple[Any, ...]:
    """Return verdict, figures, rows of the table and sentences about a run."""
    metrics = measure(bag.run)
    return (
        verdict_of(metrics),
        figures_of(metrics),
        rows(metrics),
        [*sentences(metrics)],
    )


def _events_by_time(
    bags: Sequence[ReportedBag],
) -> list[tuple[float, int, str, str]]:
    """Return time [s], number of the bag, kind and text of all events, by time."""
    events = []
    for k, bag in enumerate(bags):
        events += [(time, k, kind, text) for time, kind, text in bag.events]
    return sorted(events, key=itemgetter(0, 1))  # those of one time stay in order


def _parameter_rows(
    bags: Sequence[ReportedBag],
) -> list[tuple[str, list[str], bool]]:
    """Return name, value in each bag, and whether these differ, of each parameter."""
    names: dict[str, None] = {}  # a set in order
    for bag in bags:
        names |= dict.fromkeys(bag.parameters)
    table = []
    for name in names:
        values = [bag.parameters.get(name, 'not recorded') for bag in bags]
        table.append((name, values, len(set(values)) > 1))
    return table


def plots(shown: Sequence[Panel], bags: Sequence[ReportedBag]) -> list[dict[str, Any]]:
    """Return panels as data for plotly."""
    prefixes = [f'{bag.name}: ' for bag in bags] if len(bags) > 1 else []
    return [
        {
            'group': panel.group,
            'title': panel.title,
            'unit': panel.unit,
            'traces': list(_traces(panel, prefixes)),
            'log': panel.log,
            'marks': [
                (mark.time, mark.text, mark.colour or _colour(mark.run), mark.until)
                for mark in panel.marks
            ],
        }
        for panel in shown
    ]


def _traces(panel: Panel, prefixes: Sequence[str]) -> Iterator[dict[str, Any]]:
    drawn, named = 0, set()
    for line in panel.lines:
        is_known = bool(line.colour) and (line.run > 0 or line.name in named)
        named.add(line.name)
        shade = line.colour or _colour(line.run if prefixes else drawn)
        drawn += not line.colour
        if prefixes and shade == INK:
            shade = _colour(line.run)
        for sign in (1.0, -1.0) if line.mirrored else (1.0,):
            yield {
                'type': 'scatter',
                'name': (prefixes[line.run] if prefixes else '') + line.name,
                'x': _numbers(line.time),
                'y': _numbers(sign * line.values),
                'line': {
                    'width': 1.3,
                    'color': shade,
                    'dash': 'dash' if line.dashed else 'solid',
                },
                # Lines with a colour of their own look the same in all bags.
                'showlegend': bool(line.name) and sign > 0.0 and not is_known,
            }


def _numbers(values: Floats) -> list[float | None]:
    return [
        float(f'{y:.{_DIGITS}g}') if np.isfinite(y) else None for y in values.tolist()
    ]


def _colour(k: int) -> str:
    """Return the colour of the k-th bag."""
    return COLOURS[k % len(COLOURS)]


def write_page(path: Path, template: str, title: str, **values: object) -> None:
    """Render a template with its variables and write the page."""
    text = _TEMPLATES.get_template(template).render(title=title, **values)
    write_text(path, text)
