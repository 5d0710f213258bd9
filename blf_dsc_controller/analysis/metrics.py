# SPDX-License-Identifier: Apache-2.0
"""Metrics of a run: as JSON (summary.json), and as a table for the terminal."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.law.telemetry import load_text
from blf_dsc_controller.messages.journal import OUTSIDE_BOUND
from blf_dsc_controller.messages.topics import (
    COLUMNS,
    COMPUTE_TIME,
    CONTACT,
    DISTANCE,
    DISTURBANCE,
    LAMBDA_MIN,
    LATCHED,
    LATE_STEPS,
    LATENCY,
    LOAD,
    LYAPUNOV,
    MODEL_CHANGES,
    POSITION,
    RATIO,
    TOOL,
    VELOCITY,
)
from blf_dsc_controller.run import Floats, Regressor, Run

MOMENTS = (5, 10, 20, 40, 60)
"""Times at which the parameter error is reported [s]."""

_LEARNED = 0.01
_SHOWN_SINGLY = 8  # estimates that are shown one by one
_SHOWN_CONTACTS = 3
_POSTURES = 400  # of the reference, at which torques are compared
_TAIL = 10.0  # s
_MAX_SAMPLES = 100_000  # samples of the estimates, evenly spaced
_BLOCK = 8192
_QUANTILES = (('p50', 50.0), ('p99', 99.0), ('p99.9', 99.9), ('max', 100.0))  # %
_OFTEN = 0.01  # of the samples
_TABLE = {  # title: metric, unit, factor, decimals
    'max |xi1|': ('max_error', 'mrad', 1e3, 3),
    'rms xi1': ('rms_error', 'mrad', 1e3, 3),
    'bound': ('bound', 'mrad', 1e3, 3),
    'peak torque': ('peak_torque', 'N m', 1.0, 2),
    'rms torque': ('rms_torque', 'N m', 1.0, 2),
    'limit': ('torque_limit', 'N m', 1.0, 2),
}
_NO_PARAMETERS = (
    *(*COLUMNS, DISTURBANCE, POSITION, VELOCITY, RATIO, DISTANCE, *LOAD, LYAPUNOV),
    *(LAMBDA_MIN, LATCHED, MODEL_CHANGES, *CONTACT, *TOOL, COMPUTE_TIME),
)


@dataclass(frozen=True)
class Estimates:
    """Estimated model parameters over m samples."""

    names: tuple[str, ...]
    time: Floats  # (m,) s since the first sample of the run
    estimate: Floats  # (m, p)
    # (m, p); None if unknown, or if the plant's parameters have other names
    true: Floats | None
    # (m,) |P^ - P| / |P|, or of torques; None if P is unknown
    relative_error: Floats | None
    # of H P^ and H P along the reference, as the P of a URDF has mixed units
    of_torques: bool


def estimates_of(run: Run) -> Estimates | None:
    """Return the estimates of the model parameters, None if nothing was learned.

    They are compared with the truth by name, and only if the plant has the same
    parameters; those of a URDF arm are compared by their torques.
    """
    if run.monitor is None:
        return None
    names = _parameters(run.monitor.names)
    truth = run.truth
    arm = run.arm
    of_torques = arm is not None and _parameters(arm.units) == names
    is_known = truth is not None and set(names) == set(_parameters(truth.names))
    R = None  # |R (P^ - P)| is the norm of the torques H P^ - H P
    if arm is not None and of_torques and is_known:  # before the memory is full
        R = np.asarray(np.linalg.qr(_torques(run, arm.regressor), 'r'))
    step = -(-run.monitor.stamp.size // _MAX_SAMPLES)
    rows = slice((run.monitor.stamp.size - 1) % step, None, step)
    stamp = run.monitor.stamp[rows]
    estimate = run.monitor.values[rows, run.monitor.indices(names)]
    true = error = None
    if truth is not None and is_known:
        true = truth.held(stamp, names)
        error = _relative_error(estimate, true, R)
    return Estimates(names, run.time_of(stamp), estimate, true, error, of_torques)


def rejected_columns(run: Run) -> list[str]:
    """Return the disturbance columns that are rejected, NaN, at the end."""
    if run.monitor is None:
        return []
    last = run.monitor.values[run.monitor.stamp.size - 1 :][0]
    names = [run.monitor.names[j] for j in np.flatnonzero(np.isnan(last))]
    return [name for name in names if name.startswith(COLUMNS)]


def _relative_error(estimate: Floats, P: Floats, R: Floats | None) -> Floats:
    """Return |P^ - P| / |P| (m,), or |R (P^ - P)| / |R P|."""
    found = np.empty(len(P))
    for begin in range(0, len(P), _BLOCK):
        some = slice(begin, begin + _BLOCK)
        off, size = estimate[some] - P[some], P[some]
        if R is not None:
            off, size = off @ R.T, size @ R.T
        # no motion, no torques: unknown
        with np.errstate(over='ignore', invalid='ignore'):
            found[some] = np.linalg.norm(off, axis=1) / np.linalg.norm(size, axis=1)
    return found


def _torques(run: Run, regressor: Regressor) -> Floats:
    """Return H(q, dq, dq, ddq) (k n, p) along the reference, else the motion.

    The derivatives are three-point differences.
    """
    name = 'position' if run.column('reference', 0) is None else 'reference'
    finite = np.isfinite(sum(_known(run, name, i) for i in range(len(run.joints))))
    known = 1 + np.flatnonzero(finite[:-2] & finite[1:-1] & finite[2:])
    rows = known[np.linspace(0, known.size - 1, min(_POSTURES, known.size)).astype(int)]
    after, before = (np.diff(run.time)[rows + k, np.newaxis] for k in (0, -1))
    earlier, q, later = (getattr(run, name)[rows + k] for k in (-1, 0, 1))
    forward = (later - q) / after
    backward = (q - earlier) / before
    dq = (after * backward + before * forward) / (after + before)
    ddq = 2.0 * (forward - backward) / (after + before)
    H = regressor(q, dq, dq, ddq)
    return H.reshape(-1, H.shape[-1])


def _parameters(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names that are parameters of an arm."""
    return tuple(name for name in names if not name.startswith(_NO_PARAMETERS))


