# SPDX-License-Identifier: Apache-2.0
"""Figures of a study: how its runs spread, and what the worst of them have in common."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from blf_dsc_controller.analysis.style import (
    ALARM,
    BLUE,
    COLOURS,
    INK,
    MUTED,
    ORANGE,
    Picture,
    head,
)
from blf_dsc_controller.monte_carlo.runs import KEPT, Columns, error_columns
from blf_dsc_controller.monte_carlo.statistics import (
    ALLOWED,
    LAWS,
    influence,
    worst_of,
    worst_ratio,
)
from blf_dsc_controller.monte_carlo.study import WITHOUT, Study
from blf_dsc_controller.run import Floats

_PANEL = (6.2, 3.4)  # inches
_MOST_BINS = 60
_PANELS_OF_INFLUENCE = 6
_MOST_DOTS = 20_000
_FEW_DOTS = 1000
_LEAST_ERROR = 1e-6
_FAR = 1.25  # |xi1| / k_c of the last bar, which includes all larger ones
_LEAST_RATIO = 0.03  # smallest |xi1| / k_c drawn beside each other
_FARTHEST = 2.0  # largest |xi1| / k_c drawn; larger ones are clipped
_FEW_DECADES = 50.0
_RATIO = r'max $|\xi_1| \; / \; k_c$'
_PERCENT = FuncFormatter(lambda value, _: f'{100 * value:g} %')


def draw_study(study: Study, results: Columns, folder: Path) -> list[Path]:
    """Draw distributions.png, pairs.png of pairs, influence.png if anything varies."""
    paths = [folder / 'distributions.png']
    _draw_distributions(study, results, paths[0])
    if study.settings.pairs:
        paths.append(folder / 'pairs.png')
        draw_pairs({'': (study, results)}, paths[-1])
    strongest = influence(study, results)
    if strongest:
        paths.append(folder / 'influence.png')
        _draw_influence(study, results, strongest, paths[-1])
    return paths


def _draw_distributions(study: Study, results: Columns, path: Path) -> None:
    runs, kept = results['outcome'].size, int((results['outcome'] == KEPT).sum())
    title = f'{runs} runs: {100 * kept / runs:.4g} % kept the bound'
    picture = Picture(2, 2, title, _PANEL, share_time=False)
    (ratio, tail), (rms, error) = picture.axes
    joints = study.plant.joints

    ratios = {joint: results[f'max_error_ratio.{joint}'] for joint in joints}
    _histogram(ratio, {joint: np.minimum(values, _FAR) for joint, values in ratios.items()})
    ratio.axvline(1.0, color=ALARM, lw=1.4, label='bound')
    ratio.set_xlabel(_RATIO)
    head(ratio, 'largest error')

    worst = np.sort(worst_ratio(study, results))
    fraction = 1.0 - np.arange(worst.size) / worst.size
    finite = np.isfinite(worst)
    tail.loglog(worst[finite], fraction[finite], color=BLUE, drawstyle='steps-pre')
    tail.axvline(1.0, color=ALARM, lw=1.4, label='bound')
    tail.set_ylabel('fraction of runs above')
    tail.yaxis.set_major_formatter(_PERCENT)
    _plain(tail)
    tail.set_xlabel(f'{_RATIO}, worst joint')
    head(tail, 'tail of the largest error')

    _histogram(
        rms, {joint: 1e3 * results[f'rms_error_rad.{joint}'] for joint in joints}, logarithmic=True
    )
    _plain(rms)
    rms.set_xlabel(r'rms $\xi_1$ [mrad]')
    head(rms, f'error from {study.settings.settled_after:g} s on')

    labels = [*(f'{moment:g} s' for moment in study.settings.moments), 'end']
    errors = {
        label: np.maximum(results[name], _LEAST_ERROR)
        for label, name in zip(labels, error_columns(study), strict=True)
    }
    _histogram(error, errors, logarithmic=True)
    error.xaxis.set_major_formatter(_PERCENT)
    error.set_xlabel(r'$\|\hat P - P\| \;/\; \|P\|$')
    head(error, 'relative parameter error')
    picture.save(path)


def draw_pairs(studies: dict[str, tuple[Study, Columns]], path: Path) -> None:
    """Compare studies of pairs, by their titles: errors and learned models, with and without."""
    picture = Picture(
        1, 3, 'The same random runs with learning and without it', (5.2, 4.2), share_time=False
    )
    largest, rms, model = picture.axes[0]
    for (title, (study, results)), colour in zip(studies.items(), COLOURS, strict=False):
        x, y = (worst_of(study, results, 'settled_error_ratio', law) for law in (WITHOUT, ''))
        lost = (results['outcome'] != KEPT) & (results[f'{WITHOUT}outcome'] == KEPT)
        x, y = (np.clip(values, _LEAST_RATIO, _FARTHEST) for values in (x, y))
        chosen = np.flatnonzero(~lost)[:_MOST_DOTS]
        size = 3.0 if chosen.size > _FEW_DOTS else 6.0
        largest.plot(
            x[chosen], y[chosen], '.', ms=size, color=colour, alpha=0.6, mew=0, label=title
        )
        largest.plot(x[lost], y[lost], 'o', ms=5, color=ALARM, mew=0)
    ends = np.array([_LEAST_RATIO, _FARTHEST])
    largest.loglog(ends, ends, color=MUTED, lw=1.0, label='equal')
    largest.loglog(ends, ALLOWED * ends, color=MUTED, lw=1.0, ls=':', label=f'{ALLOWED:g} times')
    largest.axhline(1.0, color=INK, ls='--', lw=1.0, label='bound')
    largest.axvline(1.0, color=INK, ls='--', lw=1.0)
    largest.set_xlabel(f'{_RATIO} without learning')
    largest.set_ylabel('with learning')
    _plain(largest)
    head(largest, 'largest error of each run')
    figures = {
        'rms_error_rad': (rms, 1e3, r'rms $\xi_1$ of the worst joint [mrad]', 'rms error'),
        'torque_error.end': (model, 1e2, 'of the torque [%]', 'model error on the next motion'),
    }
    for name, (axes, unit, label, title) in figures.items():
        _boxes(axes, name, unit, studies)
        axes.set_xlabel(label)
        head(axes, title)
    picture.save(path)


def _boxes(axes: Axes, name: str, unit: float, studies: dict[str, tuple[Study, Columns]]) -> None:
    """Draw the quartiles, and the 1 % and 99 % quantiles, of a figure with and without learning.

    Of the runs that keep the bound without.
    """
    labels: list[str] = []
    for title, (study, results) in studies.items():
        for (law, label), colour in zip(LAWS.items(), (BLUE, ORANGE), strict=True):
            column = f'{law}{name}'
            values = results[column] if column in results else worst_of(study, results, name, law)
            kept = results[f'{WITHOUT}outcome'] == KEPT
            known = unit * values[kept & np.isfinite(values)]
            y = 2 * [-len(labels)]
            if known.size:
                least, *quartiles, most = np.quantile(known, (0.01, 0.25, 0.5, 0.75, 0.99))
                axes.plot([least, most], y, color=colour, lw=1.2)
                axes.plot([quartiles[0], quartiles[2]], y, color=colour, lw=7, alpha=0.6)
                axes.plot(quartiles[1:2], y[:1], 'o', color=INK, ms=4)
            labels.append(f'{title}, {label}'.removeprefix(', '))
    axes.set_yticks(-np.arange(len(labels)), labels)
    axes.set_xscale('log')
    _plain(axes)


def _plain(axes: Axes) -> None:
    """Label a logarithmic axis with plain numbers: decades, and 2 and 5 if they are few."""
    low, high = axes.get_xlim()
    between = '25' if high < _FEW_DECADES * low else ''
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axes.xaxis.set_minor_formatter(
        FuncFormatter(lambda value, _: f'{value:g}' if f'{value:e}'[0] in between else '')
    )


def _histogram(axes: Axes, columns: dict[str, Floats], *, logarithmic: bool = False) -> None:
    """Draw the outlines of several distributions over common bins."""
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
    axes.yaxis.set_major_formatter(_PERCENT)
    axes.set_ylabel('fraction of runs')


def _draw_influence(
    study: Study, results: Columns, influences: dict[str, float], path: Path
) -> None:
    strongest = list(influences.items())[:_PANELS_OF_INFLUENCE]
    columns = min(3, len(strongest))
    rows = -(-len(strongest) // columns)
    title = 'What the largest error depends on most'
    picture = Picture(rows, columns, title, (4.4, 3.2), share_time=False)
    worst = worst_ratio(study, results)
    ratios = np.minimum(worst, _FARTHEST)
    kept = np.flatnonzero(results['outcome'] == KEPT)
    kept = kept[:: -(-kept.size // _MOST_DOTS) or 1]
    lost = results['outcome'] != KEPT
    beyond = worst > _FARTHEST
    size, opacity = (5.0, 0.5) if kept.size < _FEW_DOTS else (2.5, 0.25)
    distributions = {one.column: one.distribution for one in study.variations}
    for axes, (name, fraction) in zip(picture.axes.flat, strongest, strict=False):
        values = results[f'plant.{name}']
        axes.plot(values[kept], ratios[kept], '.', ms=size, color=BLUE, alpha=opacity, mew=0)
        axes.plot(values[lost], ratios[lost], '.', ms=6, color=ALARM, mew=0)
        axes.plot(values[beyond], ratios[beyond], '^', ms=7, color=ALARM, mew=0)
        if distributions[f'plant.{name}'].name == 'loguniform':
            axes.set_xscale('log')
        axes.axhline(1.0, color=INK, lw=1.0, ls='--')
        axes.set_xlabel(name, color=MUTED)
        axes.set_ylabel(_RATIO)
        head(axes, f'explains {100 * fraction:.0f} %')
    for axes in picture.axes.flat[len(strongest) :]:
        axes.set_visible(False)
    picture.save(path)
