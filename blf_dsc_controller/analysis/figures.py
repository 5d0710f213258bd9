# SPDX-License-Identifier: Apache-2.0
"""The panels of a run as PNG files: tracking.png, change.png and parameters.png."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from blf_dsc_controller.analysis.event_times import change_times, true_change_times
from blf_dsc_controller.analysis.metrics import Metrics, measure
from blf_dsc_controller.analysis.panels import (
    ALARM,
    BLUE,
    COLOURS,
    INK,
    MUTED,
    ORANGE,
    SHADE,
    Line,
    Mark,
    Panel,
    panels,
)
from blf_dsc_controller.errors import check_type
from blf_dsc_controller.run import Run
from blf_dsc_controller.writing import writing

NAMES = ('tracking.png', 'change.png', 'parameters.png')
"""Names of the files that `draw` can write."""

_MOTION = ('Motion', 'Tracking', 'Torque')
_LEARNING = ('Parameters', 'Disturbance', 'Excitation', 'Monitors')
_SIZE = (6.2, 2.6)  # inches
_LOW = (4.3, 1.75)
_ABREAST = 3  # joints, at most, in columns; more are in rows
_HIGH = (6.2, 3.2)
_CLOSE_UP = (9.5, 2.6)
_BEFORE, _AFTER = 1.0, 2.0  # s, shown of a change
_FLAT = 2.0  # ratio of the largest to the least value of what hardly changes
_DECADE = 10.0
# ratio of the ends of a logarithmic axis, above which powers of ten will do
_LONG = 100.0
_SHADED = 0.1  # opacity of a span
_ABOVE = 1.15  # of the height of a panel, where the legend of its column is
# points, widths of lines
_NARROW = 1.3
_WIDE = 2.4
_WIDEST = 5.0

_DPI = 130
_CHARACTER = 0.085  # inches, approximate width in a title or legend
_HANDLE = 0.5
_POINTS = 72.0  # of an inch
# points: below the top of a panel, the height of the name of a mark
_GAP = 2.0
_ROW = 12.0
_MARGIN = 0.75  # inches of a panel, beside its axes
_SETTINGS: Any = {
    'font.family': 'DejaVu Sans',
    'font.size': 11,
    'mathtext.fontset': 'dejavusans',
    'axes.edgecolor': MUTED,
    'axes.labelcolor': INK,
    'axes.titlecolor': INK,
    'text.color': INK,
    'xtick.color': MUTED,
    'ytick.color': MUTED,
    'xtick.labelcolor': INK,
    'ytick.labelcolor': INK,
    'lines.linewidth': 1.4,
    'lines.solid_joinstyle': 'round',
    'path.simplify': False,
}


class Picture:
    """A figure of panels, with these settings and without pyplot's global state."""

    def __init__(
        self,
        rows: int,
        columns: int,
        title: str,
        panel: tuple[float, float],
        *,
        share_time: bool = True,
    ) -> None:
        self._share_time = share_time
        with rc_context(_SETTINGS):
            self._figure = Figure(
                figsize=(panel[0] * columns, panel[1] * rows + 0.5),
                dpi=_DPI,
                facecolor='white',
                layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08, hspace=0.04),
            )
            self._canvas = FigureCanvasAgg(self._figure)
            self._figure.suptitle(
                title, x=0.01, ha='left', fontsize=14, fontweight='bold'
            )
            self.axes = self._figure.subplots(
                rows, columns, sharex=share_time, squeeze=False
            )
            for axes in self.axes.flat:
                axes.spines[['top', 'right']].set_visible(False)
                axes.grid(visible=True, color='#E5E7EB', linewidth=0.8)
                axes.set_axisbelow(True)
                axes.margins(x=0.01)

    def save(self, path: Path) -> None:
        """Write the picture as PNG."""
        with rc_context(_SETTINGS):
            for column in self.axes.T if self._share_time else ():
                lowest = [axes for axes in column if axes.get_visible()][-1]
                lowest.set_xlabel('time [s]')
                lowest.tick_params(labelbottom=True)
            for axes in self.axes.flat:
                _number(axes.xaxis)
                _number(axes.yaxis)
            # Figure.savefig would draw twice, the first time for the layout only.
            with writing(path) as part:
                self._canvas.print_png(part)  # type: ignore[no-untyped-call]


def _number(axis: Axis) -> None:
    """Write plain numbers at a logarithmic axis, and enough of them, unless it is long."""
    low, high = axis.get_view_interval()
    if axis.get_scale() != 'log' or high > _LONG * low:
        return
    axis.set_major_locator(
        LogLocator(subs=(1.0, 2.0, 5.0))
        if high > _DECADE * low
        else MaxNLocator(5, steps=[1, 2, 5, 10])
    )
    axis.set_major_formatter('{x:g}')
    axis.set_minor_formatter(NullFormatter())


