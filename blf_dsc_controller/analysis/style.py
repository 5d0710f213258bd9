# SPDX-License-Identifier: Apache-2.0
"""Style of the figures: colour-blind safe colours, and legends beside the data."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

BLUE = '#0072B2'
ORANGE = '#D55E00'
GREEN = '#009E73'
COLOURS = (BLUE, ORANGE, GREEN, '#CC79A7', '#E69F00', '#56B4E9', '#7F3C8D', '#000000')
INK = '#22272E'
MUTED = '#6B7280'
SHADE = '#DCE9F5'
ALARM = '#B3001B'

_DPI = 130
_CHARACTER = 0.085  # inches, approximate width in a title or legend
_HANDLE = 0.5
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
    """A figure of panels, made with these settings and without pyplot's global state."""

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
            self._figure.suptitle(title, x=0.01, ha='left', fontsize=14, fontweight='bold')
            self.axes = self._figure.subplots(rows, columns, sharex=share_time, squeeze=False)
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
            # Figure.savefig would draw twice, the first time for the layout only.
            self._canvas.print_png(path)  # type: ignore[no-untyped-call]


def head(axes: Axes, title: str) -> None:
    """Put the title above a panel and the legend off the data: above as well, or beside it.

    A single line that the title names needs no legend.
    """
    axes.set_title(title, loc='left', fontsize=11.5)
    labels = axes.get_legend_handles_labels()[1]
    entries = len(labels)
    if entries == 0 or labels == [title.partition(':')[0]]:
        return
    grid = axes.get_subplotspec()
    width = axes.figure.get_figwidth() / (grid.get_gridspec().ncols if grid else 1)  # type: ignore[union-attr]
    characters = re.sub(r'\\hat|[\\${}_^,]', '', title + ''.join(labels))
    above = _CHARACTER * len(characters) + _HANDLE * entries < width - _MARGIN
    axes.legend(
        loc='lower right' if above else 'center left',
        bbox_to_anchor=(1.0, 1.0) if above else (1.0, 0.5),
        ncols=entries if above else 1,
        frameon=False,
        fontsize=10,
        borderaxespad=0.15,
        handlelength=1.6,
        columnspacing=1.2,
    )


def head_of_column(axes: Axes, title: str, *, first: bool) -> None:
    """Put the title above a panel; the first of a column also gets the legend of the column."""
    axes.set_title(title, loc='left', fontsize=11)
    entries = len(axes.get_legend_handles_labels()[1])
    if first and entries:
        axes.legend(
            loc='lower right',
            bbox_to_anchor=(1.0, 1.15),
            ncols=entries,
            frameon=False,
            fontsize=10,
            borderaxespad=0.15,
            handlelength=1.6,
        )


def formula(name: str) -> str:
    """Return the name of a parameter, as mathtext if it is a formula such as `m2*l1*l2`."""
    if not re.fullmatch(r'(?:[A-Za-z]\d*|[()+*^-]|\d)+', name) or not re.search(r'\d', name):
        return name
    indexed = re.sub(r'([A-Za-z])(\d+)', r'\1_{\2}', name)
    return f'${indexed.replace("*", chr(92) + ",")}$'