def bodies_of(names: Sequence[str]) -> dict[str, list[int]]:
    """Return the indices of the estimates of each link and kind of friction.

    Of few, each alone.
    """
    if len(names) <= _SHOWN_SINGLY:
        return {name: [k] for k, name in enumerate(names)}
    bodies: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        link = re.search(r'\d+$', name)
        body = f'link {link[0]}' if link and ' ' not in name else name.split(' ')[0]
        bodies.setdefault(body, []).append(k)
    return bodies


def errors_of_bodies(
    bodies: Mapping[str, Sequence[int]],
    estimate: Floats,
    true: Floats | None,
    prior: Floats,
) -> Floats:
    """Return the rms error (b, m) of each body's estimates (m, p) [% of the prior].

    Off the truth or, where none is known, off the first estimates; a rejected estimate
    is NaN. `prior` (p,) are deviations.
    """
    return np.array(
        [
            _rms_of_known(
                estimate[:, body],
                None if true is None else true[:, body],
                prior[body],
            )
            for body in bodies.values()
        ]
    )


def _rms_of_known(estimate: Floats, true: Floats | None, prior: Floats) -> Floats:
    """Return the rms error (m,) of the estimates (m, k) of one body."""
    origin = estimate[:1]
    if true is not None:
        origin = np.where(np.isnan(true), estimate[0], true)
    square = (100.0 * (estimate - origin) / prior) ** 2
    with np.errstate(divide='ignore', invalid='ignore'):  # all rejected: 0 / 0
        mean = np.nansum(square, axis=1) / np.isfinite(square).sum(axis=1)
    rms: Floats = np.sqrt(mean)
    return rms


