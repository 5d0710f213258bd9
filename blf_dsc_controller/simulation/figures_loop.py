# SPDX-License-Identifier: Apache-2.0
"""One closed loop that keeps only its figures: what a study of thousands of them needs.

The samples are those of `simulation.loop`, bit for bit, but have no energies; each is weighed and
forgotten.
"""

from __future__ import annotations

from math import isfinite, isnan, nan, sqrt
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.views import borrowed, part
from blf_dsc_controller.law.controller import decide
from blf_dsc_controller.law.sample import Sample, sample_of
from blf_dsc_controller.law.settings import settings_of
from blf_dsc_controller.law.state import signals_of, state_of
from sim_plant import plant as plants


class Wanted(NamedTuple):
    """Views on what a run is measured by."""

    settled: np.ndarray  # (1,) first sample of the rms error
    limit: np.ndarray  # (n,) torque at which a joint is saturated, N m; 0: none
    P: np.ndarray  # (p,) true parameters
    moments: np.ndarray  # samples at which the parameter error is kept


class Figures(NamedTuple):
    """Views on the figures of a run so far."""

    samples: np.ndarray  # (1,) samples weighed
    finite: np.ndarray  # (1,) 0 once a number is not
    violation: np.ndarray  # (1,) time of the first |xi1| >= k(t), s; or NaN
    latch: np.ndarray  # (1,) time from which on there is a window to learn from, s; or NaN
    saturated: np.ndarray  # (1,) samples in which a joint was
    settled: np.ndarray  # (1,) samples of the rms error
    ratio: np.ndarray  # (n,) max |xi1| / k(t)
    squares: np.ndarray  # (n,) sum of xi1^2 over them, rad^2
    peak: np.ndarray  # (n,) max |applied torque|, N m
    error: np.ndarray  # |P^ - P| / |P| at the moments, or NaN


def wanted_vector(
    settled: int, limit: np.ndarray, P: np.ndarray, moments: np.ndarray
) -> np.ndarray:
    """Pack `Wanted`."""
    return np.concatenate(([len(limit), len(P), settled], limit, P, moments))


def figures_size(n: int, moments: int) -> int:
    """Length of a figures vector."""
    return 6 + 3 * n + moments


@inner
def wanted_of(vector: np.ndarray) -> Wanted:
    """Name the parts of a wanted vector."""
    n = int(vector[0])
    p = int(vector[1])
    moments = 3 + n + p
    return Wanted(
        settled=part(vector, 2, (1,)),
        limit=part(vector, 3, (n,)),
        P=part(vector, 3 + n, (p,)),
        moments=part(vector, moments, (vector.size - moments,)),
    )


@inner
def figures_of(vector: np.ndarray, n: int) -> Figures:
    """Name the parts of a figures vector."""
    return Figures(
        samples=part(vector, 0, (1,)),
        finite=part(vector, 1, (1,)),
        violation=part(vector, 2, (1,)),
        latch=part(vector, 3, (1,)),
        saturated=part(vector, 4, (1,)),
        settled=part(vector, 5, (1,)),
        ratio=part(vector, 6, (n,)),
        squares=part(vector, 6 + n, (n,)),
        peak=part(vector, 6 + 2 * n, (n,)),
        error=part(vector, 6 + 3 * n, (vector.size - 6 - 3 * n,)),
    )


@inner
def begin(figures: Figures) -> None:
    """Nothing has been seen yet."""
    figures.samples[0] = 0.0
    figures.finite[0] = 1.0
    figures.violation[0] = nan
    figures.latch[0] = nan
    figures.saturated[0] = 0.0
    figures.settled[0] = 0.0
    for i in range(figures.ratio.size):
        figures.ratio[i] = 0.0
        figures.squares[i] = 0.0
        figures.peak[i] = 0.0
    for j in range(figures.error.size):
        figures.error[j] = nan


@inner
def is_finite(measurement: np.ndarray, torque: np.ndarray) -> bool:
    """Whether the loop still computes with numbers."""
    finite = True
    for i in range(measurement.size):
        finite = finite and isfinite(measurement[i])
    for i in range(torque.size):
        finite = finite and isfinite(torque[i])
    return finite


@inner
def relative_error(estimate: np.ndarray, P: np.ndarray) -> float:
    """|P^ - P| / |P|."""
    difference = 0.0
    size = 0.0
    for j in range(P.size):
        difference += (estimate[j] - P[j]) ** 2
        size += P[j] ** 2
    return sqrt(difference) / sqrt(size)


