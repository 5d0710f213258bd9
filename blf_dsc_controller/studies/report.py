# SPDX-License-Identifier: Apache-2.0
"""Report of a study: summary, pairs with and without learning, repetition."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from blf_dsc_controller.analysis.figures import Picture, head
from blf_dsc_controller.analysis.output import plain
from blf_dsc_controller.analysis.panels import ALARM, BLUE, COLOURS, INK, MUTED, ORANGE
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, dump
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import simulate, write_bag
from blf_dsc_controller.studies.monte_carlo import (
    NOISE,
    STILL,
    WITHOUT,
    Study,
    draw,
    plant_with,
)
from blf_dsc_controller.studies.runs import (
    DIVERGED,
    KEPT,
    OUTCOMES,
    REJECTED,
    Columns,
    Store,
    differences,
    figures_of,
)
from blf_dsc_controller.writing import write_text

Summary = dict[str, Any]
Studies = dict[str, tuple[Study, Columns]]
"""Studies and their results, by title."""

ALLOWED = 1.3
"""Largest allowed error with learning, relative to that without."""

_WORST = 10
_LAWS = {'': 'with', WITHOUT: 'without'}
_FOLDERS = {
    '': '',
    WITHOUT: 'without_learning',
    NOISE: 'other_noise',
    STILL: 'no_adaptation',
}
_FACTORS = {'median': 0.5, 'p99': 0.99, 'p99.9': 0.999, 'max': 1.0}
_NEAR = (0.8, 1.2)  # times the bound
_SHOWN = (0.03, 2.0)  # |xi1| / k_c; what is beyond is drawn at these
_MOST_DOTS = 20_000
_FEW_DECADES = 1e3
_RATIO = r'max $|\xi_1| \; / \; k_c$'


def summarize(study: Study, results: Columns) -> Summary:
    """Return a summary of the results as plain data for JSON; unknown values are None.

    The Wilson interval, unlike p +- z sqrt(p (1 - p) / n), does not shrink to a point
    if all runs kept the bound, and never leaves [0, 1].
    """
    outcomes = results['outcome'].tolist()
    runs, kept = len(outcomes), outcomes.count(KEPT)
    interval = _interval(kept, runs, 'wilson')
    ratios = _worst_of(study, results, 'max_error_ratio')
    pairs = compare_pairs(study, results) if study.settings.pairs else None
    summary: Summary = plain(
        {
            'runs': runs,
            'planned': study.settings.runs,
            'seed': study.settings.seed,
            'duration_s': study.plant.duration,
            'outcomes': {outcome: outcomes.count(outcome) for outcome in OUTCOMES},
            'kept': {
                'fraction': kept / runs,
                'low': interval.low,
                'high': interval.high,
            },
            'pairs': pairs,
            'table': None if pairs is None else _pair_figures(pairs),
            'worst': [
                {
                    'run': int(results['run'][row]),
                    'outcome': outcomes[row],
                    'max_error_ratio': ratios[row],
                    'first_violation_s': results['first_violation_s'][row],
                }
                for row in np.argsort(-ratios, kind='stable')[:_WORST]
            ],
        }
    )
    return summary


def _interval(count: int, runs: int, method: str) -> Any:
    """Return the 95 % interval of a fraction, with its ends `low` and `high`."""
    from scipy.stats import binomtest  # half a second

    return binomtest(count, runs).proportion_ci(0.95, method=method)


def compare_pairs(study: Study, results: Columns) -> Summary:
    """Compare runs with and without learning, and with other sensor noise.

    The latter shows how many exceptions chance makes: of the runs that nothing breaks
    before learning would begin.
    """
    start = study.settings.settled_after
    early = [results[f'{law}first_violation_s'] < start for law in (NOISE, WITHOUT)]
    late = {name: values[~np.any(early, axis=0)] for name, values in results.items()}
    still = _compare(study, results, '', STILL) if study.settings.still else None
    noise = _compare(study, late, NOISE)
    return _compare(study, results, '') | {'noise': noise, 'still': still}


def _compare(study: Study, results: Columns, law: str, other: str = WITHOUT) -> Summary:
    """Compare the runs of a law with those of another one that learns nothing.

    `law` and `other` are the prefixes of their columns. `factor` has quantiles of the largest
    settled error of the law over that of the other. It and the medians are of the runs in
    which the other keeps the bound. `near` counts the runs in which the other comes near the
    bound, and the largest errors of the two differ by at least 1 %.
    """
    kept = results[f'{law}outcome'] == KEPT
    without = results[f'{other}outcome'] == KEPT
    settled = _worst_of(study, results, 'settled_error_ratio', law)
    before = _worst_of(study, results, 'settled_error_ratio', other)
    factors = settled[without] / before[without]
    above = np.flatnonzero(~(factors <= ALLOWED))
    worst_first = above[np.argsort(-factors[above])]
    return {
        'near': _near_the_bound(study, results, law, other),
        'kept': {'with': int(kept.sum()), 'without': int(without.sum())},
        'broken_only_with': results['run'][without & ~kept].tolist(),
        'broken_only_without': results['run'][kept & ~without].tolist(),
        'factor': _factor_quantiles(factors),
        'allowed': 1.0 - above.size / max(1, factors.size),
        'above': results['run'][without][worst_first].tolist(),
        'median': {
            name: {
                'with': _median(_known(study, results, name, law, other)),
                'without': _median(_known(study, results, name, other, other)),
            }
            for name in ('rms_error_rad', 'torque_error.end')
        },
    }


def _near_the_bound(
    study: Study, results: Columns, law: str, other: str
) -> dict[str, int]:
    """Count the runs near the bound without, whose error is larger or smaller with."""
    largest = _worst_of(study, results, 'max_error_ratio', law)
    before = _worst_of(study, results, 'max_error_ratio', other)
    near = (_NEAR[0] <= before) & (before <= _NEAR[1])
    change = largest[near] / before[near]
    return {
        'larger': int((change >= 1.01).sum()),
        'smaller': int((change <= 0.99).sum()),
    }


def _factor_quantiles(factors: Floats) -> dict[str, float]:
    """Return the quantiles of `_FACTORS`; NaN without a factor."""
    of = factors if factors.size else [np.nan]
    quantiles = np.quantile(of, [*_FACTORS.values()], method='higher')
    return dict(zip(_FACTORS, quantiles, strict=True))


def _median(values: Floats) -> float:
    """Return the median; NaN without a value."""
    return float(np.median(values)) if values.size else np.nan


def _worst_of(study: Study, results: Columns, name: str, law: str = '') -> Floats:
    """Return a figure of the worst joint in each run; infinite if it diverged."""
    each = [results[f'{law}{name}.{joint}'] for joint in study.plant.joints]
    lost = np.isin(results[f'{law}outcome'], (DIVERGED, REJECTED))
    return np.where(lost, np.inf, np.max(each, axis=0))


def _known(
    study: Study, results: Columns, name: str, law: str, other: str = WITHOUT
) -> Floats:
    """Return a figure's finite values, of runs in which the `other` law keeps the bound."""
    column = f'{law}{name}'
    values = (
        results[column] if column in results else _worst_of(study, results, name, law)
    )
    kept = results[f'{other}outcome'] == KEPT
    return np.asarray(values[kept & np.isfinite(values)])


