# SPDX-License-Identifier: Apache-2.0
"""Runs of a study, and what is measured of each, as columns of the results."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.errors import OutsideBarrierError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import begin, controller_of
from blf_dsc_controller.monte_carlo.study import Origin, Study, draw, origin_of, plant_of_draw
from blf_dsc_controller.reference.limits import MotionError
from blf_dsc_controller.simulation import figures_loop
from blf_dsc_controller.simulation.loop import Record
from sim_plant import dynamics
from sim_plant.factory import plant_of, steps_of

KEPT = 'kept'
VIOLATED = 'violated'
DIVERGED = 'diverged'
REJECTED = 'rejected'
OUTCOMES = {
    KEPT: 'inside the bound to the end',
    VIOLATED: 'outside at some sample',
    DIVERGED: 'a number became infinite or NaN',
    REJECTED: 'measured outside at the start, where the controller does not begin',
}
"""What can become of a run."""

Row = dict[str, float | int | str]
Columns = dict[str, np.ndarray]
"""Results by the names of their columns, an entry for each run."""


def run_chunk(study: Study, first: int, count: int) -> Columns:
    """Compute runs `first` to `first + count - 1`.

    The memory of one controller, which is nearly all there is, serves one run after the other. The
    result depends on the arguments alone, and no file is written.
    """
    controller = controller_of(study.controller)
    origin = origin_of(controller)
    rows = [_run(study, index, controller, origin) for index in range(first, first + count)]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def warm_up(study: Study) -> None:
    """Compile what the workers run, so that they find it in the cache."""
    plant = dataclasses.replace(study.plant, duration=study.plant.sample_time)
    settings = dataclasses.replace(study.settings, settled_after=0.0, moments=())
    run_chunk(dataclasses.replace(study, plant=plant, settings=settings), 0, 1)


def measure_record(study: Study, plant: PlantConfig, record: Record) -> Row:
    """Columns of a run of which every sample is recorded, as if it were one of the study."""
    figures = _empty_figures(study)
    figures_loop.weigh_record(
        record.controller.settings_vector,
        record.stamps,
        record.measurements,
        record.samples,
        _wanted_vector(study, plant),
        figures,
    )
    return _row(study, figures)


def error_columns(study: Study) -> Iterator[str]:
    """Names of the parameter errors, the one at the end last."""
    for moment in study.settings.moments:
        yield f'parameter_error.{moment:g}_s'
    yield 'parameter_error.end'


def _run(study: Study, index: int, controller: Controller, origin: Origin) -> Row:
    drawn = draw(study, index)
    row: Row = {'run': drawn.run, 'seed': drawn.seed}
    for one, value in zip(study.variations, drawn.values, strict=True):
        row[one.column] = value
    config = plant_of_draw(study, drawn, origin)
    plant = plant_of(config)
    q, dq, _ = plant.measure().reshape(3, -1)
    controller.reset()
    figures = _empty_figures(study)
    try:
        begin(controller, study.controller, q, dq)
    except (OutsideBarrierError, MotionError):
        return row | _rejected_row(study, figures, np.abs(q - origin.qr) / origin.bound)
    figures_loop.run(
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
        steps_of(config) + 1,
        _wanted_vector(study, config),
        figures,
    )
    return row | _row(study, figures)


def _empty_figures(study: Study) -> np.ndarray:
    moments = len(study.settings.moments) + 1
    return np.zeros(figures_loop.figures_size(len(study.plant.joints), moments))


def _wanted_vector(study: Study, plant: PlantConfig) -> np.ndarray:
    P = np.zeros(3)
    arm = plant.arm
    dynamics.parameters(dynamics.Arm(arm.l1, arm.l2, arm.m1, arm.m2, arm.gravity), P)
    limits = zip(study.controller.torque.limit, plant.actuator.torque_limit, strict=True)
    times = (study.settings.settled_after, *study.settings.moments)
    settled, *moments = (round(t / plant.sample_time) for t in times)
    return figures_loop.wanted_vector(
        settled=settled,
        limit=np.array([min(law, motor or law) for law, motor in limits]),
        P=P,
        moments=np.array([*moments, steps_of(plant)]),
    )


def _row(study: Study, figures_vector: np.ndarray) -> Row:
    """Columns of a run from its figures; NaN is what has not happened."""
    figures = figures_loop.figures_of(figures_vector, len(study.plant.joints))
    settled = figures.settled[0]
    outcome = KEPT if np.isnan(figures.violation[0]) else VIOLATED
    row: Row = {
        'outcome': DIVERGED if figures.finite[0] == 0.0 else outcome,
        'first_violation_s': float(figures.violation[0]),
        'latch_time_s': float(figures.latch[0]),
        'saturated_fraction': float(figures.saturated[0] / max(1.0, figures.samples[0])),
    }
    rms = np.sqrt(figures.squares / settled) if settled else np.full_like(figures.squares, np.nan)
    for i, joint in enumerate(study.plant.joints):
        row[f'max_error_ratio.{joint}'] = float(figures.ratio[i])
        row[f'rms_error_rad.{joint}'] = float(rms[i])
        row[f'peak_torque_nm.{joint}'] = float(figures.peak[i])
    for name, error in zip(error_columns(study), figures.error.tolist(), strict=True):
        row[name] = error
    return row


def _rejected_row(study: Study, figures_vector: np.ndarray, ratios: np.ndarray) -> Row:
    """Columns of a run that does not begin, with |xi1(0)| / k_c (n,)."""
    figures_vector.fill(np.nan)
    figures = figures_loop.figures_of(figures_vector, len(study.plant.joints))
    figures.violation[0] = 0.0
    figures.ratio[:] = ratios
    figures.settled[0] = 0.0
    return _row(study, figures_vector) | {'outcome': REJECTED}
