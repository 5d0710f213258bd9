# SPDX-License-Identifier: Apache-2.0
"""What the study asks of a run: tracking, torque and parameters, each as one number."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from blf_dsc_controller.law.sample import sample_of
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import Record

MOMENTS = (5, 10, 20, 40, 60)
"""Times at which the parameter error is told [s]."""

_SETTLED = 0.01
_TAIL = 10.0  # s at the end over which the last parameter error is averaged


@dataclass(frozen=True)
class Courses:
    """The courses of a run that the study looks at; the first axis is the sample."""

    time: Floats  # (N,) s
    position: Floats  # (N, n) rad, true
    reference: Floats  # (N, n) rad
    error: Floats  # (N, n) rad, xi1
    torque: Floats  # (N, n) N m, commanded
    estimate: Floats  # (N, p)
    truth: Floats  # (p,)
    lyapunov: Floats  # (N, 4)
    lambda_min: Floats  # (N,)
    latched: Floats  # (N,)

    @classmethod
    def of(cls, record: Record) -> Courses:
        """Take them from the record of a run."""
        n = record.joints
        p = record.truths.shape[1] - 3 * n
        at = sample_of(
            np.arange(record.samples.shape[1], dtype=np.float64), record.controller.settings
        )
        part = {name: record.samples[:, getattr(at, name).astype(int)] for name in at._fields}
        return cls(
            time=record.stamps * 1e-9,
            position=record.truths[:, p + n : p + 2 * n],
            reference=part['qr'],
            error=part['xi1'],
            torque=part['torque'],
            estimate=part['estimate'][:, :p],
            truth=record.truths[0, :p],
            lyapunov=part['lyapunov'],
            lambda_min=part['lambda_min'][:, 0],
            latched=part['latched'][:, 0],
        )

    @property
    def parameter_error(self) -> Floats:
        """|P^ - P| / |P| of each sample."""
        error = np.linalg.norm(self.estimate - self.truth, axis=1)
        return np.asarray(error / np.linalg.norm(self.truth))


@dataclass(frozen=True)
class Metrics:
    """One run in numbers; NaN where the run is too short to tell."""

    max_error: tuple[float, ...]  # rad, of |xi1|, per joint
    rms_error: tuple[float, ...]  # rad
    peak_torque: tuple[float, ...]  # N m
    rms_torque: tuple[float, ...]  # N m
    torque_rate: tuple[float, ...]  # N m/s, rms of the change per sample time
    parameter_error: dict[int, float]  # at MOMENTS
    tail_error: float  # rms of the parameter error over the last ten seconds
    time_to_1_percent: float  # s, from which on it stays below; NaN: never
    largest_ratio: float  # of |xi1| / k_c
    first_violation: float  # s; NaN: the bound was held
    learning_start: float  # s, of the first latch; NaN: never

    @property
    def held(self) -> bool:
        """Whether no sample left the bound."""
        return math.isnan(self.first_violation)

    def plain(self) -> dict[str, Any]:
        """The same as plain data, None for NaN."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def measure(courses: Courses, bound: Floats) -> Metrics:
    """Numbers of a run with the bound k_c (n,) [rad]."""
    error, torque, time = np.abs(courses.error), courses.torque, courses.time
    step = time[1] - time[0]
    ratio = (error / bound).max(axis=1)
    learned = courses.parameter_error
    return Metrics(
        max_error=_tuple(error.max(axis=0)),
        rms_error=_tuple(_rms(error)),
        peak_torque=_tuple(np.abs(torque).max(axis=0)),
        rms_torque=_tuple(_rms(torque)),
        torque_rate=_tuple(_rms(np.diff(torque, axis=0)) / step),
        parameter_error={moment: _at(time, learned, moment) for moment in MOMENTS},
        tail_error=float(_rms(learned[time >= time[-1] - _TAIL])),
        time_to_1_percent=_from_when(time, learned < _SETTLED),
        largest_ratio=float(ratio.max()),
        first_violation=_first(time, ratio >= 1.0),
        learning_start=_first(time, courses.latched > 0.5),
    )


def _rms(values: Floats) -> Floats:
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def _tuple(values: Floats) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _at(time: Floats, values: Floats, moment: float) -> float:
    if moment > time[-1] + 1e-9:
        return math.nan
    return float(values[np.abs(time - moment).argmin()])


def _first(time: Floats, happened: np.ndarray) -> float:
    return float(time[happened.argmax()]) if happened.any() else math.nan


def _from_when(time: Floats, good: np.ndarray) -> float:
    bad = np.flatnonzero(~good)
    first = bad[-1] + 1 if bad.size else 0
    return float(time[first]) if first < time.size else math.nan


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value
