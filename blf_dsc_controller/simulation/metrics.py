# SPDX-License-Identifier: Apache-2.0
"""Metrics that the closed loop updates sample by sample, for studies of thousands of runs."""

from __future__ import annotations

from math import isfinite, isnan, nan, sqrt
from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.arms.batch import regressors_at
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell, size_of, view_of
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.factory import model_of
from blf_dsc_controller.law.state import Sample
from blf_dsc_controller.reference import terms
from blf_dsc_controller.reference.approach import reference_of

_ROWS = 200
_ROWS_FOR = 15.0  # s


class MetricsSettings(NamedTuple):
    """Limits and moments of the metrics of a run."""

    n: int
    p: int  # parameters of the model
    true: int  # parameters of the plant
    moments: int
    settled: int  # first settled sample, of the rms error
    limit: Annotated[Array, 'n']  # N m, torque at which a joint is saturated; 0: none
    order: Annotated[Array, 'p']  # index of each in those of the plant; -1: it has others
    samples: Annotated[Array, 'moments']  # at which the parameter error is stored


class LoopMetrics(NamedTuple):
    """Metrics of a run up to the present sample."""

    samples: Cell
    finite: Cell  # 0 after the first number that is not finite
    violation: Cell  # s, first time of |xi1| >= k(t), or NaN
    latch: Cell  # s, first time with a latched window, or NaN
    saturated: Cell  # samples in which a joint was saturated
    settled: Cell  # settled samples
    ratio: Annotated[Array, 'n']  # max |xi1| / k(t)
    late: Annotated[Array, 'n']  # max |xi1| / k(t) of the settled samples
    squares: Annotated[Array, 'n']  # rad^2, sum of xi1^2 of the settled samples
    peak: Annotated[Array, 'n']  # N m, max |applied torque|
    error: Annotated[Array, 'moments']  # |P^ - P| / |P|, or NaN
    P: Annotated[Array, 'true']  # kg m^2, of the plant at the present sample


metrics_settings_of = view_of(MetricsSettings)
metrics_of, _metrics_size = view_of(LoopMetrics), size_of(LoopMetrics)


def new_metrics(settings: MetricsSettings) -> np.ndarray:
    """Return the vector of the metrics before the first sample."""
    vector = np.zeros(_metrics_size(settings))
    metrics = metrics_of(vector, settings)
    metrics.finite[0] = 1.0
    for field in (metrics.violation, metrics.latch, metrics.error):
        field.fill(nan)
    return vector


@inner
def is_finite(vector: np.ndarray) -> bool:
    """Return whether all entries are finite."""
    finite = True
    for i in range(vector.size):
        finite = finite and isfinite(vector[i])
    return finite


@inner
def relative_error(estimate: np.ndarray, P: np.ndarray, order: np.ndarray) -> float:
    """Return |P^ - P| / |P|, or NaN if the parameters are not those of the plant."""
    difference = 0.0
    size = 0.0
    for j in range(order.size):
        true = P[int(order[j])] if order[j] >= 0.0 else nan
        difference += (estimate[j] - true) ** 2
        size += true**2
    return sqrt(difference) / sqrt(size)


@inner
def update_joint(
    settings: MetricsSettings, metrics: LoopMetrics, i: int, t: float, applied: float, s: Sample
) -> bool:
    """Update the metrics of joint i and return whether it is saturated."""
    error = abs(s.xi1[i])
    if error >= s.bound[i] and isnan(metrics.violation[0]):
        metrics.violation[0] = t
    metrics.ratio[i] = max(metrics.ratio[i], error / s.bound[i])
    metrics.peak[i] = max(metrics.peak[i], abs(applied))
    if metrics.samples[0] >= settings.settled:
        metrics.squares[i] += error * error
        metrics.late[i] = max(metrics.late[i], error / s.bound[i])
    return bool(settings.limit[i] > 0.0 and abs(s.torque[i]) >= settings.limit[i])


@inner
def update_metrics(
    settings: MetricsSettings,
    metrics: LoopMetrics,
    t: float,
    measurement: np.ndarray,
    sample: Sample,
) -> None:
    """Update the metrics, which hold the true parameters, with the sample at time t [s].

    They are not updated after a sample that is not finite.
    """
    if not (is_finite(measurement) and is_finite(sample.torque)):
        metrics.finite[0] = 0.0
        if isnan(metrics.violation[0]):
            metrics.violation[0] = t
        return
    n = settings.n
    saturated = False
    for i in range(n):
        if update_joint(settings, metrics, i, t, measurement[2 * n + i], sample):
            saturated = True
    if saturated:
        metrics.saturated[0] += 1.0
    if metrics.samples[0] >= settings.settled:
        metrics.settled[0] += 1.0
    if sample.latched[0] == 1.0 and isnan(metrics.latch[0]):
        metrics.latch[0] = t
    for j in range(settings.moments):
        if settings.samples[j] == metrics.samples[0]:
            metrics.error[j] = relative_error(sample.estimate, metrics.P, settings.order)
    metrics.samples[0] += 1.0


def another_motion(config: ControllerConfig, seed: int) -> ControllerConfig:
    """Return a configuration with other signs and phases of the reference's sinusoids."""
    random, reference = np.random.default_rng(seed), config.reference
    signs = random.choice((-1.0, 1.0), len(reference.amplitude))
    motion = {
        'reference.amplitude': (signs * reference.amplitude).tolist(),
        'reference.phase': random.uniform(0.0, 2.0 * np.pi, len(reference.phase)).tolist(),
    }
    return change(config, motion)


def torque_rows(config: ControllerConfig) -> np.ndarray:
    """Return the rows of H(q, q', q', q'') (k, p) along the configured reference."""
    model = model_of(config)
    times = np.linspace(0.0, _ROWS_FOR, _ROWS)
    q, dq, ddq = np.moveaxis(terms.sampled(reference_of(config), times), 1, 0)
    return regressors_at(model, q, dq, dq, ddq).reshape(_ROWS * model.n, -1)


def torque_error(rows: np.ndarray, estimate: np.ndarray, P: np.ndarray) -> float:
    """Return the torque error of a learned model on such rows, relative to their torque."""
    return float(np.linalg.norm(rows @ (estimate - P)) / np.linalg.norm(rows @ P))
