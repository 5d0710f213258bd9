# SPDX-License-Identifier: Apache-2.0
"""Studies of pairs: the same random runs with learning and without it, compared and drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter
from scipy.stats import binomtest

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
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.studies.monte_carlo import NOISE, WITHOUT, Study
from blf_dsc_controller.studies.runs import DIVERGED, KEPT, REJECTED, Columns, Store

ALLOWED = 1.3
"""Largest error with learning that is called no larger than that without, as a factor."""

SHOWN = (0.03, 2.0)
"""|xi1| / k_c; what is beyond is drawn at these."""

RATIO = r'max $|\xi_1| \; / \; k_c$'

_LAWS = {'': 'with', WITHOUT: 'without'}
_FACTORS = {'median': 0.5, 'p99': 0.99, 'p99.9': 0.999, 'max': 1.0}
_NEAR = (0.8, 1.2)  # times the bound
_MOST_DOTS = 20_000
_FEW_DECADES = 1e3


def compare_pairs(study: Study, results: Columns) -> dict[str, Any]:
    """Compare the runs with learning to those without it, and these to other sensor noise.

    The latter shows how many exceptions chance makes: of the runs that nothing breaks before
    learning would begin.
    """
    start = study.settings.settled_after
    early = [results[f'{law}first_violation_s'] < start for law in (NOISE, WITHOUT)]
    late = {name: values[~np.any(early, axis=0)] for name, values in results.items()}
    return _compare(study, results, '') | {'noise': _compare(study, late, NOISE)}


def _compare(study: Study, results: Columns, law: str) -> dict[str, Any]:
    """Compare the runs of a law, by its prefix, with those without learning.

    `factor` is the largest settled error with it over that without. It and the medians are of the
    runs that keep the bound without. `near` counts the runs that come near the bound without, with
    a largest error that is at least 1 % larger or smaller with it.
    """
    laws = (law, WITHOUT)
    kept, without = (results[f'{each}outcome'] == KEPT for each in laws)
    settled, settled_without = (
        worst_of(study, results, 'settled_error_ratio', each)[without] for each in laws
    )
    factors = settled / settled_without
    above = np.flatnonzero(~(factors <= ALLOWED))
    of = factors if factors.size else [np.nan]
    quantiles = np.quantile(of, [*_FACTORS.values()], method='higher')
    largest, before = (worst_of(study, results, 'max_error_ratio', each) for each in laws)
    near = (_NEAR[0] <= before) & (before <= _NEAR[1])
    change = largest[near] / before[near]
    return {
        'near': {'larger': int((change >= 1.01).sum()), 'smaller': int((change <= 0.99).sum())},
        'kept': {'with': int(kept.sum()), 'without': int(without.sum())},
        'broken_only_with': results['run'][without & ~kept].tolist(),
        'broken_only_without': results['run'][kept & ~without].tolist(),
        'factor': dict(zip(_FACTORS, quantiles, strict=True)),
        'allowed': 1.0 - above.size / max(1, factors.size),
        'above': results['run'][without][above[np.argsort(-factors[above])]].tolist(),
        'median': {
            name: {
                label: _median(_known(study, results, name, each))
                for each, label in zip(laws, _LAWS.values(), strict=True)
            }
            for name in ('rms_error_rad', 'torque_error.end')
        },
    }


def worst_of(study: Study, results: Columns, name: str, law: str = '') -> Floats:
    """Return a figure of the worst joint in each run; infinite if it diverged or did not begin."""
    each = [results[f'{law}{name}.{joint}'] for joint in study.plant.joints]
    lost = np.isin(results[f'{law}outcome'], (DIVERGED, REJECTED))
    return np.where(lost, np.inf, np.max(each, axis=0))


def _known(study: Study, results: Columns, name: str, law: str) -> Floats:
    """Return the finite values of a figure, of the runs that keep the bound without learning."""
    column = f'{law}{name}'
    values = results[column] if column in results else worst_of(study, results, name, law)
    kept = results[f'{WITHOUT}outcome'] == KEPT
    return np.asarray(values[kept & np.isfinite(values)])


def _median(values: Floats) -> float:
    return float(np.median(values)) if values.size else np.nan


def pair_figures(pairs: dict[str, Any]) -> dict[str, str]:
    """Return the figures of a comparison of pairs, by their titles."""
    kept, factor, noise = pairs['kept'], pairs['factor'], pairs['noise']
    broken, noisy = (
        [len(each[f'broken_only_{law}']) for law in _LAWS.values()] for each in (pairs, noise)
    )
    interval = binomtest(broken[0], max(1, kept['without'])).proportion_ci(method='exact')

    def medians(name: str, unit: float) -> str:
        return ' / '.join(f'{unit * value:.3g}' for value in pairs['median'][name].values())

    return {
        'bound kept with learning / without': f'{kept["with"]} / {kept["without"]}',
        'broken only with / only without': f'{broken[0]} / {broken[1]}',
        'of those kept without, 95 % interval': (
            f'{100.0 * interval.low:.2f} to {100.0 * interval.high:.2f} %'
        ),
        'near the bound: error larger / smaller with': ' / '.join(map(str, pairs['near'].values())),
        'largest error at most 1.3 times that without': f'{100.0 * pairs["allowed"]:.2f} %',
        'other noise instead of learning: broken only with / only without, at most 1.3 times': (
            f'{noisy[0]} / {noisy[1]}, {100.0 * noise["allowed"]:.2f} %'
        ),
        'factor: median, 99.9 %, largest': ', '.join(
            f'{factor[name]:.2f}' for name in ('median', 'p99.9', 'max')
        ),
        'rms error with / without [mrad]': medians('rms_error_rad', 1e3),
        'torque error on the next motion with / without [%]': medians('torque_error.end', 1e2),
    }


def write_comparison(stores: Sequence[Store], folder: Path) -> str:
    """Write changes.png and changes.md, studies of pairs side by side; return the table in it."""
    found = {store.folder.name: (store.study, store.results()) for store in stores}
    rows = []
    for name, (study, results) in found.items():
        if not study.settings.pairs:
            raise BlfDscError(f'{name} holds no pairs: its study needs pairs: true')
        figures = pair_figures(compare_pairs(study, results))
        rows.append({'study': name, 'runs': f'{results["run"].size}'} | figures)
    draw_pairs(found, folder / 'changes.png')
    lines = [rows[0], ['---'] * len(rows[0]), *(row.values() for row in rows)]
    text = ''.join(f'| {" | ".join(line)} |\n' for line in lines)
    (folder / 'changes.md').write_text(text, encoding='utf-8')
    return text


def draw_pairs(studies: dict[str, tuple[Study, Columns]], path: Path) -> None:
    """Compare studies of pairs, by their titles: errors and learned models, with and without."""
    picture = Picture(
        1, 3, 'The same random runs with learning and without it', (5.2, 4.2), share_time=False
    )
    largest, rms, model = picture.axes[0]
    for (title, (study, results)), colour in zip(studies.items(), COLOURS, strict=False):
        x, y = (worst_of(study, results, 'settled_error_ratio', law) for law in (WITHOUT, ''))
        lost = (results['outcome'] != KEPT) & (results[f'{WITHOUT}outcome'] == KEPT)
        x, y = (np.clip(values, *SHOWN) for values in (x, y))
        chosen = np.flatnonzero(~lost)[:_MOST_DOTS]
        largest.plot(x[chosen], y[chosen], '.', ms=4, color=colour, alpha=0.6, mew=0, label=title)
        largest.plot(x[lost], y[lost], 'o', ms=5, color=ALARM, mew=0)
    ends = np.array(SHOWN)
    largest.loglog(ends, ends, color=MUTED, lw=1.0, label='equal')
    largest.loglog(ends, ALLOWED * ends, color=MUTED, lw=1.0, ls=':', label=f'{ALLOWED:g} times')
    logarithmic(largest, both=True)
    largest.axhline(1.0, color=INK, ls='--', lw=1.0, label='bound')
    largest.axvline(1.0, color=INK, ls='--', lw=1.0)
    largest.set_xlabel(f'{RATIO} without learning')
    largest.set_ylabel('with learning')
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
        for (law, label), colour in zip(_LAWS.items(), (BLUE, ORANGE), strict=True):
            known = unit * _known(study, results, name, law)
            y = 2 * [-len(labels)]
            if known.size:
                least, *quartiles, most = np.quantile(known, (0.01, 0.25, 0.5, 0.75, 0.99))
                axes.plot([least, most], y, color=colour, lw=1.2)
                axes.plot([quartiles[0], quartiles[2]], y, color=colour, lw=7, alpha=0.6)
                axes.plot(quartiles[1:2], y[:1], 'o', color=INK, ms=4)
            labels.append(f'{title}, {label}'.removeprefix(', '))
    axes.set_yticks(-np.arange(len(labels)), labels)
    logarithmic(axes)


def logarithmic(axes: Axes, *, both: bool = False) -> None:
    """Make the x axis, or both, of drawn data logarithmic, with plain numbers at 1, or 1, 2, 5."""
    axes.set_xscale('log')
    for axis in (axes.xaxis, axes.yaxis)[: 1 + both]:
        low, high = axis.get_view_interval()
        axis.set_major_locator(
            LogLocator(subs=(1.0, 2.0, 5.0) if high < _FEW_DECADES * low else (1.0,))
        )
        axis.set_major_formatter('{x:g}')
        axis.set_minor_formatter(NullFormatter())
