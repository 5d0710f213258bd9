# SPDX-License-Identifier: Apache-2.0
"""HTML page of one or several bags, with the script of plotly (4.8 MB) embedded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.page import Cell, write_page
from blf_dsc_controller.analysis.panels import Panel, panels
from blf_dsc_controller.analysis.reported_bag import ReportedBag
from blf_dsc_controller.analysis.style import COLOURS, INK
from blf_dsc_controller.analysis.summary import format_table, summarize
from blf_dsc_controller.analysis.thinning import PIECES, thin
from blf_dsc_controller.errors import MissingExtraError
from blf_dsc_controller.run import Floats, Run

_BINS = 200
_TAIL = 99.9  # percentile up to which a histogram is drawn
_DIGITS = 7
_RATE = 50.0  # pictures of the arm per second
_MOST_PICTURES = 6000
_ALARMING = ('violation', 'stop', 'ERROR', 'lost')


def write_report(bags: Sequence[ReportedBag], path: Path) -> None:
    """Write the page of some bags.

    Raises:
        MissingExtraError: plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise MissingExtraError('plotly', 'report', 'the page') from None
    found = panels([bag.run for bag in bags])
    groups = dict.fromkeys(panel.group for panel in found)
    events = sorted(
        (event.time, k, event.kind, event.text)
        for k, bag in enumerate(bags)
        for event in bag.events
    )
    parameters: list[list[str | Cell]] = []
    different = []
    for name in dict.fromkeys(name for bag in bags for name in bag.parameters):
        values = [bag.parameters.get(name, 'not recorded') for bag in bags]
        parameters.append([name, *values])
        if len(set(values)) > 1:
            parameters[-1][0] = Cell(name, 'marked')
            different.append(parameters[-1])
    write_page(
        path,
        'report.html',
        ' and '.join(bag.name for bag in bags),
        names=[bag.name for bag in bags],
        seconds=max(bag.run.duration for bag in bags),
        thinned=max(_period(bag.run) for bag in bags),
        versions=sorted({bag.content.version or 'another recorder' for bag in bags}),
        links=[*groups, 'The arm', 'Events', 'Configuration'],
        summaries=[
            (bag.name, colour(k), format_table(summarize(bag.run))) for k, bag in enumerate(bags)
        ],
        data={'panels': plots(found, bags), 'arms': [arm(bag, k) for k, bag in enumerate(bags)]},
        plotly=get_plotlyjs(),
        events=[
            (
                Cell(f'{time:.3f} s', 'number'),
                Cell(bags[k].name, colour=colour(k)),
                Cell(kind, 'bad' if kind in _ALARMING else ''),
                text,
            )
            for time, k, kind, text in events
        ],
        parameters=parameters,
        different=different,
    )


def plots(shown: Sequence[Panel], bags: Sequence[ReportedBag]) -> list[dict[str, Any]]:
    """Return panels as data for plotly, with traces thinned without losing a peak."""
    prefixes = [f'{bag.name}: ' for bag in bags] if len(bags) > 1 else []
    return [
        {
            'group': panel.group,
            'title': panel.title,
            'unit': panel.unit,
            'traces': list((_histograms if panel.histogram else _traces)(panel, prefixes)),
            'time': not panel.histogram,
            'log': panel.log,
            'marks': [
                (mark.time, mark.text, mark.colour or colour(mark.run), mark.until)
                for mark in panel.marks
            ],
        }
        for panel in shown
    ]


def _period(run: Run) -> float:
    """Return the interval [ms] of which two samples are drawn; 0 if all samples are."""
    return 1e3 * run.duration / PIECES if run.stamp.size > 2 * PIECES else 0.0


def _traces(panel: Panel, prefixes: Sequence[str]) -> Iterator[dict[str, Any]]:
    drawn = 0
    for line in panel.lines:
        shade = line.colour or colour(line.run if prefixes else drawn)
        drawn += not line.colour
        if prefixes and shade == INK:
            shade = colour(line.run)
        time, values = thin(line.time, line.values)
        for sign in (1.0, -1.0) if line.mirrored else (1.0,):
            yield {
                'type': 'scatter',
                'name': (prefixes[line.run] if prefixes else '') + line.name,
                'x': _numbers(time),
                'y': _numbers(sign * values),
                'line': {'width': 1.3, 'color': shade, 'dash': 'dash' if line.dashed else 'solid'},
                # Lines with a colour of their own look the same in all bags.
                'showlegend': bool(line.name) and sign > 0.0 and not (line.colour and line.run),
            }


def _histograms(panel: Panel, prefixes: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield histograms up to the tail; values beyond it are counted in the last bin."""
    for line in panel.lines:
        values = line.values[np.isfinite(line.values)]
        counts, edges = np.histogram(np.minimum(values, np.percentile(values, _TAIL)), _BINS)
        yield {
            'type': 'bar',
            'name': (prefixes[line.run] if prefixes else '') + line.name,
            'x': _numbers((edges[1:] + edges[:-1]) / 2),
            'y': counts.tolist(),
            'opacity': 0.7,
            'marker': {'color': colour(line.run)},
        }


def _numbers(values: Floats) -> list[float | None]:
    return [float(f'{one:.{_DIGITS}g}') if np.isfinite(one) else None for one in values.tolist()]


def colour(k: int) -> str:
    """Return the colour of the k-th bag."""
    return COLOURS[k % len(COLOURS)]


def arm(bag: ReportedBag, k: int) -> dict[str, Any]:
    """Return the joints of an arm and their positions, sampled for the animation."""
    run = bag.run
    pictures = int(min(_MOST_PICTURES, max(2.0, run.duration * _RATE)))
    times = np.linspace(0.0, run.duration, pictures)
    rows = np.minimum(np.searchsorted(run.time, times), run.stamp.size - 1)
    position, reference = (
        [] if angles is None else np.nan_to_num(angles).round(4).tolist()
        for angles in (run.at('position', rows), run.at('reference', rows))
    )
    return {
        'name': bag.name,
        'colour': colour(k),
        'joints': bag.arm.joints,
        'tip': bag.arm.tip,
        'time': times.round(4).tolist(),
        'angles': position,
        'reference': reference,
    }