def head(axes: Axes, title: str, *, legend_at: float | None = None) -> None:
    """Put the title above a panel, and the legend above or beside it.

    With `legend_at` it is at this height of the axes; at 0, and if the title names its
    only line, there is none.
    """
    axes.set_title(title, loc='left', fontsize=11.5)
    labels = axes.get_legend_handles_labels()[1]
    entries = len(labels)
    if entries == 0 or labels == [title.partition(':')[0]] or legend_at == 0.0:
        return
    grid = axes.get_subplotspec()
    width = axes.figure.get_figwidth() / (grid.get_gridspec().ncols if grid else 1)  # type: ignore[union-attr]
    fits = (
        _CHARACTER * len(title + ''.join(labels)) + _HANDLE * entries < width - _MARGIN
    )
    above = fits or legend_at is not None
    axes.legend(
        loc='lower right' if above else 'center left',
        bbox_to_anchor=(1.0, legend_at or 1.0) if above else (1.0, 0.5),
        ncols=entries if above else 1,
        frameon=False,
        fontsize=10,
        borderaxespad=0.15,
        handlelength=1.6,
        columnspacing=1.2,
    )


def draw(run: Run, folder: str | Path, metrics: Metrics | None = None) -> list[Path]:
    """Draw tracking.png and what else the run has data for; return the paths.

    These are change.png if a simulated arm changed, and parameters.png if parameters
    were learned. The folder is created if necessary. `metrics` are those of the run, if
    they have been measured already.

    Raises ArgumentTypeError if it is no run.
    """
    check_type('run', run, Run, 'simulate(...).run() and read_run return one')
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tracking, change, parameters = (folder / name for name in NAMES)
    metrics = metrics or measure(run)
    found = panels([run])
    _draw_motion(tracking, run, metrics, _of_groups(found, _MOTION))
    paths = [tracking]
    changes = true_change_times(run)
    if changes and run.column('error', 0) is not None:
        title = f'Errors and torques as the arm changes at {changes[0]:g} s'
        draw_panels(change, title, list(close_up(run, changes[0])), 1, _CLOSE_UP)
        paths.append(change)
    if _of_groups(found, ('Parameters',)):
        title = _learning_title(run, metrics)
        draw_panels(parameters, title, _of_groups(found, _LEARNING), 2, _HIGH)
        paths.append(parameters)
    return paths


def _of_groups(shown: Iterable[Panel], groups: Sequence[str]) -> list[Panel]:
    """Return the panels of some groups, in their order."""
    return [panel for panel in shown if panel.group in groups]