def latch_time(run: Run) -> float:
    """Return the time at which learning began [s].

    It is NaN if it never did, or is not recorded.
    """
    return next(iter(_rises(run, LATCHED)), math.nan) if run.learns else math.nan


def change_times(run: Run) -> list[float]:
    """Return the times [s] at which the controller detected a change of the arm."""
    return _rises(run, MODEL_CHANGES)


def _rises(run: Run, name: str) -> list[float]:
    """Return the times [s] at which a count of the learning rises."""
    if run.monitor is None or name not in run.monitor.names:
        return []
    rises = np.flatnonzero(
        np.diff(np.nan_to_num(run.monitor.column(name)), prepend=0.0) > 0.0
    )
    return [float(t) for t in run.time_of(run.monitor.stamp[rises])]


def true_change_times(run: Run) -> list[float]:
    """Return the times [s] at which the plant's true parameters began to change."""
    if run.truth is None:
        return []
    columns = run.truth.indices(_parameters(run.truth.names))
    changes = [
        np.any(
            np.diff(run.truth.values[begin : begin + _BLOCK + 1, columns], axis=0), 1
        )
        for begin in range(0, run.truth.stamp.size, _BLOCK)
    ]
    changed = np.concatenate(changes)
    begins = np.flatnonzero(np.diff(changed, prepend=False) & changed) + 1
    return [float(t) for t in run.time_of(run.truth.stamp[begins])]


def outside(run: Run, i: int) -> NDArray[np.bool_] | None:
    """Return where |xi1| >= k_c for a joint, (N,).

    None if error or bound is unknown.
    """
    error = run.column('error', i)
    bound = run.column('bound', i)
    return (
        None if error is None or bound is None else np.asarray(np.abs(error) >= bound)
    )


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


def _known(run: Run, name: str, i: int) -> Floats:
    """Return the values of one joint, NaN where they are unknown."""
    found = run.column(name, i)
    return np.full(run.stamp.size, np.nan) if found is None else found


def first_violation(run: Run) -> tuple[float, str]:
    """Return when [s] a joint first left its bound, and which.

    NaN and empty if none did.

    The error of the sample that causes a stop is not published, so the stop itself
    counts.
    """
    found = [
        (time, next((joint for joint in run.joints if f'{joint!r}' in stop.text), ''))
        for time, stop in run.timed_stops
        if stop.reason == OUTSIDE_BOUND
    ]
    for i, joint in enumerate(run.joints):
        violated = outside(run, i)
        if violated is not None and violated.any():
            found.append((float(run.time[violated.argmax()]), joint))
    return min(found, key=itemgetter(0), default=(math.nan, ''))


@dataclass(frozen=True)
class Metrics:
    """Metrics of a run of n joints.

    NaN, or None, for what is unknown or has not happened.
    """

    duration: float  #: s
    samples: int
    joints: tuple[str, ...]
    max_error: tuple[float, ...]  #: (n,) rad, of |xi1|
    rms_error: tuple[float, ...]  #: (n,) rad
    bound: tuple[float, ...]  #: (n,) rad, the smallest
    widest_bound: tuple[float, ...]  #: (n,) rad, of a funnel or before a change
    peak_torque: tuple[float, ...]  #: (n,) N m
    rms_torque: tuple[float, ...]  #: (n,) N m
    torque_limit: tuple[float, ...]  #: (n,) N m, the smallest
    torque_rate: tuple[float, ...]  #: (n,) N m/s, rms of the change per sample time
    max_error_ratio: float  #: of |xi1| / k_c
    held: bool | None  #: whether no joint left its bound
    first_violation: float  #: s
    violating_joint: str
    stops: list[dict[str, Any]]  #: `time` [s], `reason` and `text` of each
    #: `time` [s], `joint`, `torque`, `interval` [N m] of each; None: nothing looked for any
    contacts: list[dict[str, Any]] | None
    learns: bool  #: whether the law uses what it learns
    latch_time: float  #: s
    model_changes: list[float]  #: s, when the controller found that the arm had changed
    rejected_columns: list[str]
    loads: list[dict[str, float]]  #: what the tip held `until` [s], where known
    #: largest `error` [m] and `angle` [rad] at the tool, with their certified bounds then
    tool: dict[str, float] | None
    #: `rate` [Hz], `latency` [s], `late_steps`, in real time
    timing: dict[str, Any] | None
    estimate: dict[str, float] | None = None  #: at the end
    true: dict[str, float] | None = None  #: at the end
    of_torques: bool = False  #: whether the following are errors of the model's torques
    parameter_error: dict[int, float] = field(
        default_factory=lambda: dict.fromkeys(MOMENTS, math.nan)
    )  #: `Estimates.relative_error` at MOMENTS
    final_parameter_error: float = math.nan
    tail_parameter_error: float = math.nan  #: rms over the last ten seconds
    #: s, after which the parameter error stays below 1 %
    time_to_1_percent: float = math.nan


