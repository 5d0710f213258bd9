# SPDX-License-Identifier: Apache-2.0
"""What the results of all runs say: the content of summary.json."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any

import numpy as np

from blf_dsc_controller.monte_carlo.chunk import Columns
from blf_dsc_controller.monte_carlo.measure import DIVERGED, KEPT, OUTCOMES
from blf_dsc_controller.monte_carlo.study import Study
from blf_dsc_controller.run import Floats

Summary = dict[str, Any]

CONFIDENCE = 0.95
WORST = 10

_GROUPS = 10

_QUANTILES = {'min': 0.0, 'p5': 0.05, 'median': 0.5, 'p95': 0.95, 'p99': 0.99, 'max': 1.0}
_DRAWN = 'plant.'


def wilson(hits: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Interval of Wilson (1927) for a probability of which `hits` of `trials` came true.

    Unlike the textbook's p +- z sqrt(p (1 - p) / n) it does not shrink to a point where all came
    true, and never leaves [0, 1].
    """
    z = NormalDist().inv_cdf(0.5 + 0.5 * confidence)
    share = hits / trials
    middle = share + z * z / (2.0 * trials)
    half = z * math.sqrt(share * (1.0 - share) / trials + (z / (2.0 * trials)) ** 2)
    scale = 1.0 + z * z / trials
    low = 0.0 if hits == 0 else (middle - half) / scale
    high = 1.0 if hits == trials else (middle + half) / scale
    return low, high


def judge(study: Study, results: Columns) -> Summary:
    """Summary of the results as plain data for JSON; what is not known is None."""
    outcomes = results['outcome']
    runs = outcomes.size
    kept = int((outcomes == KEPT).sum())
    low, high = wilson(kept, runs)
    return {
        'runs': runs,
        'planned': study.settings.runs,
        'seed': study.settings.seed,
        'duration_s': study.plant.duration,
        'outcomes': {outcome: int((outcomes == outcome).sum()) for outcome in OUTCOMES},
        'kept': {
            'share': kept / runs,
            'low': low,
            'high': high,
            'confidence': CONFIDENCE,
            'interval': 'Wilson',
        },
        'figures': {name: _quantiles(results[name]) for name in figure_columns(results)},
        'influence': influence(study, results),
        'worst': [_bad_run(study, results, row) for row in worst_first(study, results)[:WORST]],
    }


def figure_columns(results: Columns) -> list[str]:
    """Names of what was measured and is a number."""
    others = ('run', 'seed', 'outcome')
    return [name for name in results if name not in others and not name.startswith(_DRAWN)]


def worst_ratio(study: Study, results: Columns) -> Floats:
    """Largest |xi1| / k_c of any joint in each run; infinite where the numbers were lost."""
    each = [results[f'max_error_ratio.{joint}'] for joint in study.plant.joints]
    return np.where(results['outcome'] == DIVERGED, np.inf, np.max(each, axis=0))


def worst_first(study: Study, results: Columns) -> np.ndarray:
    """Rows of the results, the largest |xi1| / k_c first; equal ones in the order of the runs."""
    return np.argsort(-worst_ratio(study, results), kind='stable')


def influence(study: Study, results: Columns) -> dict[str, float]:
    """Share of the spread of the largest |xi1| / k_c that each drawn number explains by itself.

    The correlation ratio of the ranks over groups of equal size, less what chance explains: unlike
    a correlation it also sees that both ends of a range are bad. Strongest first; what is the same
    in all runs is left out.
    """
    ranks = _ranks(worst_ratio(study, results))
    found = {
        one.column.removeprefix(_DRAWN): _explained(results[one.column], ranks)
        for one in study.spreads
        if np.unique(results[one.column]).size > 1
    }
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _explained(values: np.ndarray, ranks: Floats) -> float:
    groups = np.unique(values, return_inverse=True)[1]
    if groups.max() >= _GROUPS:
        groups = np.minimum(_GROUPS * _ranks(values) / (values.size + 1), _GROUPS - 1).astype(int)
    counts = np.bincount(groups)
    within = ranks.var() * ranks.size
    within -= float((np.bincount(groups, ranks) ** 2 / np.maximum(counts, 1)).sum())
    within += ranks.size * ranks.mean() ** 2
    freedom = ranks.size - np.count_nonzero(counts)
    if freedom <= 0 or ranks.var() == 0.0:
        return 0.0
    return max(0.0, float(1.0 - (within / freedom) / ranks.var(ddof=1)))


def _ranks(values: np.ndarray) -> Floats:
    """Rank of each value, equal ones sharing the mean of theirs."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return np.asarray((last - 0.5 * (counts - 1))[inverse], dtype=np.float64)


def _quantiles(values: np.ndarray) -> Summary | None:
    known = values[np.isfinite(values)]
    if known.size == 0:
        return None
    quantiles = {name: float(np.quantile(known, q)) for name, q in _QUANTILES.items()}
    return {**quantiles, 'known': int(known.size)}


def _bad_run(study: Study, results: Columns, row: int) -> Summary:
    ratios = {
        joint: float(results[f'max_error_ratio.{joint}'][row]) for joint in study.plant.joints
    }
    violation = float(results['first_violation_s'][row])
    return {
        'run': int(results['run'][row]),
        'outcome': str(results['outcome'][row]),
        'max_error_ratio': {
            joint: ratio if math.isfinite(ratio) else None for joint, ratio in ratios.items()
        },
        'first_violation_s': None if math.isnan(violation) else violation,
        'drawn': {
            name.removeprefix(_DRAWN): results[name][row].item()
            if isinstance(results[name][row], np.generic)
            else results[name][row]
            for name in results
            if name.startswith(_DRAWN)
        },
    }
