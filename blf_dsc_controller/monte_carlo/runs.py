# SPDX-License-Identifier: Apache-2.0
"""Runs of a study and their metrics, as columns of the results."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from math import nan

import numpy as np

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import begin, controller_of, model_of
from blf_dsc_controller.monte_carlo.study import Origin, Study, draw, origin_of, plant_of_draw
from blf_dsc_controller.reference.limits import MotionError
from blf_dsc_controller.simulation.loop import run_metrics
from blf_dsc_controller.simulation.metrics import (
    LoopMetrics,
    MetricsSettings,
    another_motion,
    metrics_of,
    new_metrics,
    torque_error,
    torque_rows,
)
from sim_plant.arms import parameter_names_of
from sim_plant.plant import Plant, parameter_order, plant_of, steps_of

_UNSEEN = 1000  # seed of the motion on which the torque of the learned model is judged

KEPT = 'kept'
VIOLATED = 'violated'
DIVERGED = 'diverged'
REJECTED = 'rejected'
OUTCOMES = {
    KEPT: 'inside the bound to the end',
    VIOLATED: 'outside at some sample',
    DIVERGED: 'a number became infinite or NaN',
    REJECTED: 'the controller refuses to start there',
}
"""Possible outcomes of a run."""

Row = dict[str, float | int | str]
Columns = dict[str, np.ndarray]
"""Results by column name, one entry per run."""


def run_chunk(study: Study, first: int, count: int) -> Columns:
    """Compute runs `first` to `first + count - 1`.

    All runs share one controller of each law, which take nearly all of the memory. The result
    depends on the arguments alone, and no file is written.
    """
    laws = {prefix: controller_of(config) for prefix, config in study.laws().items()}
    origin = origin_of(laws[''])
    unseen = rows_of_another_motion(study)
    rows = [_run(study, index, laws, origin, unseen) for index in range(first, first + count)]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def rows_of_another_motion(study: Study) -> np.ndarray | None:
    """Return rows of H (k, p) of a motion that is never run; None without sinusoids."""
    law = study.controller
    if law.reference.type != 'sinusoids':
        return None
    return torque_rows(another_motion(law, _UNSEEN))


def warm_up(study: Study) -> None:
    """Compile what the workers run, so that they find it in the cache."""
    plant = dataclasses.replace(study.plant, duration=study.plant.sample_time)
    settings = dataclasses.replace(study.settings, settled_after=0.0, moments=())
    run_chunk(dataclasses.replace(study, plant=plant, settings=settings), 0, 1)


def metrics_settings(study: Study, plant: PlantConfig) -> MetricsSettings:
    """Return the settings of the metrics of a run with this plant."""
    order = parameter_order(model_of(study.controller).parameter_names, plant)
    limits = zip(study.controller.torque.limit, plant.actuator.torque_limit, strict=True)
    times = (study.settings.settled_after, *study.settings.moments)
    settled, *moments = (round(t / plant.sample_time) for t in times)
    return MetricsSettings(
        n=len(plant.joints),
        p=order.size,
        true=len(parameter_names_of(plant)),
        moments=len(moments) + 1,
        settled=settled,
        limit=np.array([min(law, motor or law) for law, motor in limits]),
        order=order,
        samples=np.array([*moments, steps_of(plant)]),
    )


def metrics_row(study: Study, metrics: LoopMetrics, model_error: float = nan) -> Row:
    """Return the columns of a run from its metrics; NaN for events that did not happen."""
    settled = metrics.settled[0]
    outcome = KEPT if np.isnan(metrics.violation[0]) else VIOLATED
    row: Row = {
        'outcome': DIVERGED if metrics.finite[0] == 0.0 else outcome,
        'first_violation_s': float(metrics.violation[0]),
        'latch_time_s': float(metrics.latch[0]),
        'saturated_fraction': float(metrics.saturated[0] / max(1.0, metrics.samples[0])),
    }
    rms = np.sqrt(metrics.squares / settled) if settled else np.full_like(metrics.squares, np.nan)
    for i, joint in enumerate(study.plant.joints):
        row[f'max_error_ratio.{joint}'] = float(metrics.ratio[i])
        row[f'settled_error_ratio.{joint}'] = float(metrics.late[i]) if settled else np.nan
        row[f'rms_error_rad.{joint}'] = float(rms[i])
        row[f'peak_torque_nm.{joint}'] = float(metrics.peak[i])
    for name, error in zip(error_columns(study), metrics.error.tolist(), strict=True):
        row[name] = error
    row['torque_error.end'] = model_error
    return row


def model_error(
    unseen: np.ndarray | None, settings: MetricsSettings, estimate: np.ndarray, P: np.ndarray
) -> float:
    """Return the torque error of an estimate on another motion; NaN if it is not of the plant's."""
    if unseen is None or settings.order.min() < 0:
        return nan
    return torque_error(unseen, estimate[: settings.p], P[settings.order])


def error_columns(study: Study) -> Iterator[str]:
    """Yield the column names of the parameter errors, the final one last."""
    for moment in study.settings.moments:
        yield f'parameter_error.{moment:g}_s'
    yield 'parameter_error.end'


def _run(
    study: Study,
    index: int,
    laws: dict[str, Controller],
    origin: Origin,
    unseen: np.ndarray | None,
) -> Row:
    drawn = draw(study, index)
    row: Row = {'run': drawn.run, 'seed': drawn.seed}
    for variation, value in zip(study.variations, drawn.values, strict=True):
        row[variation.column] = value
    config = plant_of_draw(study, drawn, origin)
    settings, plant = metrics_settings(study, config), plant_of(config)
    for prefix, controller in laws.items():
        found = _run_law(study, controller, plant, settings, unseen)
        row |= {f'{prefix}{name}': value for name, value in found.items()}
    return row


def _run_law(
    study: Study,
    controller: Controller,
    plant: Plant,
    settings: MetricsSettings,
    unseen: np.ndarray | None,
) -> Row:
    """Run a plant, from its beginning, with a controller; return the columns of its metrics."""
    plant.reset()
    q, dq, _ = plant.measure().reshape(3, -1)
    controller.reset()
    try:
        begin(controller, study.controller, q, dq)
    except (StartError, MotionError):
        origin = origin_of(controller)
        return _rejected_row(study, np.abs(q - origin.qr) / origin.bound)
    metrics = run_metrics(controller, plant, steps_of(study.plant) + 1, settings)
    error = model_error(unseen, settings, controller.state.estimate, plant.truth())
    return metrics_row(study, metrics, error)


def _rejected_row(study: Study, ratios: np.ndarray) -> Row:
    """Return the columns of a run that does not begin, with |xi1(0)| / k_c (n,)."""
    settings = metrics_settings(study, study.plant)
    metrics = metrics_of(np.full_like(new_metrics(settings), np.nan), settings)
    metrics.violation[0] = 0.0
    metrics.ratio[:] = ratios
    metrics.settled[0] = 0.0
    return metrics_row(study, metrics) | {'outcome': REJECTED}
