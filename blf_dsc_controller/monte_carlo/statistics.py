# SPDX-License-Identifier: Apache-2.0
"""Statistics of the results of all runs: the content of summary.json."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.stats import binomtest, rankdata

from blf_dsc_controller.monte_carlo.runs import DIVERGED, KEPT, OUTCOMES, Columns
from blf_dsc_controller.monte_carlo.study import WITHOUT, Study
from blf_dsc_controller.run import Floats

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
    figures = [one for one in results if one not in others and not one.startswith(_DRAWN)]
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
        one.column.removeprefix(_DRAWN): _explained(results[one.column], ranks)
        for one in study.variations
        if np.unique(results[one.column]).size > 1
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