def _draw_motion(path: Path, run: Run, metrics: Metrics, shown: list[Panel]) -> None:
    """Draw the panels of the joints: a column for each, or a row if there are many."""
    n = len(run.joints)
    title = _motion_title(run, metrics)
    if n <= _ABREAST:
        draw_panels(path, title, shown, n, _SIZE)
        return
    linear = [panel for panel in shown if not panel.log]
    rows = [panel for i in range(n) for panel in linear[i::n]]
    draw_panels(path, title, rows, len(linear) // n, _LOW, legend_above=True)


def _motion_title(run: Run, metrics: Metrics) -> str:
    """Return for how long the arm moved, whether the bound was kept, and the first stop."""
    title = f'Motion over {run.duration:.4g} s'
    if metrics.held is not None:
        kept = 'held' if metrics.held else 'VIOLATED'
        title = f'Tracking over {run.duration:.4g} s: bound {kept}'
    for time, stop in run.timed_stops[:1]:
        title += f', stopped at {time:.3f} s ({stop.reason})'
    return title


def _learning_title(run: Run, metrics: Metrics) -> str:
    """Return the error of what was learned at the end, if the truth is known."""
    error = metrics.parameter_error.end
    if math.isnan(error):
        return 'Learning'
    what = 'relative parameter error' if run.arm is None else 'torque error'
    return f'Learning: {what} {100 * error:.2g} % at the end'


def close_up(run: Run, change: float) -> Iterator[Panel]:
    """Yield errors, torques and the error of the model around a change at a time [s]."""
    begin, end = change - _BEFORE, change + _AFTER
    found = panels([run], begin, end)
    marks = _marks_of_change(run, change, end)
    unnamed = tuple(mark._replace(text='') for mark in marks)
    errors = _all_joints(run, found, 'Tracking', 'error of ')
    if errors is not None:
        yield replace(errors, marks=marks)
    torques = _all_joints(run, found, 'Torque', 'torque of ')
    if torques is not None:  # the marks are named once
        yield replace(torques, marks=marks if errors is None else unnamed)
    last = marks if errors is None and torques is None else unnamed
    for panel in _of_groups(found, ('Parameters',)):
        if panel.log:
            yield replace(panel, marks=last, note='')


def _marks_of_change(run: Run, change: float, end: float) -> tuple[Mark, ...]:
    """Return when the arm changed, and when learning restarted before `end` [s]."""
    restarts = [t for t in change_times(run) if change - _BEFORE < t < end]
    return (
        Mark(change, 'the arm changes', INK),
        *(Mark(t, 'learning restarts', BLUE) for t in restarts),
    )


def _all_joints(
    run: Run, shown: Sequence[Panel], group: str, kind: str
) -> Panel | None:
    """Return one panel instead of one for each joint, with the bound of the first.

    The titles of those begin with `kind`.  None if there are none.
    """
    of_joints = [panel for panel in shown if panel.title.startswith(kind)]
    if not of_joints:
        return None
    lines = [
        next(iter(panel.lines))._replace(name=joint)
        for panel, joint in zip(of_joints, run.joints, strict=False)
    ]
    lines += [line for line in of_joints[0].lines if line.shaded]
    return Panel(group, f'{kind}each joint', of_joints[0].unit, lines)


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

    `runs` are the names of several runs, to be shown in the legends. With
    `legend_above`, each column has a single legend above its first row.
    """
    columns = min(columns, len(shown))
    picture = Picture(-(-len(shown) // columns), columns, title, size)
    for k, (axes, panel) in enumerate(zip(picture.axes.flat, shown, strict=False)):
        _draw_panel(axes, panel, runs)
        _make_room(axes, panel.marks, size[1])
        title = panel.title + (panel.note and f': {panel.note}')
        head(axes, title, legend_at=_ABOVE * (k < columns) if legend_above else None)
    for axes in picture.axes.flat[len(shown) :]:
        axes.set_visible(False)
    picture.save(path)


def _draw_panel(axes: Axes, panel: Panel, runs: Sequence[str]) -> None:
    own = [line for line in panel.lines if not line.colour]
    is_followed = any(line.colour == INK and line.dashed for line in panel.lines)
    for k, line in enumerate(own):
        colour = COLOURS[(line.run if runs else k) % len(COLOURS)]
        if panel.group == 'Torque' and len(own) == 1:
            colour = ORANGE
        width, alpha = _stroke(line, is_followed=is_followed, has_runs=bool(runs))
        label = runs[line.run] if runs else line.name
        _draw_line(axes, line, label=label, color=colour, lw=width, alpha=alpha)
    for line in panel.lines:
        if line.colour:
            _draw_line(axes, line, label=line.name, color=line.colour, lw=1.2)
    row = 0
    for mark in panel.marks:
        _draw_mark(axes, mark, row)
        row += _is_named(mark)
    _set_scale(axes, panel)


def _stroke(line: Line, *, is_followed: bool, has_runs: bool) -> tuple[float, float]:
    """Return width [points] and opacity of a line, which is wide below a dashed one.

    Of several runs, every other line is wider, since one lies upon the other.
    """
    if not is_followed:
        return _NARROW, 1.0
    if has_runs:
        return (_WIDEST, _WIDE)[line.run % 2], 1.0
    return _WIDE, 0.6


def _set_scale(axes: Axes, panel: Panel) -> None:
    """Scale the axis of the values; a logarithmic one spans two decades if they hardly change."""
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


def _make_room(axes: Axes, marks: Sequence[Mark], height: float) -> None:
    """Raise the top of a panel of this height [inches], so that names of marks hide no line."""
    rows = sum(map(_is_named, marks))
    if not rows:
        return
    share = (_ROW * rows + _GAP) / (_POINTS * (height - _MARGIN))
    to_axis, to_value = axes.transScale, axes.transScale.inverted()
    (_, low), (_, high) = (to_axis.transform((1.0, each)) for each in axes.get_ylim())
    top = high + (high - low) * share / (1.0 - share)
    axes.set_ylim(top=to_value.transform((0.0, top))[1])


def _is_named(mark: Mark) -> bool:
    return bool(mark.colour and mark.text)


def _draw_mark(axes: Axes, mark: Mark, row: int) -> None:
    if mark.until > mark.time:
        axes.axvspan(mark.time, mark.until, color=mark.colour, alpha=_SHADED, lw=0)
    if mark.colour == ALARM:
        axes.axvline(mark.time, color=mark.colour, lw=1.4)
    else:
        axes.axvline(
            mark.time, color=mark.colour or INK, lw=1.1, ls=(0, (1, 2)), zorder=1
        )
    if not _is_named(mark):
        return
    is_early = mark.time < sum(axes.get_xlim()) / 2.0
    axes.annotate(
        mark.text,
        (mark.time, 1.0),
        (4 if is_early else -4, -_GAP - _ROW * row),
        xycoords=axes.get_xaxis_transform(),
        textcoords='offset points',
        ha='left' if is_early else 'right',
        va='top',
        fontsize=9.5,
        color=mark.colour,
        bbox={'facecolor': 'white', 'edgecolor': 'none', 'alpha': 0.8, 'pad': 1.0},
    )
