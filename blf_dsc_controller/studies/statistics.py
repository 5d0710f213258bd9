# SPDX-License-Identifier: Apache-2.0
"""Statistics of the results of all runs (the content of summary.json), and their pictures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter
from scipy.stats import binomtest, rankdata

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
from blf_dsc_controller.run import Floats
from blf_dsc_controller.studies.monte_carlo import WITHOUT, Study
from blf_dsc_controller.studies.runs import DIVERGED, KEPT, OUTCOMES, Columns, error_columns

Summary = dict[str, Any]

_CONFIDENCE = 0.95
_WORST = 10
_GROUPS = 10
_QUANTILES = {'min': 0.0, 'p5': 0.05, 'median': 0.5, 'p95': 0.95, 'p99': 0.99, 'max': 1.0}
_FACTORS = {'median': 0.5, 'p99': 0.99, 'p99.9': 0.999, 'max': 1.0}
_DRAWN = 'plant.'

ALLOWED = 1.3
"""Largest error with learning that is called no larger than that without, as a factor."""

LAWS = {'': 'with', WITHOUT: 'without'}
"""The laws of a study of pairs: what they are called, by the prefix of their columns."""

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


def summarize(study: Study, results: Columns) -> Summary:
    """Return a summary of the results as plain data for JSON; unknown values are None.

    The Wilson interval, unlike p +- z sqrt(p (1 - p) / n), does not shrink to a point if all runs
    kept the bound, and never leaves [0, 1].
    """
    outcomes = results['outcome']
    runs = outcomes.size
    kept = int((outcomes == KEPT).sum())
    interval = binomtest(kept, runs).proportion_ci(_CONFIDENCE, method='wilson')
    others = ('run', 'seed', 'outcome', f'{WITHOUT}outcome')
    figures = [name for name in results if name not in others and not name.startswith(_DRAWN)]
    return {
        'runs': runs,
        'planned': study.settings.runs,
        'seed': study.settings.seed,
        'duration_s': study.plant.duration,
        'outcomes': {outcome: int((outcomes == outcome).sum()) for outcome in OUTCOMES},
        'kept': {
            'fraction': kept / runs,
            'low': float(interval.low),
            'high': float(interval.high),
            'confidence': _CONFIDENCE,
            'interval': 'Wilson',
        },
        'pairs': compare(study, results) if study.settings.pairs else None,
        'figures': {name: _quantiles(results[name]) for name in figures},
        'influence': influence(study, results),
        'worst': [_one_run(study, results, row) for row in worst_first(study, results)[:_WORST]],
    }


def compare(study: Study, results: Columns) -> Summary:
    """Compare the runs of a study of pairs, with learning and without it.

    `factor` is the largest settled error with learning over that without; None: infinite. It and
    the medians are of the runs that keep the bound without.
    """
    kept, without = (results[f'{law}outcome'] == KEPT for law in LAWS)
    factors = error_factor(study, results)[without]
    above = np.flatnonzero(~(factors <= ALLOWED))
    quantiles = np.quantile(factors, list(_FACTORS.values()), method='higher')
    return {
        'kept': {'with': int(kept.sum()), 'without': int(without.sum())},
        'broken_only_with': results['run'][without & ~kept].tolist(),
        'broken_only_without': results['run'][kept & ~without].tolist(),
        'factor': {
            name: factor if math.isfinite(factor) else None
            for name, factor in zip(_FACTORS, quantiles.tolist(), strict=True)
        },
        'allowed': ALLOWED,
        'above': results['run'][without][above[np.argsort(-factors[above])]].tolist(),
        'median': {
            'rms_error_rad': {
                label: _median(worst_of(study, results, 'rms_error_rad', law)[without])
                for law, label in LAWS.items()
            },
            'torque_error': {
                label: _median(results[f'{law}torque_error.end'][without])
                for law, label in LAWS.items()
            },
        },
    }


def error_factor(study: Study, results: Columns) -> Floats:
    """Return the largest settled error of each run with learning over that without."""
    name = 'settled_error_ratio'
    return worst_of(study, results, name) / worst_of(study, results, name, WITHOUT)


def worst_of(study: Study, results: Columns, name: str, law: str = '') -> Floats:
    """Return a figure of the worst joint in each run; infinite if the run diverged."""
    each = [results[f'{law}{name}.{joint}'] for joint in study.plant.joints]
    return np.where(results[f'{law}outcome'] == DIVERGED, np.inf, np.max(each, axis=0))


def worst_ratio(study: Study, results: Columns) -> Floats:
    """Return the largest |xi1| / k_c of any joint in each run; infinite if the run diverged."""
    return worst_of(study, results, 'max_error_ratio')


def worst_first(study: Study, results: Columns) -> np.ndarray:
    """Return the rows of the results, largest |xi1| / k_c first; ties in the order of the runs."""
    return np.argsort(-worst_ratio(study, results), kind='stable')


def influence(study: Study, results: Columns) -> dict[str, float]:
    """Return the fraction of the variance of the largest |xi1| / k_c due to each drawn number.

    This is the correlation ratio of the ranks over groups of equal size, corrected for chance:
    unlike a correlation, it also shows if both ends of a range are bad. Strongest first; numbers
    that are the same in all runs are left out.
    """
    ranks = rankdata(worst_ratio(study, results))
    found = {
        variation.column.removeprefix(_DRAWN): _explained(results[variation.column], ranks)
        for variation in study.variations
        if np.unique(results[variation.column]).size > 1
    }
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _explained(values: np.ndarray, ranks: Floats) -> float:
    groups = np.unique(values, return_inverse=True)[1]
    if groups.max() >= _GROUPS:
        groups = np.minimum(_GROUPS * rankdata(values) / (values.size + 1), _GROUPS - 1).astype(int)
    counts = np.bincount(groups)
    within = ranks.var() * ranks.size
    within -= float((np.bincount(groups, ranks) ** 2 / np.maximum(counts, 1)).sum())
    within += ranks.size * ranks.mean() ** 2
    freedom = ranks.size - np.count_nonzero(counts)
    if freedom <= 0 or ranks.var() == 0.0:
        return 0.0
    return max(0.0, float(1.0 - (within / freedom) / ranks.var(ddof=1)))


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _quantiles(values: np.ndarray) -> Summary | None:
    known = values[np.isfinite(values)]
    if known.size == 0:
        return None
    quantiles = {name: float(np.quantile(known, q)) for name, q in _QUANTILES.items()}
    return {**quantiles, 'known': int(known.size)}


def _one_run(study: Study, results: Columns, row: int) -> Summary:
    run = {name: np.asarray(values[row]).item() for name, values in results.items()}
    ratios = {joint: run[f'max_error_ratio.{joint}'] for joint in study.plant.joints}
    violation = run['first_violation_s']
    drawn = {name.removeprefix(_DRAWN): run[name] for name in run if name.startswith(_DRAWN)}
    return {
        'run': run['run'],
        'outcome': run['outcome'],
        'max_error_ratio': {
            joint: ratio if math.isfinite(ratio) else None for joint, ratio in ratios.items()
        },
        'first_violation_s': None if math.isnan(violation) else violation,
        'drawn': drawn,
    }


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
    distributions = {variation.column: variation.distribution for variation in study.variations}
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