@np.errstate(all='ignore')  # a bag may hold any number
def measure(run: Run) -> Metrics:
    """Compute the metrics of a run."""
    step = float(run.time[1]) if run.stamp.size > 1 else math.nan
    ratio = _largest_ratio(run)
    (violation, joint) = first_violation(run)
    held = None if math.isnan(ratio) else True
    estimates = estimates_of(run)

    def each(reduce: Callable[[Floats], float], name: str) -> tuple[float, ...]:
        return tuple(reduce(_known(run, name, i)) for i in range(len(run.joints)))

    return Metrics(
        duration=run.duration,
        samples=run.stamp.size,
        joints=run.joints,
        max_error=each(_peak, 'error'),
        rms_error=each(rms, 'error'),
        bound=each(_least, 'bound'),
        widest_bound=each(_peak, 'bound'),
        peak_torque=each(_peak, 'torque'),
        rms_torque=each(rms, 'torque'),
        torque_limit=each(_least, 'torque_limit'),
        torque_rate=each(lambda torque: rms(np.diff(torque)) / step, 'torque'),
        max_error_ratio=ratio,
        held=held if math.isnan(violation) else False,
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
        'of_torques': of.of_torques,
        'parameter_error': _at_moments(at, error),
        'final_parameter_error': float(error[-1]),
        'tail_parameter_error': rms(error[at >= at[-1] - _TAIL]),
        'time_to_1_percent': _settled(at, error),
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
    """Return the largest error and angle at the tool, each with the bound that it had."""
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
        (_known(run, 'error', i), _known(run, 'bound', i))
        for i in range(len(run.joints))
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
    """Return the error at the sample nearest to each moment.

    NaN where the run did not reach it.
    """
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


def write_json(numbers: Any, path: Path) -> None:
    """Write metrics, or other data in dictionaries and lists, as JSON."""
    path.write_text(
        json.dumps(plain(numbers), indent=2, allow_nan=False) + '\n', encoding='utf-8'
    )


def plain(value: Any) -> Any:
    """Convert to lists and dictionaries for JSON.

    NaN and infinity become None.
    """
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def format_table(metrics: Metrics) -> str:
    """Format metrics as a few lines for the terminal, without a newline at the end."""
    rows = [['', *_TABLE]]
    for i, joint in enumerate(metrics.joints):
        values = ((getattr(metrics, name)[i], *form) for name, *form in _TABLE.values())
        cells = (
            f'{factor * value:.{decimals}f} {unit}' if math.isfinite(value) else '-'
            for value, unit, factor, decimals in values
        )
        rows.append([joint, *cells])
    return '\n'.join([aligned(rows), '', *_sentences(metrics)])


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return a table for the terminal: first column flush left, others right."""
    first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    return '\n'.join(
        '  '.join([name.ljust(first), *map(str.rjust, values, widths)])
        for name, *values in rows
    )


def _sentences(of: Metrics) -> Iterator[str]:
    yield f'run         {of.duration:.3f} s, {of.samples} samples'
    kept = 'unknown' if of.held is None else 'held by every joint'
    if not math.isnan(of.first_violation):
        kept = f'VIOLATED, first by {of.violating_joint} at {of.first_violation:.3f} s'
    yield f'bound       {kept}{" until the stop" * bool(of.stops and of.held)}'
    bounds = zip(of.joints, of.widest_bound, of.bound, strict=True)
    wider = [
        f'{joint} {1e3 * widest:.3g} mrad'
        for joint, widest, bound in bounds
        if widest > bound
    ]
    if wider:
        yield f'at widest   {", ".join(wider)}'
    if of.tool is not None:
        yield f'tool        {tool_text(of.tool)}'
    for stop in of.stops:
        yield f'stopped     at {stop["time"]:.3f} s, {stop["reason"]}: {stop["text"]}'
    if of.contacts is not None:
        yield f'contacts    {contacts_text(of.contacts)}'
    if of.estimate is not None:
        yield from _learning_lines(of)
    for load in of.loads:
        yield f'held        {load_text([load[name] for name in LOAD])}, until {load["until"]:.1f} s'
    if of.timing is not None:
        rate, latency, late = of.timing.values()
        figures = [] if math.isnan(rate) else [f'{rate:.2f} Hz']
        if not math.isnan(latency['max']):
            microseconds = '/'.join(f'{1e6 * each:.1f}' for each in latency.values())
            figures.append(f'state to torque {microseconds} us ({"/".join(latency)})')
        is_slow = late > _OFTEN * of.samples
        busy = (
            ': the computer was too busy for real time (--mode lockstep waits)'
            * is_slow
        )
        yield f'real time   {", ".join([*figures, f"{late} late steps"])}{busy}'


def tool_text(tool: Mapping[str, float]) -> str:
    """Return `Metrics.tool` in words."""
    mm = f'{1e3 * tool["error"]:.3g} mm off at most, {1e3 * tool["bound"]:.3g} mm certified there'
    mrad = f'turned {1e3 * tool["angle"]:.3g} mrad, {1e3 * tool["angle_bound"]:.3g} mrad certified'
    share = f'{100.0 * tool["ratio"]:.3g} % and {100.0 * tool["angle_ratio"]:.3g} % of the bounds'
    return f'{mm}; {mrad}; at most {share}'


def contacts_text(contacts: Sequence[Mapping[str, Any]]) -> str:
    """Return `Metrics.contacts` in words."""
    first = '; '.join(
        f'at {each["time"]:.3f} s {each["torque"]:+.3g} N m on {each["joint"]}, where model '
        f'and noise explain {each["interval"]:.2g} N m'
        for each in contacts[:_SHOWN_CONTACTS]
    )
    more = len(contacts) - _SHOWN_CONTACTS
    return f'{len(contacts)}{": " * bool(first)}{first}' + f'; {more} more' * (more > 0)


def _learning_lines(of: Metrics) -> Iterator[str]:
    begun = (
        'never began'
        if math.isnan(of.latch_time)
        else f'began at {of.latch_time:.3f} s'
    )
    yield f'learning    {begun if of.learns else "not used by this law"}'
    if of.model_changes:
        times = ', '.join(f'{t:.3f} s' for t in of.model_changes)
        yield f'arm         changed at {times}: learning restarted'
    if of.rejected_columns:
        columns = ', '.join(of.rejected_columns)
        yield f'rejected    {columns}: the motion does not tell them from the other columns'
    if math.isnan(of.final_parameter_error):
        return
    what = (
        'model       torque error of the learned model'
        if of.of_torques
        else 'parameters  error'
    )
    known = [
        (f'{t} s', error)
        for t, error in of.parameter_error.items()
        if not math.isnan(error)
    ]
    moments = (
        f'{t} {100 * e:.3g} %' for t, e in (*known, ('end', of.final_parameter_error))
    )
    settled = of.time_to_1_percent
    ending = (
        'not below 1 %' if math.isnan(settled) else f'below 1 % from {settled:.3f} s on'
    )
    yield f'{what} {", ".join(moments)}; {ending}'
