# SPDX-License-Identifier: Apache-2.0
"""HTML tables of the page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from blf_dsc_controller.analysis.style import GREEN, MUTED
from blf_dsc_controller.law.telemetry import load_text
from blf_dsc_controller.run import Floats
from blf_dsc_controller.view.moment import Moment

_NOT_SHOWN = 0.5  # share of the prior's deviation above which an estimate is not identified
_CELL = 'padding:1px 4px;text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums'


def joint_table(joints: Sequence[str], now: Moment) -> str:
    """Return the table of error, bound, torque and limit by joint."""
    head = _row('th', f't = {now.time:.2f} s', 'error [mrad]', 'bound', 'torque [N m]', 'limit')
    columns = 1e3 * now.error, 1e3 * now.bound, now.torque, now.torque_limit
    rows = zip(joints, *columns, strict=True)
    table = _in_table([head, *(_row('td', escape(n), *map(_figure, row)) for n, *row in rows)])
    known = np.isfinite(now.load[0])
    return table + (f'<div style="{_CELL}">held: {load_text(now.load)}</div>' if known else '')


def estimate_table(units: Mapping[str, str], now: Moment, prior: Floats, deviation: Floats) -> str:
    """Return the table of estimates; `prior` and `deviation` are standard deviations (m,)."""
    rows = [_row('th', 'estimate', '', '±', 'truth', 'known')]
    columns = now.estimate, deviation, now.truth, deviation / prior
    for name, unit, value, spread, truth, left in zip(units, units.values(), *columns, strict=True):
        figures = (f'{x:.3g}' if np.isfinite(x) else '-' for x in (value, spread, truth))
        label = f'{escape(name)} <span style="opacity:0.6">{unit}</span>'
        rejected = not np.isfinite(value)
        bar = 'rejected' if rejected else _bar(1.0 - left)
        rows.append(_row('td', label, *figures, bar, pale=rejected or left > _NOT_SHOWN))
    return _in_table(rows)


def event_table(events: Iterable[tuple[float, str, str]]) -> str:
    """Return the table of events: time [s], kind and text."""
    return _in_table(
        f'<tr><td style="{_CELL}">{t:.2f} s</td><td><b>{escape(k)}</b> {escape(e)}</td></tr>'
        for t, k, e in events
    )


def _figure(value: float) -> str:
    return f'{value:.4g}' if np.isfinite(value) else '-'


def _row(tag: str, *cells: str, pale: bool = False) -> str:
    style = _CELL + (';opacity:0.55' if pale else '')
    return '<tr>' + ''.join(f'<{tag} style="{style}">{cell}</{tag}>' for cell in cells) + '</tr>'


def _bar(share: float) -> str:
    percent = 100.0 * min(max(float(np.nan_to_num(share)), 0.0), 1.0)
    colour = GREEN if share > 1.0 - _NOT_SHOWN else MUTED
    fill = f'linear-gradient(to right,{colour} {percent:.0f}%,transparent 0)'
    return f'<div style="width:40px;border:1px solid #bbb;background:{fill}">&nbsp;</div>'


def _in_table(rows: Iterable[str]) -> str:
    return f'<table style="font-size:11px;margin:4px">{"".join(rows)}</table>'
