# SPDX-License-Identifier: Apache-2.0
"""Summary of a study in numbers: bounds kept, and pairs with and without learning."""

from __future__ import annotations

from typing import Any

import numpy as np

from blf_dsc_controller.analysis.output import plain
from blf_dsc_controller.run import Floats
from blf_dsc_controller.studies.monte_carlo import NOISE, WITHOUT, Study
from blf_dsc_controller.studies.runs import (
    DIVERGED,
    KEPT,
    OUTCOMES,
    REJECTED,
    Columns,
)

Summary = dict[str, Any]

ALLOWED = 1.3
"""Largest allowed error with learning, relative to that without."""

LAWS = {'': 'with', WITHOUT: 'without'}
"""What the laws of a pair are called, by the prefix of their columns."""

_WORST = 10
_FACTORS = {'median': 0.5, 'p99': 0.99, 'p99.9': 0.999, 'max': 1.0}
_NEAR = (0.8, 1.2)  # times the bound


def summarize(study: Study, results: Columns) -> Summary:
    """Return a summary of the results as plain data for JSON; unknown values are None.

    The Wilson interval, unlike p +- z sqrt(p (1 - p) / n), does not shrink to a point
    if all runs kept the bound, and never leaves [0, 1].
    """
    outcomes = results['outcome'].tolist()
    runs, kept = len(outcomes), outcomes.count(KEPT)
    interval = _interval(kept, runs, 'wilson')
    ratios = worst_of(study, results, 'max_error_ratio')
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
    noise = _compare(study, late, NOISE)
    return _compare(study, results, '') | {'noise': noise}


def _compare(study: Study, results: Columns, law: str, other: str = WITHOUT) -> Summary:
    """Compare the runs of a law with those of another one that learns nothing.

    `law` and `other` are the prefixes of their columns. `factor` has quantiles of the largest
    settled error of the law over that of the other. It and the medians are of the runs in
    which the other keeps the bound. `near` counts the runs in which the other comes near the
    bound, and the largest errors of the two differ by at least 1 %.
    """
    kept = results[f'{law}outcome'] == KEPT
    without = results[f'{other}outcome'] == KEPT
    settled = worst_of(study, results, 'settled_error_ratio', law)
    before = worst_of(study, results, 'settled_error_ratio', other)
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
                'with': _median(known(study, results, name, law, other)),
                'without': _median(known(study, results, name, other, other)),
            }
            for name in ('rms_error_rad', 'torque_error.end')
        },
    }


def _near_the_bound(
    study: Study, results: Columns, law: str, other: str
) -> dict[str, int]:
    """Count the runs near the bound without, whose error is larger or smaller with."""
    largest = worst_of(study, results, 'max_error_ratio', law)
    before = worst_of(study, results, 'max_error_ratio', other)
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


def worst_of(study: Study, results: Columns, name: str, law: str = '') -> Floats:
    """Return a figure of the worst joint in each run; infinite if it diverged."""
    each = [results[f'{law}{name}.{joint}'] for joint in study.plant.joints]
    lost = np.isin(results[f'{law}outcome'], (DIVERGED, REJECTED))
    return np.where(lost, np.inf, np.max(each, axis=0))


def known(
    study: Study, results: Columns, name: str, law: str, other: str = WITHOUT
) -> Floats:
    """Return a figure's finite values, of runs in which the `other` law keeps the bound."""
    column = f'{law}{name}'
    values = (
        results[column] if column in results else worst_of(study, results, name, law)
    )
    kept = results[f'{other}outcome'] == KEPT
    return np.asarray(values[kept & np.isfinite(values)])


def _pair_figures(pairs: Summary) -> dict[str, str]:
    """Return the figures of a comparison of pairs, by their titles."""
    kept = pairs['kept']
    factor = pairs['factor']
    noise = pairs['noise']
    broken = broken_only(pairs)
    noisy = broken_only(noise)
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


def broken_only(pairs: Summary) -> list[int]:
    """Return how many runs break the bound only with learning, and only without."""
    return [len(pairs[f'broken_only_{law}']) for law in LAWS.values()]


def _medians(pairs: Summary, name: str, factor: float) -> str:
    """Return the medians of a figure with and without learning, times a factor."""
    values = pairs['median'][name].values()
    return ' / '.join(f'{factor * value:.3g}' for value in values)
