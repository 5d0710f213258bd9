# SPDX-License-Identifier: Apache-2.0
"""The panels of a run as PNG files: tracking.png, change.png, parameters.png and monitors.png."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from blf_dsc_controller.analysis.metrics import change_times, measure, true_change_times
from blf_dsc_controller.analysis.panels import Line, Mark, Panel, panels
from blf_dsc_controller.analysis.style import (
    ALARM,
    BLUE,
    COLOURS,
    INK,
    ORANGE,
    SHADE,
    Picture,
    head,
)
from blf_dsc_controller.run import Run

NAMES = ('tracking.png', 'change.png', 'parameters.png', 'monitors.png')
"""Names of the files that `draw` can write."""

_SIZE = (6.2, 2.6)  # inches
_LOW = (4.3, 1.75)
_ABREAST = 3  # joints, at most, in columns; more are in rows
_HIGH = (6.2, 3.2)
_CLOSE_UP = (9.5, 2.6)
_BEFORE, _AFTER = 1.0, 2.0  # s, shown of a change
_FLAT, _DECADE = 2.0, 10.0
_SHADED = 0.1
_ABOVE = 1.15  # of the height of a panel, where the legend of its column is
_NARROW, _WIDE, _WIDEST = 1.3, 2.4, 5.0  # points, widths of lines


def draw(run: Run, folder: Path) -> list[Path]:
    """Draw tracking.png and the other files that the run has data for, and return the paths.

    These are change.png if a simulated arm changed, parameters.png if parameters were learned, and
    monitors.png if the monitor was recorded. The folder is created if necessary.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tracking, change, parameters, monitors = (folder / name for name in NAMES)
    metrics, n, found = measure(run), len(run.joints), panels([run])

    def of(*groups: str) -> list[Panel]:
        return [panel for panel in found if panel.group in groups]

    title = f'Motion over {run.duration:.4g} s'
    if metrics.held is not None:
        kept = 'held' if metrics.held else 'VIOLATED'
        title = f'Tracking over {run.duration:.4g} s: bound {kept}'
    for time, stop in run.timed_stops[:1]:
        title += f', stopped at {time:.3f} s ({stop.reason})'
    motion, paths = of('Motion', 'Tracking', 'Torque'), [tracking]
    if n <= _ABREAST:
        draw_panels(tracking, title, motion, n, _SIZE)
    else:
        motion = [panel for panel in motion if not panel.log]
        rows = [panel for i in range(n) for panel in motion[i::n]]
        draw_panels(tracking, title, rows, len(motion) // n, _LOW, legend_above=True)
    changes = true_change_times(run)
    if changes and run.column('error', 0) is not None:
        paths.append(change)
        title = f'The first change of the arm, from {changes[0] - _BEFORE:g} s on'
        draw_panels(change, title, list(_close_up(run, changes[0])), 1, _CLOSE_UP)
    if of('Parameters'):
        title, error = 'Learning', metrics.final_parameter_error
        if not math.isnan(error):
            what = 'relative parameter error' if run.arm is None else 'torque error'
            title += f': {what} {100 * error:.2g} % at the end'
        paths.append(parameters)
        draw_panels(parameters, title, of('Parameters', 'Disturbance', 'Excitation'), 2, _HIGH)
    if of('Monitors'):
        paths.append(monitors)
        draw_panels(monitors, 'Monitors', of('Monitors'), 1, _CLOSE_UP)
    return paths


def _close_up(run: Run, change: float) -> Iterator[Panel]:
    """Yield the errors of all joints, their torques and the model's error around a change."""
    begin, end = change - _BEFORE, change + _AFTER
    found = panels([run], begin, end)
    marks = [Mark(change, 'the arm changes', INK)]
    marks += [Mark(t, 'learning restarts', BLUE) for t in change_times(run) if begin < t < end]
    for group, kind in (('Tracking', 'error of '), ('Torque', 'torque of ')):
        of_joints = [panel for panel in found if panel.title.startswith(kind)]
        lines = [
            next(iter(panel.lines))._replace(name=joint)
            for panel, joint in zip(of_joints, run.joints, strict=False)
        ]
        lines += [line for panel in of_joints[:1] for line in panel.lines if line.shaded]
        if lines:
            unit = of_joints[0].unit
            yield Panel(group, f'{kind}each joint', unit, lines, marks=tuple(marks))
            marks = [mark._replace(text='') for mark in marks]  # named once
    for panel in found:
        if panel.group == 'Parameters' and panel.log:
            yield replace(panel, marks=tuple(marks), note='')


def draw_panels(
    path: Path,
    title: str,
    shown: Sequence[Panel],
    columns: int,
    size: tuple[float, float],
    runs: Sequence[str] = (),
    *,
    legend_above: bool = False,
) -> None:
    """Draw panels of this size [inches] row by row.

    `runs` are the names of several runs, to be shown in the legends. With `legend_above`, each
    column has a single legend above its first row.
    """
    columns = min(columns, len(shown))
    picture = Picture(-(-len(shown) // columns), columns, title, size)
    for k, (axes, panel) in enumerate(zip(picture.axes.flat, shown, strict=False)):
        _draw_panel(axes, panel, runs)
        title = panel.title + (panel.note and f': {panel.note}')
        head(axes, title, legend_at=_ABOVE * (k < columns) if legend_above else None)
    for axes in picture.axes.flat[len(shown) :]:
        axes.set_visible(False)
    picture.save(path)


def _draw_panel(axes: Axes, panel: Panel, runs: Sequence[str]) -> None:
    own = [line for line in panel.lines if not line.colour]
    followed = any(line.colour == INK and line.dashed for line in panel.lines)
    for k, line in enumerate(own):
        colour = COLOURS[(line.run if runs else k) % len(COLOURS)]
        if panel.group == 'Torque' and len(own) == 1:
            colour = ORANGE
        width, alpha = (_WIDE, 0.6) if followed else (_NARROW, 1.0)
        if runs and followed:
            width, alpha = (_WIDEST, _WIDE)[line.run % 2], 1.0  # one upon the other
        label = runs[line.run] if runs else line.name
        _draw_line(axes, line, label=label, color=colour, lw=width, alpha=alpha)
    for line in panel.lines:
        if line.colour:
            _draw_line(axes, line, label=line.name, color=line.colour, lw=1.2)
    for row, mark in enumerate(panel.marks):
        _draw_mark(axes, mark, row)
    _set_scale(axes, panel)


def _set_scale(axes: Axes, panel: Panel) -> None:
    """Scale the value axis; a logarithmic one spans two decades if the values hardly change."""
    low, high = axes.dataLim.minposy, axes.dataLim.ymax
    if panel.log and math.isfinite(low):  # else no value is known
        if high < _FLAT * low:
            axes.set_ylim(low / _DECADE, high * _DECADE)
        axes.set_yscale('log')
    if panel.span:
        axes.set_ylim(None if panel.log else -panel.span, panel.span)
    if panel.unit == '%':
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g} %'))
    elif panel.unit:
        axes.set_ylabel(f'[{panel.unit}]')


def _draw_line(axes: Axes, line: Line, *, label: str, **style: Any) -> None:
    time, values = line.time, line.values
    style['ls'] = '--' if line.dashed else '-'
    if line.shaded:
        axes.fill_between(time, -values, values, color=SHADE, lw=0)
    is_known = label in axes.get_legend_handles_labels()[1]
    axes.plot(time, values, label=None if is_known else label, **style)
    if line.mirrored:
        axes.plot(time, -values, **style)


def _draw_mark(axes: Axes, mark: Mark, row: int) -> None:
    if mark.until > mark.time:
        axes.axvspan(mark.time, mark.until, color=mark.colour, alpha=_SHADED, lw=0)
    if mark.colour == ALARM:
        axes.axvline(mark.time, color=mark.colour, lw=1.4)
    else:
        axes.axvline(mark.time, color=mark.colour or INK, lw=1.1, ls=(0, (1, 2)), zorder=1)
    if not mark.colour:
        return
    is_early = mark.time < sum(axes.get_xlim()) / 2.0
    axes.annotate(
        mark.text,
        (mark.time, 1.0),
        (4 if is_early else -4, -2 - 12 * row),
        xycoords=axes.get_xaxis_transform(),
        textcoords='offset points',
        ha='left' if is_early else 'right',
        va='top',
        fontsize=9.5,
        color=mark.colour,
        bbox={'facecolor': 'white', 'edgecolor': 'none', 'alpha': 0.8, 'pad': 1.0},
    )
