# SPDX-License-Identifier: Apache-2.0
"""What is measured of every run, as columns of the results."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.monte_carlo.study import Study
from blf_dsc_controller.simulation import figures_loop as trajectory
from sim_plant import dynamics as arm
from sim_plant.factory import steps_of

KEPT = 'kept'
VIOLATED = 'violated'
DIVERGED = 'diverged'
REFUSED = 'refused'
OUTCOMES = (KEPT, VIOLATED, DIVERGED, REFUSED)
"""Inside the bound to the end; outside at some sample; no numbers any more; outside at the start,
where the controller does not begin."""

Row = dict[str, float | int | str]


def samples_of(plant: PlantConfig) -> int:
    """Samples of a run, the first and the last included."""
    return steps_of(plant) + 1


def wanted_of(study: Study, plant: PlantConfig) -> np.ndarray:
    """What the run of this plant is measured by, packed for the kernels of `trajectory`."""
    P = np.zeros(3)
    arm.parameters(_arm_of(plant), P)
    limits = zip(study.controller.torque.limit, plant.actuator.torque_limit, strict=True)
    last = samples_of(plant) - 1
    return trajectory.wanted_vector(
        settled=_sample(study.settings.settled_after, plant),
        limit=np.array([min(law, motor or law) for law, motor in limits]),
        P=P,
        moments=np.array([*(_sample(t, plant) for t in study.settings.moments), last]),
    )


def empty_figures(study: Study) -> np.ndarray:
    """Vector of figures to be filled."""
    joints = len(study.plant.joints)
    return np.zeros(trajectory.figures_size(joints, len(study.settings.moments) + 1))


def row_of(study: Study, figures_vector: np.ndarray) -> Row:
    """Columns of a run from its figures: what has not happened is NaN."""
    figures = trajectory.figures_of(figures_vector, len(study.plant.joints))
    settled = figures.settled[0]
    row: Row = {
        'outcome': _outcome(figures),
        'first_violation_s': float(figures.violation[0]),
        'latch_time_s': float(figures.latch[0]),
        'saturated_share': float(figures.saturated[0] / max(1.0, figures.samples[0])),
    }
    rms = np.sqrt(figures.squares / settled) if settled else np.full_like(figures.squares, np.nan)
    for i, joint in enumerate(study.plant.joints):
        row[f'max_error_ratio.{joint}'] = float(figures.ratio[i])
        row[f'rms_error_rad.{joint}'] = float(rms[i])
        row[f'peak_torque_nm.{joint}'] = float(figures.peak[i])
    for name, error in zip(error_columns(study), figures.error.tolist(), strict=True):
        row[name] = error
    return row


def refused_row(study: Study, ratios: np.ndarray) -> Row:
    """Columns of a run that does not begin, with |xi1(0)| / k_c (n,)."""
    figures_vector = empty_figures(study)
    figures_vector.fill(np.nan)
    figures = trajectory.figures_of(figures_vector, len(study.plant.joints))
    figures.violation[0] = 0.0
    figures.ratio[:] = ratios
    figures.settled[0] = 0.0
    return row_of(study, figures_vector) | {'outcome': REFUSED}


def error_columns(study: Study) -> Iterator[str]:
    """Names of the parameter errors, the one at the end last."""
    for moment in study.settings.moments:
        yield f'parameter_error.{moment:g}_s'
    yield 'parameter_error.end'


def _outcome(figures: trajectory.Figures) -> str:
    if figures.finite[0] == 0.0:
        return DIVERGED
    return KEPT if np.isnan(figures.violation[0]) else VIOLATED


def _sample(t: float, plant: PlantConfig) -> int:
    return round(t / plant.sample_time)


def _arm_of(plant: PlantConfig) -> arm.Arm:
    told = plant.arm
    return arm.Arm(told.l1, told.l2, told.m1, told.m2, told.gravity)
