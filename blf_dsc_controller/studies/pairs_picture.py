# SPDX-License-Identifier: Apache-2.0
"""Picture of studies of pairs: errors and learned models with and without learning."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from blf_dsc_controller.analysis.figures import Picture, head
from blf_dsc_controller.analysis.panels import ALARM, BLUE, COLOURS, INK, MUTED, ORANGE
from blf_dsc_controller.studies.monte_carlo import WITHOUT, Study
from blf_dsc_controller.studies.runs import KEPT, Columns
from blf_dsc_controller.studies.summary import ALLOWED, LAWS, known, worst_of

Studies = dict[str, tuple[Study, Columns]]
"""Studies and their results, by title."""

_SHOWN = (0.03, 2.0)  # |xi1| / k_c; what is beyond is drawn at these
_MOST_DOTS = 20_000
_FEW_DECADES = 1e3
_RATIO = r'max $|\xi_1| \; / \; k_c$'


def draw_pairs(studies: Studies, path: Path) -> None:
    """Draw errors and learned models of studies, with and without learning."""
    picture = Picture(
        1,
        3,
        'The same random runs with learning and without it',
        (5.2, 4.2),
        share_time=False,
    )
    largest, rms, model = picture.axes[0]
    for (title, (study, results)), colour in zip(
        studies.items(), COLOURS, strict=False
    ):
        x, y = (
            worst_of(study, results, 'settled_error_ratio', law)
            for law in (WITHOUT, '')
        )
        lost = (results['outcome'] != KEPT) & (results[f'{WITHOUT}outcome'] == KEPT)
        x, y = (np.clip(values, *_SHOWN) for values in (x, y))
        chosen = np.flatnonzero(~lost)[:_MOST_DOTS]
        largest.plot(
            x[chosen], y[chosen], '.', ms=4, color=colour, alpha=0.6, mew=0, label=title
        )
        largest.plot(x[lost], y[lost], 'o', ms=5, color=ALARM, mew=0)
    ends = np.array(_SHOWN)
    largest.loglog(ends, ends, color=MUTED, lw=1.0, label='equal')
    largest.loglog(
        ends, ALLOWED * ends, color=MUTED, lw=1.0, ls=':', label=f'{ALLOWED:g} times'
    )
    _make_logarithmic(largest, both=True)
    largest.axhline(1.0, color=INK, ls='--', lw=1.0, label='bound')
    largest.axvline(1.0, color=INK, ls='--', lw=1.0)
    largest.set_xlabel(f'{_RATIO} without learning')
    largest.set_ylabel('with learning')
    head(largest, 'largest error of each run')
    _draw_boxes(rms, 'rms_error_rad', 1e3, studies)
    rms.set_xlabel(r'rms $\xi_1$ of the worst joint [mrad]')
    head(rms, 'rms error')
    _draw_boxes(model, 'torque_error.end', 1e2, studies)
    model.set_xlabel('of the torque [%]')
    head(model, 'model error on the next motion')
    picture.save(path)


def _draw_boxes(axes: Axes, name: str, unit: float, studies: Studies) -> None:
    """Draw quantiles of a figure with and without learning, where the bound is kept without."""
    labels: list[str] = []
    for title, (study, results) in studies.items():
        for (law, label), colour in zip(LAWS.items(), (BLUE, ORANGE), strict=True):
            shown = unit * known(study, results, name, law)
            y = 2 * [-len(labels)]
            if shown.size:
                least, *quartiles, most = np.quantile(
                    shown, (0.01, 0.25, 0.5, 0.75, 0.99)
                )
                axes.plot([least, most], y, color=colour, lw=1.2)
                axes.plot(
                    [quartiles[0], quartiles[2]], y, color=colour, lw=7, alpha=0.6
                )
                axes.plot(quartiles[1:2], y[:1], 'o', color=INK, ms=4)
            labels.append(f'{title}, {label}')
    axes.set_yticks(-np.arange(len(labels)), labels)
    _make_logarithmic(axes)


def _make_logarithmic(axes: Axes, *, both: bool = False) -> None:
    """Make the x axis, or both, logarithmic, with plain numbers."""
    axes.set_xscale('log')
    for axis in (axes.xaxis, axes.yaxis)[: 1 + both]:
        low, high = axis.get_view_interval()
        axis.set_major_locator(
            LogLocator(subs=(1.0, 2.0, 5.0) if high < _FEW_DECADES * low else (1.0,))
        )
        axis.set_major_formatter('{x:g}')
        axis.set_minor_formatter(NullFormatter())
