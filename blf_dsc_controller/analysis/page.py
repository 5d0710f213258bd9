# SPDX-License-Identifier: Apache-2.0
"""The page of one or several bags: a single HTML file that needs nothing else.

Drawn by plotly, whose script is part of the page (4.8 MB): it opens without a network.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from blf_dsc_controller.analysis.animation import animation
from blf_dsc_controller.analysis.errors import NoPlotlyError
from blf_dsc_controller.analysis.panels import colour, panels
from blf_dsc_controller.analysis.subject import Subject
from blf_dsc_controller.analysis.summary import summarize
from blf_dsc_controller.analysis.table import format_table

_FOLDER = Path(__file__).with_name('page_template')
_UNKNOWN = 'not recorded'


def write_page(subjects: Sequence[Subject], path: Path) -> None:
    """Write the page of these bags.

    Raises:
        NoPlotlyError: plotly is not installed.
    """
    found = panels(subjects)
    groups = list(dict.fromkeys(panel['group'] for panel in found))
    links = [(name, name) for name in groups]
    links += [('arm-title', 'Arm'), ('events', 'Events'), ('configuration', 'Configuration')]
    entries = {
        'title': escape(' and '.join(one.name for one in subjects)),
        'subtitle': escape(_subtitle(subjects)),
        'nav': ''.join(f'<a href="#{escape(key)}">{escape(text)}</a>' for key, text in links),
        'summary': _summaries(subjects),
        'events': _events(subjects),
        'configuration': _configuration(subjects),
        'data': _embedded({'panels': found, 'arms': animation(subjects)}),
        'plotly': _plotly(),
        'script': (_FOLDER / 'page.js').read_text(encoding='utf-8'),
    }
    pieces = (_FOLDER / 'page.html').read_text(encoding='utf-8').split('{{')
    text = pieces[0] + ''.join(
        entries[key] + rest for key, rest in (piece.split('}}', 1) for piece in pieces[1:])
    )
    path.write_text(text, encoding='utf-8')


def _plotly() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise NoPlotlyError from None
    return str(get_plotlyjs())


def _embedded(content: Any) -> str:
    """JSON that cannot end the element it stands in."""
    return json.dumps(content, allow_nan=False, separators=(',', ':')).replace('</', '<\\/')


def _subtitle(subjects: Sequence[Subject]) -> str:
    versions = sorted({one.context.version or 'another recorder' for one in subjects})
    seconds = max(one.run.duration for one in subjects)
    return (
        f'{seconds:.3f} s, recorded by {", ".join(versions)}. Drag to zoom, double-click for all '
        'of it; long series are thinned to their lowest and highest values.'
    )


def _summaries(subjects: Sequence[Subject]) -> str:
    return ''.join(
        f'<h3>{_swatch(k)}{escape(one.name)}</h3>'
        f'<pre>{escape(format_table(summarize(one.run)))}</pre>'
        for k, one in enumerate(subjects)
    )


def _swatch(k: int) -> str:
    return f'<span class="swatch" style="background:{colour(k)}"></span>'


def _events(subjects: Sequence[Subject]) -> str:
    rows = sorted(
        (event.time, k, event.kind, event.text)
        for k, one in enumerate(subjects)
        for event in one.events
    )
    if not rows:
        return '<p>none</p>'
    bad = ('violation', 'ERROR', 'lost')
    cells = (
        f'<tr><td class="number">{time:.3f} s</td><td>{_swatch(k)}{escape(subjects[k].name)}</td>'
        f'<td{" class=bad" if kind in bad else ""}>{escape(kind)}</td><td>{escape(text)}</td></tr>'
        for time, k, kind, text in rows
    )
    return _table(('time', 'bag', 'kind', 'what'), cells)


def _configuration(subjects: Sequence[Subject]) -> str:
    told = [one.parameters for one in subjects]
    names = list(dict.fromkeys(name for one in told for name in one))
    if not names:
        return '<p>not recorded in the bag</p>'
    rows = [(name, [one.get(name, _UNKNOWN) for one in told]) for name in names]
    unlike = [row for row in rows if len(set(row[1])) > 1]
    header = ('parameter', *(one.name for one in subjects))
    text = ''
    if len(subjects) > 1:
        text += f'<p>{len(unlike)} parameters differ.</p>'
        text += _table(header, (_parameter_row(*row, other=True) for row in unlike))
    everything = _table(header, (_parameter_row(*row, other=row in unlike) for row in rows))
    return f'{text}<details><summary>all {len(rows)} parameters</summary>{everything}</details>'


def _parameter_row(name: str, values: list[str], *, other: bool) -> str:
    cells = ''.join(f'<td>{escape(value)}</td>' for value in values)
    return f'<tr{" class=other" if other else ""}><td>{escape(name)}</td>{cells}</tr>'


def _table(header: Iterable[str], rows: Iterable[str]) -> str:
    head = ''.join(f'<th>{escape(title)}</th>' for title in header)
    return f'<div class="scroll"><table><tr>{head}</tr>{"".join(rows)}</table></div>'
