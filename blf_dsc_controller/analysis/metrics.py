# SPDX-License-Identifier: Apache-2.0
"""Metrics of a run."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.estimates import (
    Estimates,
    estimates_of,
    rejected_columns,
)
from blf_dsc_controller.analysis.event_times import (
    change_times,
    first_violation,
    latch_time,
)
from blf_dsc_controller.errors import check_type
from blf_dsc_controller.messages.topics import (
    LATE_STEPS,
    LATENCY,
    LOAD,
    TOOL,
)
from blf_dsc_controller.run import SLIDING, TURNING, Floats, JointUnits, Run

MOMENTS = (5, 10, 20, 40, 60)
"""Times at which the parameter error is reported [s]."""

_LEARNED = 0.01
_TAIL = 10.0  # s
_BLOCK = 8192
_QUANTILES = (('p50', 50.0), ('p99', 99.0), ('p99.9', 99.9), ('max', 100.0))  # %


def tool_errors(run: Run) -> Floats | None:
    """Return `topics.TOOL` (N, 4) [m, rad] of every sample, NaN where unknown.

    None of an arm without a bound at its tool.
    """
    arrays = [
        each for each in (run.reference, run.error, run.bound) if each is not None
    ]
    if run.tool is None or len(arrays) < 3:
        return None
    found = np.empty((run.stamp.size, len(TOOL)))
    for begin in range(0, len(found), _BLOCK):
        some = slice(begin, begin + _BLOCK)
        reference, error, bound = (np.asarray(each[some]) for each in arrays)
        found[some] = run.tool(reference, error, bound)
    return found


@dataclass(frozen=True)
class ParameterError:
    """How far the estimates are off the truth: `Estimates.relative_error`; NaN if unknown."""

    #: whether it is that of the model's torques, as of a URDF's arm
    of_torques: bool = False
    at: dict[int, float] = field(
        default_factory=lambda: dict.fromkeys(MOMENTS, math.nan)
    )  #: MOMENTS
    end: float = math.nan
    tail: float = math.nan  #: rms over the last ten seconds
    #: s, after which it stays below 1 %
    time_to_1_percent: float = math.nan


@dataclass(frozen=True)
class Metrics:
    """Metrics of a run of n joints.

    NaN, or None, for what is unknown or has not happened.
    """

    duration: float  #: s
    samples: int
    joints: tuple[str, ...]
    sliding: tuple[str, ...]  #: those that slide: m and N instead of rad and N m
    # of each joint
    max_error: tuple[float, ...]  #: (n,) rad, of |xi1|
    rms_error: tuple[float, ...]  #: (n,) rad
    bound: tuple[float, ...]  #: (n,) rad, the smallest
    widest_bound: tuple[float, ...]  #: (n,) rad, of a funnel or before a change
    peak_torque: tuple[float, ...]  #: (n,) N m
    rms_torque: tuple[float, ...]  #: (n,) N m
    torque_limit: tuple[float, ...]  #: (n,) N m, the smallest
    torque_rate: tuple[float, ...]  #: (n,) N m/s, rms of the change per sample time
    # the bound, and what happened
    max_error_ratio: float  #: of |xi1| / k_c
    held: bool | None  #: whether no joint left its bound
    first_violation: float  #: s
    violating_joint: str
    stops: list[dict[str, Any]]  #: `time` [s], `reason` and `text` of each
    #: `time` [s], `joint`, `torque`, `interval` [N m] of each, or None if not detected
    contacts: list[dict[str, Any]] | None
    # learning
    learns: bool  #: whether the law uses what it learns
    latch_time: float  #: s
    model_changes: list[float]  #: s, when changes of the arm were detected
    rejected_columns: list[str]
    loads: list[dict[str, float]]  #: weighed loads, each held `until` [s]
    #: largest `error` [m] and `angle` [rad] at the tool, with certified bounds
    tool: dict[str, float] | None
    #: `rate` [Hz], `latency` [s], `late_steps`, in real time
    timing: dict[str, Any] | None
    # what was learned, beside the truth
    estimate: dict[str, float] | None = None  #: at the end
    true: dict[str, float] | None = None  #: at the end
    parameter_error: ParameterError = field(default_factory=ParameterError)

    def units(self, joint: str) -> JointUnits:
        """Return the units of a joint."""
        return SLIDING if joint in self.sliding else TURNING

    @property
    def left_at_stop(self) -> bool:
        """Whether the error that left the bound is in the text of the stop alone.

        No message has the sample that causes a stop, so `max_error` is that of those before.
        """
        return self.held is False and self.max_error_ratio < 1.0


@np.errstate(all='ignore')  # a bag may hold any number
def measure(run: Run) -> Metrics:
    """Compute the metrics of a run.

    Raises ArgumentTypeError if it is none, as a record of `simulate`.
    """
    check_type('run', run, Run, 'simulate(...).run() and read_run return one')
    step = float(run.time[1]) if run.stamp.size > 1 else math.nan
    ratio = _largest_ratio(run)
    violation, joint = first_violation(run)
    estimates = estimates_of(run)

    def each(reduce: Callable[[Floats], float], name: str) -> tuple[float, ...]:
        return tuple(reduce(run.known(name, i)) for i in range(len(run.joints)))

    return Metrics(
        duration=run.duration,
        samples=run.stamp.size,
        joints=run.joints,
        sliding=run.sliding,
        max_error=each(_peak, 'error'),
        rms_error=each(rms, 'error'),
        bound=each(_least, 'bound'),
        widest_bound=each(_peak, 'bound'),
        peak_torque=each(_peak, 'torque'),
        rms_torque=each(rms, 'torque'),
        torque_limit=each(_least, 'torque_limit'),
        torque_rate=each(lambda torque: rms(np.diff(torque)) / step, 'torque'),
        max_error_ratio=ratio,
        held=_held(ratio, violation),
        first_violation=violation,
        violating_joint=joint,
        stops=[
            {'time': time, 'reason': stop.reason, 'text': stop.text}
            for time, stop in run.timed_stops
        ],
        contacts=_contacts(run),
        learns=run.learns,
        latch_time=latch_time(run),
        model_changes=change_times(run),
        rejected_columns=rejected_columns(run),
        loads=_loads(run),
        tool=_tool(run),
        timing=_timing(run),
        **({} if estimates is None else _learning(estimates)),
    )


def _held(ratio: float, violation: float) -> bool | None:
    """Whether no joint left its bound, by its largest `ratio` and the time of a `violation` [s]."""
    if not math.isnan(violation):
        return False
    return None if math.isnan(ratio) else True


def _learning(of: Estimates) -> dict[str, Any]:
    """Return the metrics of the estimates by name."""
    found: dict[str, Any] = {
        name: dict(zip(of.names, values[-1].tolist(), strict=True))
        for name, values in (('estimate', of.estimate), ('true', of.true))
        if values is not None
    }
    at, error = of.time, of.relative_error
    if error is None:
        return found
    return found | {
        'parameter_error': ParameterError(
            of_torques=of.of_torques,
            at=_at_moments(at, error),
            end=float(error[-1]),
            tail=rms(error[at >= at[-1] - _TAIL]),
            time_to_1_percent=_settled(at, error),
        )
    }


def _contacts(run: Run) -> list[dict[str, Any]] | None:
    if run.contacts is None:
        return None
    found = [{'time': time, **each._asdict()} for time, each in run.timed_contacts]
    for each in found:
        del each['stamp'], each['text']
    return found


def _loads(run: Run) -> list[dict[str, float]]:
    """Return what the tip held, each at the end of a time in which it was known."""
    if run.monitor is None or LOAD[0] not in run.monitor.names:
        return []
    values = run.monitor.select(LOAD)
    known = np.append(np.isfinite(values[:, 0]), False)
    ends = np.flatnonzero(known[:-1] & ~known[1:])
    times = run.time_of(run.monitor.stamp[ends])
    return [
        {'until': float(t), **dict(zip(LOAD, load.tolist(), strict=True))}
        for t, load in zip(times, values[ends], strict=True)
    ]


def _tool(run: Run) -> dict[str, float] | None:
    """Return the largest error and angle at the tool, each with its bound then."""
    values = tool_errors(run)
    if values is None or not np.isfinite(values[:, 0]).any():
        return None
    error, bound, angle, angle_bound = values.T
    at = int(np.nanargmax(error))
    turned = int(np.nanargmax(angle))
    return {
        'error': float(error[at]),
        'bound': float(bound[at]),
        'ratio': _peak(error / bound),
        'angle': float(angle[turned]),
        'angle_bound': float(angle_bound[turned]),
        'angle_ratio': _peak(angle / angle_bound),
    }


def _timing(run: Run) -> dict[str, Any] | None:
    if run.timing is None or not {LATENCY, LATE_STEPS} <= {*run.timing.names}:
        return None
    # the first state waits, with brakes on, for the controller
    moving = run.received[1:]
    elapsed = float(moving[-1] - moving[0]) * 1e-9 if moving.size else 0.0
    latency = run.timing.column(LATENCY)
    return {
        'rate': (moving.size - 1) / elapsed if elapsed > 0 else math.nan,
        'latency': {
            k: _reduced(latency, partial(np.percentile, q=q)) for k, q in _QUANTILES
        },
        'late_steps': int(run.timing.column(LATE_STEPS)[-1]),
    }


def _largest_ratio(run: Run) -> float:
    """Return the largest |xi1| / k_c; NaN if it is unknown."""
    pairs = (
        (run.known('error', i), run.known('bound', i)) for i in range(len(run.joints))
    )
    return float(np.fmax.reduce([_peak(error / bound) for error, bound in pairs]))


def _reduced(values: Floats, reduce: Callable[[Floats], float]) -> float:
    known = values[np.isfinite(values)]
    return float(reduce(known)) if known.size else math.nan


def rms(values: Floats) -> float:
    """Return the root mean square of the known values."""
    return _reduced(values, lambda known: np.sqrt(np.mean(known**2)))


def _peak(values: Floats) -> float:
    return _reduced(values, lambda known: np.abs(known).max())


def _least(values: Floats) -> float:
    return _reduced(values, np.min)


def _at_moments(time: Floats, error: Floats) -> dict[int, float]:
    """Return the error at the sample nearest to each moment; NaN where the run did not reach it."""
    end = time[-1] + 1.5 * (float(np.median(np.diff(time))) if time.size > 1 else 0.0)
    return {
        moment: float(error[np.abs(time - moment).argmin()])
        if time[0] <= moment <= end
        else math.nan
        for moment in MOMENTS
    }


def _settled(time: Floats, error: Floats) -> float:
    above = np.flatnonzero(~(error < _LEARNED))
    first = above[-1] + 1 if above.size else 0
    return float(time[first]) if first < time.size else math.nan
