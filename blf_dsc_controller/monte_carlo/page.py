# SPDX-License-Identifier: Apache-2.0
"""The report of a study as a page of Markdown."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

from blf_dsc_controller.monte_carlo.statistics import Summary
from blf_dsc_controller.monte_carlo.study import Study

_QUANTILES = ('min', 'median', 'p95', 'p99', 'max')
_MEANING = {
    'kept': 'inside the bound to the end',
    'violated': 'outside at some sample',
    'diverged': 'no numbers any more',
    'refused': 'measured outside at the start, where the controller does not begin',
}


def command(folder: Path, run: int) -> str:
    """What computes a run again and records it."""
    out = shlex.quote(f'{folder.name}-run-{run}')
    return f'monte_carlo --reproduce {shlex.quote(str(folder))} {run} --out {out}'


def headline(summary: Summary) -> str:
    """The answer in one sentence."""
    kept = summary['kept']
    return (
        f'{_percent(kept["share"])} of the runs kept the bound '
        f'({summary["outcomes"]["kept"]} of {summary["runs"]}; {100 * kept["confidence"]:g} % '
        f'confidence: {_percent(kept["low"])} to {_percent(kept["high"])})'
    )


def page(study: Study, summary: Summary, folder: Path, pictures: Sequence[Path]) -> str:
    """Text of the page; pictures are linked by their names."""
    return '\n'.join(_lines(study, summary, folder, pictures)) + '\n'


def _lines(study: Study, summary: Summary, folder: Path, pictures: Sequence[Path]) -> Iterator[str]:
    yield f'# Monte Carlo study: {summary["runs"]} runs of {summary["duration_s"]:g} s'
    yield ''
    yield f'**{headline(summary)}.**'
    yield ''
    if summary['runs'] < summary['planned']:
        yield f'The study is not complete: {summary["planned"]} runs are planned.'
        yield ''
    yield from _table(
        ('outcome', 'runs', 'meaning'),
        [(name, str(count), _MEANING[name]) for name, count in summary['outcomes'].items()],
    )
    yield (
        f'The interval is of Wilson. Seed {summary["seed"]}; all else is in `study.yaml` and '
        '`versions.json`, the results in `runs/*.parquet`.'
    )
    yield ''
    yield '## Distributions'
    yield ''
    for picture in pictures:
        yield f'![{picture.stem}]({picture.name})'
        yield ''
    yield from _table(('', *_QUANTILES), _figures(summary))
    yield '## The worst runs'
    yield ''
    yield from _table(
        ('run', 'outcome', 'max abs(xi1)/k_c', 'first outside', 'once more, with a bag'),
        [_bad(one, folder) for one in summary['worst']],
    )
    yield '## What varied'
    yield ''
    yield (
        'What each explains by itself of the spread of the largest error: correlation ratio of the '
        'ranks over ten groups.'
    )
    yield ''
    yield from _table(
        ('parameter', 'distribution', 'explains'),
        _varied(study, summary),
    )


def _figures(summary: Summary) -> list[tuple[str, ...]]:
    return [
        (f'`{name}`', *(_number(told[quantile]) for quantile in _QUANTILES))
        for name, told in summary['figures'].items()
        if told is not None
    ]


def _bad(one: Summary, folder: Path) -> tuple[str, ...]:
    ratios = ', '.join(_number(ratio) for ratio in one['max_error_ratio'].values())
    first = one['first_violation_s']
    outside = '-' if first is None else f'{first:.3f} s'
    return (
        str(one['run']),
        one['outcome'],
        ratios,
        outside,
        f'`{command(folder, one["run"])}`',
    )


def _varied(study: Study, summary: Summary) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for one in study.spreads:
        name = one.column.removeprefix('plant.')
        share = summary['influence'].get(name)
        told = '-' if share is None else f'{100 * share:.0f} %'
        rows.append((f'`{name}`', f'`{one.distribution}`', told))
    return rows


def _table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f'| {" | ".join(titles)} |'
    yield f'|{" --- |" * len(titles)}'
    for row in rows:
        yield f'| {" | ".join(row)} |'
    yield ''


def _number(value: float | None) -> str:
    return '-' if value is None else f'{value:.4g}'


def _percent(share: float) -> str:
    return f'{100 * share:.4g} %'
