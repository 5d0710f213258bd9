# SPDX-License-Identifier: Apache-2.0
"""A run in figures: the content of summary.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.estimation import Estimation, latch_time
from blf_dsc_controller.messages.names import COMPUTE_TIME, LATE_STEPS, LATENCY
from blf_dsc_controller.run import Floats, Run, Series

Summary = dict[str, Any]

MOMENTS = (5, 10, 20, 40, 60)
"""Times at which the parameter error is told [s]."""

_LEARNED = 0.01
_PERCENTILES = {'p50': 50.0, 'p99': 99.0, 'p99.9': 99.9, 'max': 100.0}
_MICROSECONDS = 1e6


def summarize(run: Run) -> Summary:
    """Summary of a run as plain data for JSON; units are part of the names.

    What the run does not tell is None, as is what has not happened.
    """
    return {
        'duration_s': run.duration,
        'samples': int(run.stamp.size),
        'tracking': _tracking(run),
        'learning': _learning(run),
        'timing': _timing(run),
        'compute_time_us': _compute_time(run),
        'messages': dict(run.message_counts),
    }


def write_summary(summary: Summary, path: Path) -> None:
    """Write a summary as JSON."""
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + '\n', encoding='utf-8')


def _tracking(run: Run) -> Summary:
    joints = {joint: _joint(run, i) for i, joint in enumerate(run.joints)}
    summary: Summary = {'held': None, 'first_violation': None, 'joints': joints}
    if run.error is not None and run.bound is not None:
        outside = np.abs(run.error) >= run.bound
        summary['held'] = not outside.any()
        if outside.any():
            k, i = np.argwhere(outside)[0]
            summary['first_violation'] = {'time_s': float(run.time[k]), 'joint': run.joints[i]}
    return summary


def _joint(run: Run, i: int) -> Summary:
    error = None if run.error is None else run.error[:, i]
    torque = run.torque[:, i]
    return {
        'max_abs_error_rad': _peak(error),
        'rms_error_rad': _rms(error),
        'bound_rad': _least(None if run.bound is None else run.bound[:, i]),
        'peak_torque_nm': _peak(torque),
        'rms_torque_nm': _rms(torque),
        'torque_limit_nm': _least(None if run.torque_limit is None else run.torque_limit[:, i]),
    }


def _learning(run: Run) -> Summary | None:
    estimation = Estimation.of(run)
    if estimation is None:
        return None
    summary: Summary = {
        'latch_time_s': latch_time(run),
        'relative_error_at_s': None,
        'final_relative_error': None,
        'time_to_1_percent_s': None,
        'final_estimate': {
            name: None if np.isnan(value) else float(value)
            for name, value in zip(estimation.names, estimation.estimate[-1], strict=True)
        },
        'refused_columns': {name: reason or None for name, reason in run.refused.items()},
        'true': None,
    }
    error = estimation.relative_error
    if error is not None and estimation.true is not None:
        summary['relative_error_at_s'] = _at_moments(estimation.time, error)
        summary['final_relative_error'] = float(error[-1])
        summary['time_to_1_percent_s'] = _time_below(estimation.time, error, _LEARNED)
        summary['true'] = dict(zip(estimation.names, estimation.true[-1].tolist(), strict=True))
    return summary


def _at_moments(time: Floats, error: Floats) -> Summary:
    """Error at the sample next to each moment that the run has reached, to within a sample."""
    sample_time = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    reached = [moment for moment in MOMENTS if time[0] <= moment <= time[-1] + 1.5 * sample_time]
    return {str(moment): float(error[np.abs(time - moment).argmin()]) for moment in reached}


def _time_below(time: Floats, error: Floats, threshold: float) -> float | None:
    """Time from which on the error stays below a threshold to the end."""
    above = np.flatnonzero(~(error < threshold))
    first = above[-1] + 1 if above.size else 0
    return float(time[first]) if first < time.size else None


def _timing(run: Run) -> Summary | None:
    """Real time: how fast the samples came, and how late the torques."""
    if run.timing is None or LATENCY not in run.timing.names:
        return None
    moving = run.received[1:]  # the first state waits, braked, for the controller
    elapsed = float(moving[-1] - moving[0]) * 1e-9 if moving.size else 0.0
    return {
        'rate_hz': (moving.size - 1) / elapsed if elapsed > 0 else None,
        'latency_us': _percentiles(_MICROSECONDS * run.timing.column(LATENCY)),
        'late_steps': _late_steps(run.timing),
    }


def _late_steps(timing: Series) -> int | None:
    return int(timing.column(LATE_STEPS)[-1]) if LATE_STEPS in timing.names else None


def _compute_time(run: Run) -> Summary | None:
    if run.learning is None or COMPUTE_TIME not in run.learning.names:
        return None
    return _percentiles(_MICROSECONDS * run.learning.column(COMPUTE_TIME))


def _percentiles(values: Floats) -> Summary | None:
    known = values[np.isfinite(values)]
    if known.size == 0:
        return None
    return {name: float(np.percentile(known, q)) for name, q in _PERCENTILES.items()}


def _known(values: Floats | None) -> Floats:
    return np.empty(0) if values is None else values[np.isfinite(values)]


def _peak(values: Floats | None) -> float | None:
    known = _known(values)
    return float(np.abs(known).max()) if known.size else None


def _rms(values: Floats | None) -> float | None:
    known = _known(values)
    return float(np.sqrt(np.mean(known**2))) if known.size else None


def _least(values: Floats | None) -> float | None:
    known = _known(values)
    return float(known.min()) if known.size else None