def _pair_figures(pairs: Summary) -> dict[str, str]:
    """Return the figures of a comparison of pairs, by their titles."""
    kept = pairs['kept']
    factor = pairs['factor']
    noise = pairs['noise']
    broken = _broken_only(pairs)
    noisy = _broken_only(noise)
    interval = _interval(broken[0], max(1, kept['without']), 'exact')
    return {
        'bound kept with learning / without': f'{kept["with"]} / {kept["without"]}',
        'broken only with / only without': f'{broken[0]} / {broken[1]}',
        'of those kept without, 95 % interval': (
            f'{100.0 * interval.low:.2f} to {100.0 * interval.high:.2f} %'
        ),
        'near the bound: error larger / smaller with': ' / '.join(
            map(str, pairs['near'].values())
        ),
        'largest error at most 1.3 times that without': f'{100.0 * pairs["allowed"]:.2f} %',
        'other noise instead of learning: broken only with / only without, at most 1.3 times': (
            f'{noisy[0]} / {noisy[1]}, {100.0 * noise["allowed"]:.2f} %'
        ),
        'factor: median, 99.9 %, largest': ', '.join(
            f'{factor[name]:.2f}' for name in ('median', 'p99.9', 'max')
        ),
        'rms error with / without [mrad]': _medians(pairs, 'rms_error_rad', 1e3),
        'torque error on the next motion with / without [%]': _medians(
            pairs, 'torque_error.end', 1e2
        ),
    }


def _broken_only(pairs: Summary) -> list[int]:
    """Return how many runs break the bound only with learning, and only without."""
    return [len(pairs[f'broken_only_{law}']) for law in _LAWS.values()]


def _medians(pairs: Summary, name: str, factor: float) -> str:
    """Return the medians of a figure with and without learning, times a factor."""
    values = pairs['median'][name].values()
    return ' / '.join(f'{factor * value:.3g}' for value in values)


