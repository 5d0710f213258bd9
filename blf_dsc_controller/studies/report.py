# SPDX-License-Identifier: Apache-2.0
"""Report of a study in its folder, and reproduction of one run with every sample recorded."""

from __future__ import annotations

import shlex
from pathlib import Path

from blf_dsc_controller.analysis.figures import draw as draw_run
from blf_dsc_controller.analysis.page import Cell, write_page
from blf_dsc_controller.analysis.summary import summarize as summarize_run
from blf_dsc_controller.analysis.summary import write_summary
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, dump
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.factory import controller_of
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import Study, origin_of, plant_with, random_numbers
from blf_dsc_controller.studies.runs import (
    OUTCOMES,
    Store,
    differences,
    figures_of,
    rows_of_another_motion,
)
from blf_dsc_controller.studies.statistics import ALLOWED, Summary, draw_study, summarize

_QUANTILES = ('min', 'median', 'p95', 'p99', 'max')


def write_report(store: Store) -> tuple[Summary, list[Path]]:
    """Write report.html with its figures, and summary.json, of the finished runs.

    Returns the summary and the paths; raises BlfDscError if there are no results yet.
    """
    results = store.results()
    summary = summarize(store.study, results)
    figures = draw_study(store.study, results, store.folder)
    path = store.folder / 'report.html'
    _write_page(path, store.study, summary, figures)
    write_summary(summary, store.folder / 'summary.json')
    return summary, [path, *figures, store.folder / 'summary.json']


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


def plant_of_run(study: Study, run: int) -> PlantConfig:
    """Return the plant configuration of a run."""
    return plant_with(study, random_numbers(study, run), origin_of(controller_of(study.controller)))


def reproduce(store: Store, run: int, out: Path) -> Summary:
    """Repeat a run of the study and write config.yaml, bag, figures and summary to `out`.

    The one without learning, of a study of pairs, goes to `out/without_learning`.

    Raises BlfDscError if the run has no results, or if they are not reproduced bit for bit;
    StartError if the controller rejects its start.
    """
    results = store.results()
    if run not in results['run']:
        raise BlfDscError(f'{store.folder} has no run {run}: it has {results["run"].size} runs')
    study = store.study
    plant = plant_of_run(study, run)
    unseen = rows_of_another_motion(study)
    row = int((results['run'] == run).argmax())
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


def _write_page(path: Path, study: Study, summary: Summary, figures: list[Path]) -> None:
    varied = [
        (
            Cell(variation.column.removeprefix('plant.'), 'code'),
            Cell(str(variation.distribution), 'code'),
            _explained(summary['influence'].get(variation.column.removeprefix('plant.'))),
        )
        for variation in study.variations
    ]
    write_page(
        path,
        'study.html',
        f'Monte Carlo study: {summary["runs"]} runs of {summary["duration_s"]:g} s',
        headline=headline(summary),
        summary=summary,
        outcomes=[(name, f'{n}', OUTCOMES[name]) for name, n in summary['outcomes'].items()],
        figures=figures,
        quantiles=[
            ('', *_QUANTILES),
            *(
                (Cell(name, 'code'), *(_number(values[quantile]) for quantile in _QUANTILES))
                for name, values in summary['figures'].items()
                if values is not None
            ),
        ],
        worst=[_worst_row(run, path.parent) for run in summary['worst']],
        exceptions=[
            (run, what, Cell(command, 'code'))
            for run, what, command in exceptions(summary['pairs'], path.parent)
        ],
        varied=varied,
    )


def _worst_row(run: Summary, folder: Path) -> tuple[str | Cell, ...]:
    first = run['first_violation_s']
    return (
        f'{run["run"]}',
        run['outcome'],
        ', '.join(_number(ratio) for ratio in run['max_error_ratio'].values()),
        '-' if first is None else f'{first:.3f} s',
        Cell(reproduce_command(folder, run['run']), 'code'),
    )


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


def _explained(fraction: float | None) -> str:
    return '-' if fraction is None else f'{100 * fraction:.0f} %'


def _number(value: float | None) -> str:
    return '-' if value is None else f'{value:.4g}'


def _percent(fraction: float) -> str:
    return f'{100 * fraction:.4g} %'
