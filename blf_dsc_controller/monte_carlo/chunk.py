# SPDX-License-Identifier: Apache-2.0
"""Some consecutive runs of a study, computed by one worker."""

from __future__ import annotations

import dataclasses

import numpy as np

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.errors import OutsideBarrierError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import begin, controller_of
from blf_dsc_controller.monte_carlo import measure
from blf_dsc_controller.monte_carlo.study import Origin, Study, draw, origin_of, plant_of_draw
from blf_dsc_controller.reference.limits import MotionError
from blf_dsc_controller.simulation import figures_loop as trajectory
from sim_plant.factory import plant_of

Columns = dict[str, np.ndarray]
"""Results by the names of their columns, an entry for each run."""


def run_chunk(study: Study, first: int, count: int) -> Columns:
    """Compute runs `first` to `first + count - 1`.

    The memory of the controller, which is nearly all there is, serves one run after the other. No
    file is written and nothing is remembered: what is returned depends on the arguments alone.
    """
    controller = controller_of(study.controller)
    origin = origin_of(controller)
    rows = [run_one(study, i, controller, origin) for i in range(first, first + count)]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def run_one(study: Study, index: int, controller: Controller, origin: Origin) -> measure.Row:
    """Compute one run; the controller, whose reference began at `origin`, is reset before."""
    drawn = draw(study, index)
    row: measure.Row = {'run': drawn.index, 'seed': drawn.seed}
    for one, value in zip(study.spreads, drawn.values, strict=True):
        row[one.column] = value
    plant = plant_of_draw(study, drawn, origin)
    return row | _measured(study, plant, controller, origin)


def warm_up(study: Study) -> None:
    """Compile what the workers run, so that they find it in the cache."""
    plant = dataclasses.replace(study.plant, duration=study.plant.sample_time)
    settings = dataclasses.replace(study.settings, settled_after=0.0, moments=())
    run_chunk(dataclasses.replace(study, plant=plant, settings=settings), 0, 1)


def _measured(
    study: Study, config: PlantConfig, controller: Controller, origin: Origin
) -> measure.Row:
    plant = plant_of(config)
    q, dq, _ = plant.measure().reshape(3, -1)
    controller.reset()
    try:
        begin(controller, study.controller, q, dq)
    except (OutsideBarrierError, MotionError):
        return measure.refused_row(study, np.abs(q - origin.qr) / origin.bound)
    figures = measure.empty_figures(study)
    trajectory.run(
        plant.settings,
        plant.state,
        plant.rng,
        controller.settings.model,
        controller.settings_vector,
        controller.reference_vector,
        controller.state_vector,
        controller.signals_vector,
        np.zeros(3 * plant.joints),
        controller.sample_vector,
        measure.samples_of(config),
        measure.wanted_of(study, config),
        figures,
    )
    return measure.row_of(study, figures)
