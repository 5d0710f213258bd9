# SPDX-License-Identifier: Apache-2.0
"""The page of one or several bags, drawn by plotly, whose script (4.8 MB) is part of the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from blf_dsc_controller.analysis.animation import animation
from blf_dsc_controller.analysis.page import (
    Cell,
    Content,
    Fragment,
    Listing,
    Page,
    Paragraph,
    Section,
    Table,
)
from blf_dsc_controller.analysis.panels import colour, panels
from blf_dsc_controller.analysis.subject import Subject
from blf_dsc_controller.analysis.summary import summarize
from blf_dsc_controller.analysis.table import format_table
from blf_dsc_controller.errors import MissingExtraError

_ALARMING = ('violation', 'ERROR', 'lost')


def write_report(subjects: Sequence[Subject], path: Path) -> None:
    """Write the page of these bags.

    Raises:
        MissingExtraError: plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise MissingExtraError('plotly', 'report', 'the page') from None
    drawn = panels(subjects)
    data = {'panels': drawn, 'arms': animation(subjects)}
    links = [*dict.fromkeys(panel['group'] for panel in drawn), 'The arm', 'Events']
    Page(
        title=' and '.join(one.name for one in subjects),
        introduction=[Paragraph(_subtitle(subjects), 'muted')],
        links=[(name.lower().replace(' ', '-'), name) for name in [*links, 'Configuration']],
        sections=[
            Section('Summary', [_summary(one, k) for k, one in enumerate(subjects)]),
            Section('', [Fragment('plots.html', {'data': data, 'plotly': get_plotlyjs()})]),
            Section('Events', [_events(subjects)]),
            Section('Configuration', list(_configuration(subjects))),
        ],
    ).write(path)


def _subtitle(subjects: Sequence[Subject]) -> str:
    versions = sorted({one.context.version or 'another recorder' for one in subjects})
    seconds = max(one.run.duration for one in subjects)
    return (
        f'{seconds:.3f} s, recorded by {", ".join(versions)}. Drag to zoom, double-click to zoom '
        'out; long series are thinned to their minima and maxima.'
    )


def _summary(subject: Subject, k: int) -> Listing:
    return Listing(subject.name, format_table(summarize(subject.run)), colour(k))


def _events(subjects: Sequence[Subject]) -> Content:
    rows = sorted(
        (event.time, k, event.kind, event.text)
        for k, one in enumerate(subjects)
        for event in one.events
    )
    if not rows:
        return Paragraph('none')
    cells = [
        (
            Cell(f'{time:.3f} s', 'number'),
            Cell(subjects[k].name, colour=colour(k)),
            Cell(kind, 'bad' if kind in _ALARMING else ''),
            text,
        )
        for time, k, kind, text in rows
    ]
    return Table(('time', 'bag', 'kind', 'event'), cells)


def _configuration(subjects: Sequence[Subject]) -> Iterator[Content]:
    recorded = [one.parameters for one in subjects]
    names = list(dict.fromkeys(name for one in recorded for name in one))
    if not names:
        yield Paragraph('not recorded in the bag')
        return
    rows: list[list[str | Cell]] = []
    different = []
    for name in names:
        values = [one.get(name, 'not recorded') for one in recorded]
        differs = len(set(values)) > 1
        rows.append([Cell(name, 'marked') if differs else name, *values])
        if differs:
            different.append(rows[-1])
    header = ('parameter', *(one.name for one in subjects))
    if len(subjects) > 1:
        yield Paragraph(f'{len(different)} parameters differ.')
        yield Table(header, different)
    yield Table(header, rows, folded=f'all {len(rows)} parameters')
