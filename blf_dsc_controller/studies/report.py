# SPDX-License-Identifier: Apache-2.0
"""Report of a study in its folder: statistics of all runs, pictures, a page; and one run again."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from scipy.stats import binomtest, kruskal, rankdata

from blf_dsc_controller.analysis.figures import draw as draw_run
from blf_dsc_controller.analysis.style import (
    ALARM,
    BLUE,
    COLOURS,
    INK,
    MUTED,
    ORANGE,
    Cell,
    Picture,
    head,
    write_page,
)
from blf_dsc_controller.analysis.summary import plain, write_summary
from blf_dsc_controller.analysis.summary import summarize as summarize_run
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, dump
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import WITHOUT, Study, draw, plant_with
from blf_dsc_controller.studies.runs import (
    DIVERGED,
    KEPT,
    OUTCOMES,
    Columns,
    Store,
    differences,
    error_columns,
    figures_of,
    rows_of_another_motion,
)

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

_NEAR = (0.8, 1.2)  # times the bound
_MOST_DOTS = 20_000
_SHOWN = (0.03, 2.0)  # |xi1| / k_c; what is beyond is drawn at these
_FEW_DECADES = 1e3
_RATIO = r'max $|\xi_1| \; / \; k_c$'
_MODEL = r'$\|\hat P - P\| \;/\; \|P\|$ [%]'
_PERCENT = FuncFormatter(lambda value, _: f'{100 * value:g} %')


def summarize(study: Study, results: Columns) -> Summary:
    """Return a summary of the results as plain data for JSON; unknown values are None.

    The Wilson interval, unlike p +- z sqrt(p (1 - p) / n), does not shrink to a point if all runs
    kept the bound, and never leaves [0, 1].
    """
    outcomes = results['outcome'].tolist()
    runs, kept = len(outcomes), outcomes.count(KEPT)
    interval = binomtest(kept, runs).proportion_ci(_CONFIDENCE, method='wilson')
    others = ('run', 'seed', 'outcome', f'{WITHOUT}outcome')
    figures = [name for name in results if name not in others and not name.startswith(_DRAWN)]
    worst = [
        {
            'run': int(results['run'][row]),
            'outcome': outcomes[row],
            'max_error_ratio': {
                joint: results[f'max_error_ratio.{joint}'][row] for joint in study.plant.joints
            },
            'first_violation_s': results['first_violation_s'][row],
        }
        for row in worst_first(study, results)[:_WORST]
    ]
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
                'confidence': _CONFIDENCE,
                'interval': 'Wilson',
            },
            'pairs': compare(study, results) if study.settings.pairs else None,
            'figures': {name: _quantiles(results[name]) for name in figures},
            'influence': influence(study, results),
            'worst': worst,
        }
    )
    return summary


def compare(study: Study, results: Columns) -> Summary:
    """Compare the runs of a study of pairs, with learning and without it.

    `factor` is the largest settled error with learning over that without; None: infinite. It and
    the medians are of the runs that keep the bound without. `near` counts the runs that come near
    the bound without learning, with a largest error that is at least 1 % larger or smaller with it.
    """

    def both(name: str) -> list[Floats]:
        return [worst_of(study, results, name, law) for law in LAWS]

    kept, without = (results[f'{law}outcome'] == KEPT for law in LAWS)
    settled, settled_without = both('settled_error_ratio')
    factors = (settled / settled_without)[without]
    above = np.flatnonzero(~(factors <= ALLOWED))
    quantiles = np.quantile(factors, list(_FACTORS.values()), method='higher')
    largest, before = both('max_error_ratio')
    change = (largest / before)[(_NEAR[0] <= before) & (before <= _NEAR[1])]
    medians = {
        'rms_error_rad': both('rms_error_rad'),
        'torque_error': [results[f'{law}torque_error.end'] for law in LAWS],
    }
    return {
        'near': {'larger': int((change >= 1.01).sum()), 'smaller': int((change <= 0.99).sum())},
        'kept': {'with': int(kept.sum()), 'without': int(without.sum())},
        'broken_only_with': results['run'][without & ~kept].tolist(),
        'broken_only_without': results['run'][kept & ~without].tolist(),
        'factor': dict(zip(_FACTORS, quantiles.tolist(), strict=True)),
        'allowed': ALLOWED,
        'above': results['run'][without][above[np.argsort(-factors[above])]].tolist(),
        'median': {
            name: {
                label: np.median(known) if (known := _finite(values[without])).size else None
                for label, values in zip(LAWS.values(), each, strict=True)
            }
            for name, each in medians.items()
        },
    }


def worst_of(study: Study, results: Columns, name: str, law: str = '') -> Floats:
    """Return a figure of the worst joint in each run; infinite if the run diverged."""
    each = [results[f'{law}{name}.{joint}'] for joint in study.plant.joints]
    return np.where(results[f'{law}outcome'] == DIVERGED, np.inf, np.max(each, axis=0))


def worst_first(study: Study, results: Columns) -> np.ndarray:
    """Return the rows of the results, largest |xi1| / k_c first; ties in the order of the runs."""
    return np.argsort(-worst_of(study, results, 'max_error_ratio'), kind='stable')


def influence(study: Study, results: Columns) -> dict[str, float]:
    """Return the fraction of the variance of the largest |xi1| / k_c due to each drawn number.

    This is the correlation ratio of the ranks over groups of equal size, corrected for chance, from
    the statistic of Kruskal and Wallis: unlike a correlation, it also shows if both ends of a range
    are bad. Strongest first; numbers that are the same in all runs are left out.
    """
    ratios = worst_of(study, results, 'max_error_ratio')
    found = {
        variation.column.removeprefix(_DRAWN): _explained(results[variation.column], ratios)
        for variation in study.variations
        if np.unique(results[variation.column]).size > 1
    }
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _explained(values: np.ndarray, ratios: Floats) -> float:
    groups = np.unique(values, return_inverse=True)[1]
    if groups.max() >= _GROUPS:
        groups = (_GROUPS * rankdata(values) / (values.size + 1)).astype(int)
    parts = [ratios[groups == group] for group in np.unique(groups)]
    freedom = ratios.size - len(parts)
    if freedom <= 0 or np.unique(ratios).size == 1:
        return 0.0
    H = kruskal(*parts).statistic  # n - 1 times the correlation ratio of the ranks
    return max(0.0, float(1.0 - (ratios.size - 1 - H) / freedom))


def _finite(values: Floats) -> Floats:
    return values[np.isfinite(values)]


def _quantiles(values: Floats) -> Summary | None:
    known = _finite(values)
    if known.size == 0:
        return None
    quantiles = np.quantile(known, list(_QUANTILES.values())).tolist()
    return {**dict(zip(_QUANTILES, quantiles, strict=True)), 'known': known.size}


def write_report(store: Store) -> tuple[Summary, list[Path]]:
    """Write report.html with its figures, and summary.json, of the finished runs.

    Returns the summary and the paths; raises BlfDscError if there are no results yet.
    """
    study, results, folder = store.study, store.results(), store.folder
    summary = summarize(study, results)
    figures = [folder / 'distributions.png']
    _draw_distributions(study, results, figures[0])
    if study.settings.pairs:
        figures.append(folder / 'pairs.png')
        draw_pairs({'': (study, results)}, figures[-1])
    tables = _tables(study, summary, folder)
    title = f'Monte Carlo study: {summary["runs"]} runs of {summary["duration_s"]:g} s'
    page, numbers = folder / 'report.html', folder / 'summary.json'
    values = {'headline': headline(summary), 'summary': summary, 'figures': figures}
    write_page(page, 'study.html', title, **values, **tables)
    write_summary(summary, numbers)
    return summary, [page, *figures, numbers]


def _tables(study: Study, summary: Summary, folder: Path) -> dict[str, list[Any]]:
    """Return the rows of the tables of the page."""
    return {
        'outcomes': [(name, f'{n}', OUTCOMES[name]) for name, n in summary['outcomes'].items()],
        'quantiles': [
            ('', *_QUANTILES),
            *(
                (Cell(name, 'code'), *(_number(values[quantile]) for quantile in _QUANTILES))
                for name, values in summary['figures'].items()
                if values is not None
            ),
        ],
        'worst': [
            (
                f'{run["run"]}',
                run['outcome'],
                ', '.join(_number(ratio) for ratio in run['max_error_ratio'].values()),
                _number(run['first_violation_s']),
                Cell(reproduce_command(folder, run['run']), 'code'),
            )
            for run in summary['worst']
        ],
        'exceptions': [
            (run, what, Cell(command, 'code'))
            for run, what, command in exceptions(summary['pairs'], folder)
        ],
        'varied': [
            (
                Cell(name := variation.column.removeprefix(_DRAWN), 'code'),
                Cell(f'{variation.distribution}', 'code'),
                _percent(summary['influence'].get(name, 0.0)),
            )
            for variation in study.variations
        ],
    }


def exceptions(pairs: Summary | None, folder: Path) -> list[tuple[str, str, str]]:
    """Return the run, what is wrong with it and its command for each exception of a comparison."""
    if pairs is None:
        return []
    broken = pairs['broken_only_with']
    above = [run for run in pairs['above'] if run not in broken]
    what = f'largest error more than {ALLOWED:g} times that without learning'
    return [
        (f'{run}', words, reproduce_command(folder, run))
        for runs, words in ((broken, 'breaks the bound only with learning'), (above, what))
        for run in runs
    ]


def headline(summary: Summary) -> str:
    """Return the result in one sentence; of pairs, in three."""
    kept, pairs = summary['kept'], summary['pairs']
    text = (
        f'{_percent(kept["fraction"])} of the runs kept the bound '
        f'({summary["outcomes"]["kept"]} of {summary["runs"]}; {100 * kept["confidence"]:g} % '
        f'confidence: {_percent(kept["low"])} to {_percent(kept["high"])})'
    )
    if pairs is None:
        return text
    without, factor = pairs['kept']['without'], pairs['factor']
    return (
        f'{text}, {without} without learning. {len(pairs["broken_only_with"])} broke it only with '
        f'learning, {len(pairs["broken_only_without"])} only without. Of the {without}, the '
        f'largest error was at most {ALLOWED:g} times that without learning in '
        f'{_percent(1.0 - len(pairs["above"]) / max(1, without))} (99.9 %: '
        f'{_number(factor["p99.9"])} times, largest: {_number(factor["max"])})'
    )


def reproduce_command(folder: Path, run: int) -> str:
    """Return the command that repeats a run and records it."""
    out = shlex.quote(f'{folder.name}-run-{run}')
    return f'blf_dsc monte-carlo --reproduce {shlex.quote(str(folder))} {run} --out {out}'


def reproduce(store: Store, run: int, out: Path) -> Summary:
    """Repeat a run of the study and write config.yaml, bag, figures and summary to `out`.

    The one without learning, of a study of pairs, goes to `out/without_learning`.

    Raises BlfDscError if the run has no results, or if they are not reproduced bit for bit;
    StartError if the controller rejects its start.
    """
    study, results = store.study, store.results()
    if run not in results['run']:
        raise BlfDscError(f'{store.folder} has no run {run}: it has {results["run"].size} runs')
    row = int((results['run'] == run).argmax())
    plant, unseen = plant_with(study, draw(study, run)), rows_of_another_motion(study)
    summaries = []
    for prefix, law in study.laws().items():
        folder = out / 'without_learning' if prefix else out
        folder.mkdir(exist_ok=True)
        dump(folder / 'config.yaml', {PLANT: plant, CONTROLLER: law})
        record = simulate(law, plant, supervised=False)
        write_bag(folder / 'bag', record, law, 'none')
        recorded = read_run(folder / 'bag')
        summaries.append(summarize_run(recorded))
        write_summary(summaries[-1], folder / 'summary.json')
        draw_run(recorded, folder)
        here = figures_of(study, record, plant, unseen)
        different = differences({name: results[f'{prefix}{name}'][row] for name in here}, here)
        if different:
            raise BlfDscError(
                f'run {run} differs from the stored one: was it computed on another kind of '
                f'machine, or by another version?{different}'
            )
    return summaries[0]


def _number(value: float | None) -> str:
    return '-' if value is None else f'{value:.4g}'


def _percent(fraction: float) -> str:
    return f'{100 * fraction:.4g} %'


def _draw_distributions(study: Study, results: Columns, path: Path) -> None:
    """Draw the fraction of runs up to each error: largest, rms, and of the parameters."""
    share = _percent(np.mean(results['outcome'] == KEPT))
    title = f'{results["outcome"].size} runs: {share} kept the bound'
    picture = Picture(1, 3, title, (5.2, 3.6), share_time=False)
    moments = [*(f'{moment:g} s' for moment in study.settings.moments), 'end']
    settled = f'error from {study.settings.settled_after:g} s on'
    for axes, name, unit, label, title in (
        (picture.axes[0, 0], 'max_error_ratio', 1.0, _RATIO, 'largest error'),
        (picture.axes[0, 1], 'rms_error_rad', 1e3, r'rms $\xi_1$ [mrad]', settled),
        (picture.axes[0, 2], '', 1e2, _MODEL, 'relative parameter error'),
    ):
        columns = {joint: f'{name}.{joint}' for joint in study.plant.joints}
        if not name:
            columns = dict(zip(moments, error_columns(study), strict=True))
        for (text, column), colour in zip(columns.items(), COLOURS, strict=False):
            known = np.sort(unit * _finite(results[column]))
            if label == _RATIO:
                known = np.minimum(known, _SHOWN[1])
            axes.plot(known, np.linspace(0.0, 1.0, known.size), color=colour, label=text)
        _logarithmic(axes)
        axes.yaxis.set_major_formatter(_PERCENT)
        axes.set_xlabel(label)
        axes.set_ylabel('fraction of runs below')
        head(axes, title)
    picture.axes[0, 0].axvline(1.0, color=ALARM, lw=1.4)
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
        x, y = (np.clip(values, *_SHOWN) for values in (x, y))
        chosen = np.flatnonzero(~lost)[:_MOST_DOTS]
        largest.plot(x[chosen], y[chosen], '.', ms=4, color=colour, alpha=0.6, mew=0, label=title)
        largest.plot(x[lost], y[lost], 'o', ms=5, color=ALARM, mew=0)
    ends = np.array(_SHOWN)
    largest.loglog(ends, ends, color=MUTED, lw=1.0, label='equal')
    largest.loglog(ends, ALLOWED * ends, color=MUTED, lw=1.0, ls=':', label=f'{ALLOWED:g} times')
    _logarithmic(largest, both=True)
    largest.axhline(1.0, color=INK, ls='--', lw=1.0, label='bound')
    largest.axvline(1.0, color=INK, ls='--', lw=1.0)
    largest.set_xlabel(f'{_RATIO} without learning')
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
    _logarithmic(axes)


def _logarithmic(axes: Axes, *, both: bool = False) -> None:
    """Make the x axis, or both, of drawn data logarithmic, with plain numbers at 1, or 1, 2, 5."""
    axes.set_xscale('log')
    for axis in (axes.xaxis, axes.yaxis)[: 1 + both]:
        low, high = axis.get_view_interval()
        subs = (1.0, 2.0, 5.0) if high < _FEW_DECADES * low else (1.0,)
        axis.set_major_locator(LogLocator(subs=subs))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
        axis.set_minor_formatter(NullFormatter())
