# SPDX-License-Identifier: Apache-2.0
"""Conversion of a law's packed samples to columns by name, and to a `Run`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from blf_dsc_controller.arms.batch import regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import column_names, estimate_names, model_of, prior_covariance
from blf_dsc_controller.law.rejected_columns import rejected_columns
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.law.state import Sample, sample_of
from blf_dsc_controller.messages.telemetry import learning_names
from blf_dsc_controller.messages.topics import LYAPUNOV_TERMS
from blf_dsc_controller.run import Floats, LearnedArm, Run, Series, Stamps


def columns_of(rows: Floats, settings: Settings) -> Sample:
    """Split packed samples (N, s) into columns by name, located by unpacking a row of indices."""
    places = sample_of(np.arange(rows.shape[1], dtype=np.float64), settings)
    return Sample(*(rows[:, part.astype(np.intp)] for part in places))


def learning_of(config: ControllerConfig, stamps: Stamps, samples: Sample) -> Series:
    """Return what the law learned, under the names of `~/learning`."""
    names = learning_names(estimate_names(config), config.joints)
    figures = samples.lambda_min, samples.latched, samples.changes
    return Series(names, stamps, np.hstack((samples.estimate, samples.disturbance, *figures)))


def learned_arm(config: ControllerConfig) -> LearnedArm | None:
    """Return units, prior and regressor of what is learned of a URDF; None for other models."""
    if config.model != 'urdf':
        return None
    model, names = model_of(config), estimate_names(config)
    friction = ('N m s/rad' if 'viscous' in name else 'N m' for name in column_names(config))
    deviations = np.sqrt(np.diag(prior_covariance(config))).tolist()
    base = None
    if config.robot.learn != 'base':
        all_shown = model_of(replace(config, robot=replace(config.robot, learn='base')))
        base = all_shown.parameter_names, partial(regressors_at, all_shown)
    return LearnedArm(
        dict(zip(names, (*model.parameter_units, *friction), strict=True)),
        dict(zip(names, deviations, strict=True)),
        partial(regressors_at, model),
        base,
    )


def run_of(
    config: ControllerConfig,
    controller: Controller,
    stamps: Stamps,
    measurements: Floats,
    rows: Floats,
) -> Run:
    """Build a run from stamps (N,) [ns], measurements (N, 3 n) and samples (N, s).

    Rows of states that the law did not use are NaN except for bound and torque.
    """
    samples = columns_of(rows, controller.settings)
    used = ~np.isnan(samples.qr[:, 0])
    position, velocity, _ = np.split(measurements, 3, axis=1)
    monitor = Series(LYAPUNOV_TERMS, stamps[used], samples.lyapunov[used])
    rejected = rejected_columns(controller, estimate_names(config))
    return Run(
        joints=config.joints,
        stamp=stamps,
        received=stamps,
        position=position,
        velocity=velocity,
        torque=samples.torque,
        reference=samples.qr,
        error=samples.xi1,
        bound=samples.bound,
        torque_limit=np.broadcast_to(config.torque.limit, position.shape),
        learning=learning_of(config, stamps[used], Sample(*(part[used] for part in samples))),
        monitor=monitor if controller.settings.truth_known else None,
        arm=learned_arm(config),
        learns=config.law == 'blf_dsc' and config.learning.weight > 0.0,
        rejected={one.column: f'{one}' for one in rejected},
    )
