# SPDX-License-Identifier: Apache-2.0
"""The study: tuning of each contender on one truth, runs on others, and a table of figures."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from blf_dsc_controller.analysis.summary import aligned, plain, write_summary
from blf_dsc_controller.configuration.nodes import LoopConfig, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.studies.laws import (
    CONTENDERS,
    DURATION,
    INTERVALS,
    PICK_UP,
    Figures,
    load_laws,
    run,
)
from blf_dsc_controller.studies.monte_carlo import UNSEEN, another_motion, torque_rows
from blf_dsc_controller.studies.runs import cores
from blf_dsc_controller.studies.tuning import bounded, search, value_at

POPULATION = 16
ROUGHEST = 0.05
"""rms change of a torque per sample, relative to its limit, beyond which it is penalised."""

COLUMNS = (*INTERVALS, 'model before', 'model after')
"""Largest errors [mrad], and torque errors of the model [%] before the pick-up and at the end."""


class Result(NamedTuple):
    """A contender on one arm: tuned gains and their cost (None if not tuned), validation runs."""

    gains: dict[str, float]
    cost: float | None
    runs: list[Figures]

    def columns(self) -> Floats:
        """Return the values of all runs for each of COLUMNS, in mrad or %; NaN without a model."""
        rows = [(*figures.errors, *(figures.model or (np.nan, np.nan))) for figures in self.runs]
        units = np.where(np.arange(len(COLUMNS)) < len(INTERVALS), 1e3, 1e2)
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
    return {gain.name: value_at(exponent) for gain, exponent in pairs}


def cost_of(figures: Figures) -> float:
    """Return the mean over the intervals of log10 of the largest error in mrad; lower is better.

    Each decade of torque roughness beyond ROUGHEST adds ten.
    """
    rough = max(np.log10(figures.roughness / ROUGHEST), 0.0)
    return bounded(np.mean(np.log10(1e3 * np.array(figures.errors))) + 10.0 * rough)


def tuning_cost(exponents: Floats, name: str, loop: LoopConfig, unseen: Floats) -> float:
    """Return `cost_of` a contender with one more sample of delay, to keep a stability margin."""
    delayed = change(loop.plant, {'actuator.delay': loop.plant.actuator.delay + 1})
    values = values_of(name, exponents)
    return cost_of(run(name, loop._replace(plant=delayed), values, unseen))


def chosen_laws(given: Sequence[str]) -> list[str]:
    """Return the names of contenders from names and Python files, `proposed` first; all for none.

    Raises BlfDscError if there is no such contender or file.
    """
    if not given:
        return list(CONTENDERS)
    names = ['proposed']
    for name in given:
        if name not in CONTENDERS and not Path(name).is_file():
            raise BlfDscError(
                f'--laws {name}: expected a law of the study ({", ".join(CONTENDERS)}), or a '
                'Python file with CONTENDERS'
            )
        names += [name] if name in CONTENDERS else load_laws(Path(name).resolve())
    return list(dict.fromkeys(names))


def compare(
    folder: Path, arms: Sequence[str], laws: Sequence[str], truths: int, generations: int
) -> Results:
    """Tune and run everything, and write figures.json into an empty folder.

    `laws` are as in `chosen_laws`.
    """
    names = chosen_laws(laws)
    results: Results = {arm: {} for arm in arms}
    rows = [(arm, name) for arm in arms for name in names]
    with ProcessPoolExecutor(cores(), initializer=chosen_laws, initargs=(laws,)) as pool:
        for arm, name in tqdm(rows, unit='law'):
            first, *others = (trial(arm, seed) for seed in range(truths + 1))
            unseen = torque_rows(trial(arm, UNSEEN).controller)
            searched = CONTENDERS[name].gains
            least = {gain.name: gain.least for gain in searched}
            run(name, first, least, unseen)  # compiles what the workers load
            gains, cost = {}, None
            if searched:
                of_gains = partial(tuning_cost, name=name, loop=first, unseen=unseen)
                options = {'workers': pool.map, 'updating': 'deferred'}
                point, cost, _ = search(of_gains, searched, POPULATION, generations, **options)
                gains = values_of(name, point)
            runs = pool.map(partial(run, name, values=gains, unseen=unseen), others)
            results[arm][name] = Result(gains, cost, list(runs))
    numbers = {
        arm: {
            name: {**result._asdict(), 'runs': [figures._asdict() for figures in result.runs]}
            for name, result in found.items()
        }
        for arm, found in results.items()
    }
    write_summary(plain(numbers), folder / 'figures.json')
    return results


def format_results(results: dict[str, Result]) -> str:
    """Return the worst of each figure on an arm, a line for each contender, and tuned gains."""
    rows, gains = [['worst', *COLUMNS, 'roughness', 'bound kept']], []
    for name, result in results.items():
        label, worst = CONTENDERS[name].label, result.columns().max(axis=1)
        rough = 100.0 * max(figures.roughness for figures in result.runs)
        kept = sum(figures.ratio < 1.0 for figures in result.runs)
        cells = ('-' if np.isnan(value) else f'{value:.2f}' for value in worst)
        rows.append([label, *cells, f'{rough:.1f} %', f'{kept} of {len(result.runs)}'])
        if result.gains:
            each = ', '.join(f'{gain} {value:g}' for gain, value in result.gains.items())
            gains.append(f'{label}: {each}')
    return '\n'.join([aligned(rows), *gains])