@inner
def weigh_joint(
    wanted: Wanted, figures: Figures, i: int, t: float, applied: float, sample: Sample
) -> bool:
    """Take errors and torques of joint i into the figures; True if it is saturated."""
    error = abs(sample.xi1[i])
    if error >= sample.bound[i] and isnan(figures.violation[0]):
        figures.violation[0] = t
    figures.ratio[i] = max(figures.ratio[i], error / sample.bound[i])
    figures.peak[i] = max(figures.peak[i], abs(applied))
    if figures.samples[0] >= wanted.settled[0]:
        figures.squares[i] += error * error
    return bool(wanted.limit[i] > 0.0 and abs(sample.torque[i]) >= wanted.limit[i])


@inner
def weigh(
    wanted: Wanted, figures: Figures, t: float, measurement: np.ndarray, sample: Sample
) -> None:
    """Take the next sample, at time t [s], into the figures."""
    n = wanted.limit.size
    if not is_finite(measurement, sample.torque):
        figures.finite[0] = 0.0
        if isnan(figures.violation[0]):
            figures.violation[0] = t
        return
    saturated = False
    for i in range(n):
        if weigh_joint(wanted, figures, i, t, measurement[2 * n + i], sample):
            saturated = True
    if saturated:
        figures.saturated[0] += 1.0
    if figures.samples[0] >= wanted.settled[0]:
        figures.settled[0] += 1.0
    if sample.latched[0] == 1.0 and isnan(figures.latch[0]):
        figures.latch[0] = t
    for j in range(wanted.moments.size):
        if wanted.moments[j] == figures.samples[0]:
            figures.error[j] = relative_error(sample.estimate, wanted.P)
    figures.samples[0] += 1.0


@kernel
def run(
    plant_settings: np.ndarray,
    plant_state: np.ndarray,
    rng: np.random.Generator,
    model: ArmModel,
    settings: np.ndarray,
    reference: np.ndarray,
    state: np.ndarray,
    signals: np.ndarray,
    measurement: np.ndarray,
    sample: np.ndarray,
    samples: int,
    wanted_vector: np.ndarray,
    figures_vector: np.ndarray,
) -> None:
    """Run as many samples, or until a number is not finite; the last torque is not applied.

    Args:
        plant_settings: of the plant.
        plant_state: of the plant, moved on.
        rng: of the plant's noise.
        model: of the arm.
        settings: packed `Settings`.
        reference: packed reference.
        state: packed `State`, moved on.
        signals: packed `Signals`, overwritten.
        measurement: (3 n,), overwritten.
        sample: packed `Sample`, overwritten.
        samples: how many, the first included.
        wanted_vector: packed `Wanted`.
        figures_vector: packed `Figures`, filled.
    """
    n = measurement.size // 3
    seen = borrowed(measurement)
    wanted_motion = borrowed(reference)
    wanted = wanted_of(borrowed(wanted_vector))
    figures = figures_of(borrowed(figures_vector), n)
    law = settings_of(settings, model)
    told = sample_of(borrowed(sample), law)
    law_state = state_of(state, law)
    law_signals = signals_of(signals, law)
    arm, now = plants.plant_of(plant_settings, plant_state)
    period = int(arm.period_ns)
    begin(figures)
    for k in range(samples):
        plants.draw_next(arm, now, rng)
        plants.read(arm, now, seen)
        t = (k * period) * 1e-9
        decide(law, wanted_motion, law_state, law_signals, t, period * 1e-9, seen, told)
        weigh(wanted, figures, t, seen, told)
        if figures.finite[0] == 0.0:
            return
        if k < samples - 1:
            plants.move(arm, now, told.torque)


@kernel
def weigh_record(
    settings: np.ndarray,
    stamps: np.ndarray,
    measurements: np.ndarray,
    samples: np.ndarray,
    wanted_vector: np.ndarray,
    figures_vector: np.ndarray,
) -> None:
    """Fill the figures of a run of which every sample is there (`simulation.Record`)."""
    law = settings_of(settings, None)
    wanted = wanted_of(borrowed(wanted_vector))
    figures = figures_of(borrowed(figures_vector), law.n)
    begin(figures)
    for k in range(stamps.size):
        told = sample_of(samples[k], law)
        weigh(wanted, figures, stamps[k] * 1e-9, measurements[k], told)
        if figures.finite[0] == 0.0:
            return
