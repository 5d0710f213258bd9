# SPDX-License-Identifier: Apache-2.0
"""The study: tuning of each contender on one truth, runs on others, and a page of figures."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from blf_dsc_controller.analysis.page import Cell, write_page
from blf_dsc_controller.configuration.nodes import LoopConfig, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.metrics import another_motion, torque_rows
from blf_dsc_controller.studies.laws import (
    CONTENDERS,
    DURATION,
    INTERVALS,
    PICK_UP,
    Figures,
    run,
)
from blf_dsc_controller.studies.tuning import HOPELESS, search

POPULATION = 16
ROUGHEST = 0.05
"""rms change of a torque per sample, relative to its limit, beyond which it is penalised."""

_UNSEEN = 1000  # seed of a motion that is never run
_COLUMNS = (*INTERVALS, 'torque error before the pick-up', 'at the end')
_OURS = ('proposed', 'proposed_tuned')


class Result(NamedTuple):
    """A contender on one arm: tuned gains and their cost (None if not tuned), validation runs."""

    gains: dict[str, float]
    cost: float | None
    runs: list[Figures]

    def columns(self) -> Floats:
        """Return the values of all runs for each of _COLUMNS, in mrad or %; NaN without a model."""
        rows = [(*one.errors, *(one.model or (np.nan, np.nan))) for one in self.runs]
        units = np.where(np.arange(len(_COLUMNS)) < len(INTERVALS), 1e3, 1e2)
        return np.asarray((np.array(rows) * units).T)


Results = dict[str, dict[str, Result]]
"""Results by arm and contender."""


def trial(name: str, seed: int) -> LoopConfig:
    """Return the loop of a preset: seed 0 keeps its truth and motion, other seeds vary them.

    Raises BlfDscError if it has no arm of a URDF that follows sinusoids.
    """
    loop = load_loop(name)
    reference, events = loop.controller.reference, loop.plant.events
    if loop.controller.model != 'urdf' or reference.type != 'sinusoids':
        raise BlfDscError(
            f'--config {name}: got model {loop.controller.model} and reference {reference.type}, '
            'but an arm of a URDF that follows sinusoids is needed, as in config/panda.yaml'
        )
    plant = {
        'duration': DURATION,
        'seed': seed,
        'truth.seed': loop.plant.truth.seed + seed,
        'events.begin': [PICK_UP],
        'events.duration': [0.0],
        'events.payload': [max(events.payload, default=0.0)],
    }
    # No funnel, since the other laws have none: all approach the motion from rest.
    law = change(loop.controller, {'barrier.initial_bound': [0.0] * len(loop.plant.joints)})
    law = another_motion(law, seed) if seed > 0 else law
    return loop._replace(controller=law, plant=change(loop.plant, plant))


def values_of(name: str, exponents: Floats) -> dict[str, float]:
    """Return the gains of a contender from their decimal logarithms."""
    pairs = zip(CONTENDERS[name].gains, exponents, strict=True)
    return {gain.name: float(f'{10.0**exponent:.3g}') for gain, exponent in pairs}


def cost_of(figures: Figures) -> float:
    """Return the mean over the intervals of log10 of the largest error in mrad; lower is better.

    Each decade of torque roughness beyond ROUGHEST adds ten.
    """
    rough = max(np.log10(figures.roughness / ROUGHEST), 0.0)
    cost = float(np.mean(np.log10(1e3 * np.array(figures.errors))) + 10.0 * rough)
    return min(cost, HOPELESS) if np.isfinite(cost) else HOPELESS


def tuning_cost(exponents: Floats, name: str, loop: LoopConfig, unseen: Floats) -> float:
    """Return `cost_of` a contender with one more sample of delay, to keep a stability margin."""
    delayed = change(loop.plant, {'actuator.delay': loop.plant.actuator.delay + 1})
    values = values_of(name, exponents)
    return cost_of(run(name, loop._replace(plant=delayed), values, unseen))


def compare(folder: Path, names: Sequence[str], truths: int, generations: int) -> list[list[str]]:
    """Tune and run everything, write the page into an empty folder; return `least_errors`."""
    loops = {name: [trial(name, seed) for seed in range(truths + 1)] for name in names}
    tuned = sum(bool(contender.gains) for contender in CONTENDERS.values())
    each = tuned * POPULATION * (generations + 1) + len(CONTENDERS) * truths
    results: Results = {}
    with tqdm(total=len(names) * each, unit='run') as bar, ProcessPoolExecutor() as pool:
        for name in names:
            unseen = torque_rows(trial(name, _UNSEEN).controller)
            if not results:  # compile now; the workers inherit or load the result
                for contender in ('proposed', 'computed_torque'):
                    run(contender, loops[name][0], {}, unseen)

            def computed(
                function: Callable[[Floats], float], points: Iterable[Floats]
            ) -> Iterator[float]:
                for value in pool.map(function, points):
                    bar.update()
                    yield value

            results[name] = {}
            for contender, what in CONTENDERS.items():
                bar.set_description(f'{name} {contender}')
                gains, cost = {}, None
                if what.gains:
                    point, cost, _ = search(
                        partial(tuning_cost, name=contender, loop=loops[name][0], unseen=unseen),
                        np.log10([(gain.least, gain.most) for gain in what.gains]),
                        POPULATION,
                        generations,
                        workers=computed,
                        updating='deferred',
                    )
                    gains = values_of(contender, point)
                runs = partial(run, contender, values=gains, unseen=unseen)
                figures = list(pool.map(runs, loops[name][1:]))
                bar.update(truths)
                results[name][contender] = Result(gains, cost, figures)
    _write(folder, results, truths, generations)
    return least_errors(results)


def least_errors(results: Results) -> list[list[str]]:
    """Return rows of arm, column, law with the best worst run, its value, and those of _OURS."""
    rows = []
    for arm, laws in results.items():
        worst = {name: one.columns().max(axis=1) for name, one in laws.items()}
        best = np.nanargmin(list(worst.values()), axis=0)
        for k, title in enumerate(_titles()):
            name = list(worst)[best[k]]
            shown = [f'{worst[each][k]:.3g}' for each in (name, *_OURS)]
            rows.append([arm, title, label_of(name), *shown])
    return rows


def label_of(name: str) -> str:
    """Return the label of a contender; that of an addition includes the basic law."""
    label = CONTENDERS[name].label
    return f'{CONTENDERS[name.rpartition("_")[0]].label} {label}' if label[0] == '+' else label


def table_of(laws: dict[str, Result]) -> list[list[str | Cell]]:
    """Return a header and a row for each contender: median / worst of its runs, best marked."""
    rows: list[list[str | Cell]] = [['law', *_titles(), 'bound kept', 'roughness [%]', 'gains']]
    best = np.nanmin([one.columns().max(axis=1) for one in laws.values()], axis=0)
    for name, one in laws.items():
        row: list[str | Cell] = [label_of(name)]
        for values, least in zip(one.columns(), best, strict=True):
            text = f'{np.median(values):.2f} / {values.max():.2f}'
            style = 'good' if values.max() == least else 'number'
            row.append('-' if np.isnan(values[0]) else Cell(text, style))
        kept = sum(figures.ratio < 1.0 for figures in one.runs)
        rough = max(figures.roughness for figures in one.runs)
        gains = ', '.join(f'{gain} {value:g}' for gain, value in one.gains.items())
        rows.append([*row, f'{kept} of {len(one.runs)}', f'{100.0 * rough:.1f}', gains or 'rule'])
    return rows


def _titles() -> list[str]:
    return [f'{name} [{"mrad" if name in INTERVALS else "%"}]' for name in _COLUMNS]


def _write(folder: Path, results: Results, truths: int, generations: int) -> None:
    plain = {
        arm: {
            name: {**one._asdict(), 'runs': [figures._asdict() for figures in one.runs]}
            for name, one in laws.items()
        }
        for arm, laws in results.items()
    }
    (folder / 'figures.json').write_text(json.dumps(plain, indent=1) + '\n', encoding='utf-8')
    write_page(
        folder / 'index.html',
        'arms.html',
        'Arms from a URDF, laws side by side',
        tables={arm: table_of(laws) for arm, laws in results.items()},
        least=least_errors(results),
        truths=truths,
        evaluations=POPULATION * (generations + 1),
        roughest=100.0 * ROUGHEST,
        folder=folder.name,
    )