def format_report(summary: Summary, folder: Path) -> str:
    """Format a summary for the terminal, with a command to repeat the worst run."""
    outcomes = (
        f'{count} {outcome}' for outcome, count in summary['outcomes'].items() if count
    )
    share, low, high = map(_percent, summary['kept'].values())
    runs = {'the worst': [each['run'] for each in summary['worst']]}
    lines = [
        f'{share} of the runs kept the bound (95 % confidence: {low} to {high})',
        f'outcomes    {", ".join(outcomes)}',
    ]
    if summary['pairs'] is not None:
        lines += [f'{title}: {figure}' for title, figure in summary['table'].items()]
        if summary['pairs']['still'] is not None:
            lines.append(_against_none(summary['pairs']['still']))
        runs['bound broken only with learning'] = summary['pairs']['broken_only_with']
        runs[f'error above {ALLOWED:g} times that without'] = summary['pairs']['above']
    lines += [
        f'{what}: {", ".join(map(str, each))}' for what, each in runs.items() if each
    ]
    worst = runs['the worst'][0]
    out = shlex.quote(f'{folder.name}-run-{worst}')
    command = f'blf_dsc monte-carlo --reproduce {shlex.quote(str(folder))} {worst} --out {out}'
    return '\n'.join([*lines, f'one again   {command}'])


def _against_none(still: Summary) -> str:
    """Return a line about learning against parameters that nothing moves."""
    kept, rms = still['kept'], still['median']['rms_error_rad']
    with_, without = (
        '-' if each is None else f'{1e3 * each:.3g}' for each in rms.values()
    )
    broken = _broken_only(still)
    return (
        'with learning / with neither learning nor adaptation: bound kept '
        f'{kept["with"]} / {kept["without"]}, broken only {broken[0]} / {broken[1]}, '
        f'rms error {with_} / {without} mrad'
    )


def _percent(fraction: float) -> str:
    return f'{100 * fraction:.4g} %'


def write_comparison(stores: Sequence[Store], folder: Path) -> str:
    """Write changes.png and changes.md for studies of pairs; return the table."""
    found = {store.folder.name: (store.study, store.results()) for store in stores}
    rows = []
    for name, (study, results) in found.items():
        if not study.settings.pairs:
            raise BlfDscError(f'{name} holds no pairs: its study needs pairs: true')
        summary = summarize(study, results)
        rows.append({'study': name, 'runs': f'{summary["runs"]}'} | summary['table'])
    _draw_pairs(found, folder / 'changes.png')
    lines = [rows[0], ['---'] * len(rows[0]), *(row.values() for row in rows)]
    text = ''.join(f'| {" | ".join(line)} |\n' for line in lines)
    write_text(folder / 'changes.md', text)
    return text


def reproduce(store: Store, run: str, out: Path) -> None:
    """Repeat the run of this number: write its config.yaml and bag to `out`.

    Those without learning, of a study of pairs, go to `without_learning`, `other_noise`
    and `no_adaptation` in it.

    Raises BlfDscError if the run has no results, or if they are not reproduced bit for
    bit; StartError if the controller rejects its start.
    """
    study, results = store.study, store.results()
    rows = np.flatnonzero(results['run'].astype(str) == run)
    if not rows.size:
        raise BlfDscError(
            f'{store.folder} has no run {run}: it has {results["run"].size} runs'
        )
    for prefix, law in study.laws().items():
        plant = plant_with(study, draw(study, int(run)), prefix)
        folder = out / _FOLDERS[prefix]
        folder.mkdir(exist_ok=True)
        dump(folder / 'config.yaml', {PLANT: plant, CONTROLLER: law})
        record = simulate(law, plant, supervised=False)
        write_bag(folder / 'bag', record)
        here = figures_of(study, record, plant)
        different = differences(
            {name: results[f'{prefix}{name}'][rows[0]] for name in here}, here
        )
        if different:
            raise BlfDscError(
                f'run {run} differs from the stored one: was it computed on another kind of '
                f'machine, or by another version?{different}'
            )


def _draw_pairs(studies: Studies, path: Path) -> None:
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
            _worst_of(study, results, 'settled_error_ratio', law)
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
    """Draw quantiles of a figure with and without learning.

    Of the runs that keep the bound without.
    """
    labels: list[str] = []
    for title, (study, results) in studies.items():
        for (law, label), colour in zip(_LAWS.items(), (BLUE, ORANGE), strict=True):
            known = unit * _known(study, results, name, law)
            y = 2 * [-len(labels)]
            if known.size:
                least, *quartiles, most = np.quantile(
                    known, (0.01, 0.25, 0.5, 0.75, 0.99)
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
