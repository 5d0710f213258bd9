# SPDX-License-Identifier: Apache-2.0
"""The pictures of a study: how its runs spread, and what the worst of them have in common."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from blf_dsc_controller.analysis.style import ALARM, BLUE, COLOURS, INK, MUTED, Picture, head
from blf_dsc_controller.monte_carlo.chunk import Columns
from blf_dsc_controller.monte_carlo.measure import KEPT, error_columns
from blf_dsc_controller.monte_carlo.statistics import influence, worst_ratio
from blf_dsc_controller.monte_carlo.study import Study
from blf_dsc_controller.run import Floats

_PANEL = (6.2, 3.4)  # inches
_MOST_BINS = 60
_MILLI = 1e3
_PANELS_OF_INFLUENCE = 6
_MOST_DOTS = 20_000
_FEW_DOTS = 1000
_LEAST_ERROR = 1e-6
_FARTHEST = 2.0  # |xi1| / k_c that is drawn; what is beyond is put there
_FEW_DECADES = 50.0


def draw_study(study: Study, results: Columns, folder: Path) -> list[Path]:
    """Draw distributions.png, and influence.png if anything varies, and return their paths."""
    drawn = [folder / 'distributions.png', folder / 'influence.png']
    _draw_distributions(study, results, drawn[0])
    if not influence(study, results):
        return drawn[:1]
    _draw_influence(study, results, drawn[1])
    return drawn


def _draw_distributions(study: Study, results: Columns, path: Path) -> None:
    picture = Picture(2, 2, _title(results), _PANEL, share_time=False)
    (ratio, tail), (rms, error) = picture.axes
    _ratio(ratio, study, results)
    _tail(tail, study, results)
    _rms(rms, study, results)
    _error(error, study, results)
    picture.save(path)


def _title(results: Columns) -> str:
    runs = results['outcome'].size
    kept = int((results['outcome'] == KEPT).sum())
    return f'{runs} runs: {100 * kept / runs:.4g} % kept the bound'


def _ratio(axes: Axes, study: Study, results: Columns) -> None:
    columns = {joint: results[f'max_error_ratio.{joint}'] for joint in study.plant.joints}
    # Far outside, how far does not matter any more; the last bar holds all of it.
    _histogram(axes, {joint: np.minimum(values, 1.25) for joint, values in columns.items()})
    axes.axvline(1.0, color=ALARM, lw=1.4, label='bound')
    axes.set_xlabel(r'max $|\xi_1| \; / \; k_c$')
    head(axes, 'largest error')


def _tail(axes: Axes, study: Study, results: Columns) -> None:
    worst = np.sort(worst_ratio(study, results))
    share = 1.0 - np.arange(worst.size) / worst.size
    finite = np.isfinite(worst)
    axes.loglog(worst[finite], share[finite], color=BLUE, drawstyle='steps-pre')
    axes.axvline(1.0, color=ALARM, lw=1.4, label='bound')
    axes.set_ylabel('share of runs above')
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{100 * value:g} %'))
    _plain(axes)
    axes.set_xlabel(r'max $|\xi_1| \; / \; k_c$, the worse joint')
    head(axes, 'tail of the largest error')


def _plain(axes: Axes) -> None:
    """Label a logarithmic axis with plain numbers: decades, and 2 and 5 if they are few."""
    low, high = axes.get_xlim()
    between = '25' if high < _FEW_DECADES * low else ''
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axes.xaxis.set_minor_formatter(
        FuncFormatter(lambda value, _: f'{value:g}' if f'{value:e}'[0] in between else '')
    )


def _rms(axes: Axes, study: Study, results: Columns) -> None:
    columns = {joint: results[f'rms_error_rad.{joint}'] for joint in study.plant.joints}
    columns = {joint: _MILLI * values for joint, values in columns.items()}
    _histogram(axes, columns, logarithmic=True)
    _plain(axes)
    axes.set_xlabel(r'rms $\xi_1$ [mrad]')
    head(axes, f'error from {study.settings.settled_after:g} s on')


def _error(axes: Axes, study: Study, results: Columns) -> None:
    names = list(error_columns(study))
    labels = [*(f'{moment:g} s' for moment in study.settings.moments), 'end']
    columns = {
        label: np.maximum(results[name], _LEAST_ERROR)
        for label, name in zip(labels, names, strict=True)
    }
    _histogram(axes, columns, logarithmic=True)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{100 * value:g} %'))
    axes.set_xlabel(r'$\|\hat P - P\| \;/\; \|P\|$')
    head(axes, 'relative parameter error')


def _histogram(axes: Axes, columns: dict[str, Floats], *, logarithmic: bool = False) -> None:
    """Outlines over common bins, so that several distributions can be told apart."""
    known = {label: values[np.isfinite(values)] for label, values in columns.items()}
    everything = np.concatenate(list(known.values()))
    if everything.size == 0:
        return
    low, high = float(everything.min()), float(everything.max())
    count = min(_MOST_BINS, 10 + everything.size // 40)
    if logarithmic and low > 0.0:
        bins = np.geomspace(low, max(high, low * 1.01), count + 1).tolist()
        axes.set_xscale('log')
    else:
        bins = np.linspace(low, max(high, low + 1e-9), count + 1).tolist()
    for (label, values), colour in zip(known.items(), COLOURS, strict=False):
        weights = np.full(values.size, 1.0 / max(1, values.size))
        axes.hist(values, bins, weights=weights, histtype='stepfilled', color=colour, alpha=0.22)
        axes.hist(values, bins, weights=weights, histtype='step', color=colour, lw=1.4, label=label)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{100 * value:g} %'))
    axes.set_ylabel('share of runs')


def _draw_influence(study: Study, results: Columns, path: Path) -> None:
    strongest = list(influence(study, results).items())[:_PANELS_OF_INFLUENCE]
    columns = min(3, len(strongest))
    rows = -(-len(strongest) // columns)
    title = 'What the largest error depends on most'
    picture = Picture(rows, columns, title, (4.4, 3.2), share_time=False)
    worst = worst_ratio(study, results)
    kept = np.flatnonzero(results['outcome'] == KEPT)
    kept = kept[:: -(-kept.size // _MOST_DOTS) or 1]
    lost = np.flatnonzero(results['outcome'] != KEPT)
    size, opacity = (5.0, 0.5) if kept.size < _FEW_DOTS else (2.5, 0.25)
    beyond = worst > _FARTHEST
    distributions = {one.column: one.distribution for one in study.spreads}
    for axes, (name, share) in zip(picture.axes.flat, strongest, strict=False):
        values = results[f'plant.{name}']
        ratios = np.minimum(worst, _FARTHEST)
        axes.plot(values[kept], ratios[kept], '.', ms=size, color=BLUE, alpha=opacity, mew=0)
        axes.plot(values[lost], ratios[lost], '.', ms=6, color=ALARM, mew=0)
        axes.plot(values[beyond], ratios[beyond], '^', ms=7, color=ALARM, mew=0)
        if distributions[f'plant.{name}'].name == 'loguniform':
            axes.set_xscale('log')
        axes.axhline(1.0, color=INK, lw=1.0, ls='--')
        axes.set_xlabel(name, color=MUTED)
        axes.set_ylabel(r'max $|\xi_1| \; / \; k_c$')
        head(axes, f'explains {100 * share:.0f} %')
    for axes in picture.axes.flat[len(strongest) :]:
        axes.set_visible(False)
    picture.save(path)
