# SPDX-License-Identifier: Apache-2.0
"""Report of a study in its folder: statistics of all runs, pictures, a page; and one run again."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import PercentFormatter
from scipy.stats import binomtest, kruskal, rankdata

from blf_dsc_controller.analysis.figures import draw as draw_run
from blf_dsc_controller.analysis.style import ALARM, COLOURS, Cell, Picture, head, write_page
from blf_dsc_controller.analysis.summary import plain, write_summary
from blf_dsc_controller.analysis.summary import summarize as summarize_run
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, dump
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import NOISE, WITHOUT, Study, draw, plant_with
from blf_dsc_controller.studies.pairs import (
    ALLOWED,
    RATIO,
    SHOWN,
    compare_pairs,
    draw_pairs,
    logarithmic,
    pair_figures,
    worst_of,
)
from blf_dsc_controller.studies.runs import (
    KEPT,
    OUTCOMES,
    Columns,
    Store,
    differences,
    figures_of,
    rows_of_another_motion,
)

Summary = dict[str, Any]

_WORST = 10
_GROUPS = 10
_QUANTILES = {'min': 0.0, 'p5': 0.05, 'median': 0.5, 'p95': 0.95, 'p99': 0.99, 'max': 1.0}
_DRAWN = 'plant.'
_FOLDERS = {'': '', WITHOUT: 'without_learning', NOISE: 'other_noise'}
_RMS = r'rms $\xi_1$ [mrad]'
_MODEL = r'$\|\hat P - P\| \;/\; \|P\|$ [%]'


def summarize(study: Study, results: Columns) -> Summary:
    """Return a summary of the results as plain data for JSON; unknown values are None.

    The Wilson interval, unlike p +- z sqrt(p (1 - p) / n), does not shrink to a point if all runs
    kept the bound, and never leaves [0, 1].
    """
    outcomes = results['outcome'].tolist()
    runs, kept = len(outcomes), outcomes.count(KEPT)
    interval = binomtest(kept, runs).proportion_ci(0.95, method='wilson')
    ratios = worst_of(study, results, 'max_error_ratio')
    summary: Summary = plain(
        {
            'runs': runs,
            'planned': study.settings.runs,
            'seed': study.settings.seed,
            'duration_s': study.plant.duration,
            'outcomes': {outcome: outcomes.count(outcome) for outcome in OUTCOMES},
            'kept': {'fraction': kept / runs, 'low': interval.low, 'high': interval.high},
            'pairs': compare_pairs(study, results) if study.settings.pairs else None,
            'figures': {
                name: _quantiles(values)
                for name, values in results.items()
                if values.dtype.kind == 'f' and not name.startswith(_DRAWN)
            },
            'influence': influence(study, results),
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


def _quantiles(values: Floats) -> Summary | None:
    known = values[np.isfinite(values)]
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
    figures, pairs, exceptions = [folder / 'distributions.png'], {}, []
    _draw_distributions(study, results, figures[0])
    if study.settings.pairs:
        figures.append(folder / 'pairs.png')
        draw_pairs({'': (study, results)}, figures[-1])
        found = compare_pairs(study, results)
        pairs, broken = pair_figures(found), found['broken_only_with']
        exceptions = [(run, 'breaks the bound only with learning') for run in broken]
        what = f'largest error more than {ALLOWED:g} times that without learning'
        exceptions += [(run, what) for run in found['above'] if run not in broken]

    def again(run: int) -> Cell:
        return Cell(reproduce_command(folder, run), 'code')

    page, numbers = folder / 'report.html', folder / 'summary.json'
    write_page(
        page,
        'study.html',
        f'Monte Carlo study: {summary["runs"]} runs of {summary["duration_s"]:g} s',
        headline=headline(summary),
        summary=summary,
        figures=figures,
        outcomes=[(name, f'{n}', OUTCOMES[name]) for name, n in summary['outcomes'].items()],
        pairs=[*pairs.items()],
        worst=[
            (
                f'{run["run"]}',
                run['outcome'],
                _number(run['max_error_ratio']),
                _number(run['first_violation_s']),
                again(run['run']),
            )
            for run in summary['worst']
        ],
        exceptions=[(f'{run}', what, again(run)) for run, what in exceptions],
        varied=[
            (
                Cell(name := variation.column.removeprefix(_DRAWN), 'code'),
                Cell(f'{variation.distribution}', 'code'),
                _percent(summary['influence'].get(name, 0.0)),
            )
            for variation in study.variations
        ],
    )
    write_summary(summary, numbers)
    return summary, [page, *figures, numbers]


def headline(summary: Summary) -> str:
    """Return the result in one sentence; of pairs, in two."""
    kept, pairs = summary['kept'], summary['pairs']
    text = (
        f'{_percent(kept["fraction"])} of the runs kept the bound '
        f'({summary["outcomes"][KEPT]} of {summary["runs"]}; 95 % confidence: '
        f'{_percent(kept["low"])} to {_percent(kept["high"])})'
    )
    if pairs is None:
        return text
    return (
        f'{text}, {pairs["kept"]["without"]} without learning. {len(pairs["broken_only_with"])} '
        f'broke it only with learning, {len(pairs["broken_only_without"])} only without'
    )


def reproduce_command(folder: Path, run: int) -> str:
    """Return the command that repeats a run and records it."""
    out = shlex.quote(f'{folder.name}-run-{run}')
    return f'blf_dsc monte-carlo --reproduce {shlex.quote(str(folder))} {run} --out {out}'


def reproduce(store: Store, run: int, out: Path) -> Summary:
    """Repeat a run of the study and write config.yaml, bag, figures and summary to `out`.

    Those without learning, of a study of pairs, go to `without_learning` and `other_noise` in it.

    Raises BlfDscError if the run has no results, or if they are not reproduced bit for bit;
    StartError if the controller rejects its start.
    """
    study, results = store.study, store.results()
    if run not in results['run']:
        raise BlfDscError(f'{store.folder} has no run {run}: it has {results["run"].size} runs')
    row = int((results['run'] == run).argmax())
    unseen = rows_of_another_motion(study)
    summaries = []
    for prefix, law in study.laws().items():
        plant = plant_with(study, draw(study, run), prefix)
        folder = out / _FOLDERS[prefix]
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
    settled = f'error from {study.settings.settled_after:g} s on'
    joints = study.plant.joints
    panels = {
        'largest error': ({f'max_error_ratio.{joint}': joint for joint in joints}, 1.0, RATIO),
        settled: ({f'rms_error_rad.{joint}': joint for joint in joints}, 1e3, _RMS),
        'relative parameter error': ({'parameter_error.end': 'at the end'}, 1e2, _MODEL),
    }
    for axes, (title, (columns, unit, label)) in zip(picture.axes[0], panels.items(), strict=True):
        for (column, text), colour in zip(columns.items(), COLOURS, strict=False):
            known = np.sort(unit * results[column][np.isfinite(results[column])])
            if label == RATIO:
                known = np.minimum(known, SHOWN[1])
            axes.plot(known, np.linspace(0.0, 1.0, known.size), color=colour, label=text)
        logarithmic(axes)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_xlabel(label)
        axes.set_ylabel('fraction of runs below')
        head(axes, title)
    picture.axes[0, 0].axvline(1.0, color=ALARM, lw=1.4)
    picture.save(path)
