# SPDX-License-Identifier: Apache-2.0
"""Style of figures and pages: colour-blind safe colours, legends beside the data, templates."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
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
_TEMPLATES = Environment(
    loader=PackageLoader('blf_dsc_controller'),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.policies['json.dumps_kwargs'] = {'allow_nan': False, 'separators': (',', ':')}
_TEMPLATES.filters['anchor'] = lambda title: title.lower().replace(' ', '-')
_TEMPLATES.filters['embedded'] = lambda png: (
    f'data:image/png;base64,{base64.b64encode(png.read_bytes()).decode("ascii")}'
)


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


def head(axes: Axes, title: str, *, legend_at: float | None = None) -> None:
    """Put the title above a panel and the legend off the data: above as well, or beside it.

    With `legend_at` it is at this height of the axes; at 0, and if the title names its only line,
    there is none.
    """
    axes.set_title(title, loc='left', fontsize=11.5)
    labels = axes.get_legend_handles_labels()[1]
    entries = len(labels)
    if entries == 0 or labels == [title.partition(':')[0]] or legend_at == 0.0:
        return
    grid = axes.get_subplotspec()
    width = axes.figure.get_figwidth() / (grid.get_gridspec().ncols if grid else 1)  # type: ignore[union-attr]
    fits = _CHARACTER * len(title + ''.join(labels)) + _HANDLE * entries < width - _MARGIN
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


class Cell(NamedTuple):
    """Table cell that is more than plain text.

    Styles: number, code, good, partly, bad; marked highlights the row.
    """

    text: str
    style: str = ''
    colour: str = ''  # of a swatch before the text


def write_page(path: Path, template: str, title: str, **values: object) -> None:
    """Render a template with its variables and write the page."""
    text = _TEMPLATES.get_template(template).render(title=title, **values)
    path.write_text(text, encoding='utf-8')
