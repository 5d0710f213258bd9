# SPDX-License-Identifier: Apache-2.0
"""One run of a study once more, with every sample kept: a bag, its pictures, its figures.

The run is a configuration like any other (config.yaml), which `closed_loop --offline` takes too.
"""

from __future__ import annotations

import math
from pathlib import Path

from blf_dsc_controller.analysis.figures import draw as draw_run
from blf_dsc_controller.analysis.summary import Summary, summarize, write_summary
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT
from blf_dsc_controller.configuration.params_file import dump
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.law.factory import controller_of
from blf_dsc_controller.monte_carlo import measure
from blf_dsc_controller.monte_carlo.chunk import Columns
from blf_dsc_controller.monte_carlo.errors import NoResultsError, NotReproducedError
from blf_dsc_controller.monte_carlo.store import Store
from blf_dsc_controller.monte_carlo.study import Study, draw, origin_of, plant_of_draw
from blf_dsc_controller.simulation import figures_loop as trajectory
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import Record, simulate


def plant_of_run(study: Study, run: int) -> PlantConfig:
    """Configuration of the plant of a run."""
    return plant_of_draw(study, draw(study, run), origin_of(controller_of(study.controller)))


def figures_of_record(study: Study, plant: PlantConfig, record: Record) -> measure.Row:
    """Measure a run of which every sample is there, as if it were one of the study."""
    figures = measure.empty_figures(study)
    trajectory.weigh_record(
        record.controller.settings_vector,
        record.stamps,
        record.measurements,
        record.samples,
        measure.wanted_of(study, plant),
        figures,
    )
    return measure.row_of(study, figures)


def reproduce(store: Store, run: int, out: Path) -> Summary:
    """Run one of the study once more into the folder `out`, which must be there and empty.

    Returns the summary of its bag, which is written beside it.

    Raises:
        NoResultsError: the run has not been computed yet, or there is none of this number.
        OutsideBarrierError: the controller does not begin it.
        NotReproducedError: its figures are not those of the study.
    """
    results = store.results()
    if run not in results['run']:
        raise NoResultsError(store.folder, f'run {run}: it has {results["run"].size} runs')
    study = store.study
    plant = plant_of_run(study, run)
    dump(out / 'config.yaml', {PLANT: plant, CONTROLLER: study.controller})
    record = simulate(study.controller, plant)
    write_bag(out / 'bag', record, study.controller, 'none')
    told = read_run(out / 'bag')
    summary = summarize(told)
    write_summary(summary, out / 'summary.json')
    draw_run(told, out)
    _compare(run, results, figures_of_record(study, plant, record))
    return summary


def _compare(run: int, results: Columns, here: measure.Row) -> None:
    row = int((results['run'] == run).argmax())
    there = {name: results[name][row] for name in here}
    differences = {
        name: (there[name], value) for name, value in here.items() if not _same(there[name], value)
    }
    if differences:
        raise NotReproducedError(run, differences)


def _same(there: object, here: object) -> bool:
    if isinstance(here, float) and math.isnan(here):
        return bool(there != there)  # noqa: PLR0124 - only NaN is not itself
    return bool(there == here)
