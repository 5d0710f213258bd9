# SPDX-License-Identifier: Apache-2.0
"""The verdict on a run: one sentence, and the figures that matter most."""

from __future__ import annotations

import math
from typing import NamedTuple

from blf_dsc_controller.analysis.metrics import Metrics
from blf_dsc_controller.messages.topics import LOAD

GOOD, BAD, UNKNOWN = 'good', 'bad', 'unknown'
_MASS, _SPREAD = LOAD[0], LOAD[4]


class Verdict(NamedTuple):
    """Whether a run did what it should."""

    tone: str  # GOOD, BAD or UNKNOWN
    text: str


class Figure(NamedTuple):
    """One figure with its name and what belongs to it."""

    title: str
    value: str
    detail: str = ''


def verdict_of(metrics: Metrics) -> Verdict:
    """Return the sentence that comes first."""
    if not math.isnan(metrics.first_violation):
        when = f'{metrics.first_violation:.3f} s'
        return Verdict(BAD, f'{metrics.violating_joint} left its bound at {when}.')
    if metrics.stops:
        first = metrics.stops[0]
        return Verdict(BAD, f'Stopped at {first["time"]:.3f} s: {first["reason"]}.')
    if metrics.held is None:
        return Verdict(UNKNOWN, 'The bag has no bounds, or no errors, to compare.')
    return Verdict(GOOD, 'Every joint stayed inside its bound.')


def figures_of(metrics: Metrics) -> list[Figure]:
    """Return the figures below it."""
    return [
        _bound(metrics),
        _error(metrics),
        _load(metrics),
        _model(metrics),
        _stops(metrics),
    ]


def _bound(of: Metrics) -> Figure:
    if math.isnan(of.max_error_ratio):
        return Figure('of the bound', '-', 'not recorded')
    detail = 'largest error, any joint'
    if of.left_at_stop:
        detail += ', before the stop'
    return Figure('of the bound', f'{100.0 * of.max_error_ratio:.0f} %', detail)


def _error(of: Metrics) -> Figure:
    known = [i for i, error in enumerate(of.max_error) if math.isfinite(error)]
    if not known:
        return Figure('largest error', '-', 'not recorded')
    worst = max(known, key=lambda i: of.max_error[i])
    joint = of.joints[worst]
    unit = of.units(joint).of('mrad')
    return Figure('largest error', f'{1e3 * of.max_error[worst]:.3g} {unit}', joint)


def _load(of: Metrics) -> Figure:
    # also not where they are NaN
    known = [load for load in of.loads if load[_MASS] > load[_SPREAD]]
    if not known:
        return Figure('load', 'none', 'was weighed')
    heaviest = max(known, key=lambda load: load[_MASS])
    detail = f'± {heaviest[_SPREAD]:.2g} kg'
    return Figure('heaviest load', f'{heaviest[_MASS]:.3f} kg', detail)


def _model(of: Metrics) -> Figure:
    if not math.isnan(of.parameter_error.end):
        what = (
            'of the torque, at the end'
            if of.parameter_error.of_torques
            else 'of the parameters, at the end'
        )
        return Figure('model error', f'{100.0 * of.parameter_error.end:.3g} %', what)
    if not of.learns:
        return Figure('model', 'given', 'this law learns none')
    if math.isnan(of.latch_time):
        return Figure('model', 'as given', 'learning never began')
    return Figure('model', 'learned', f'from {of.latch_time:.1f} s on')


def _stops(of: Metrics) -> Figure:
    if not of.stops:
        return Figure('stops', '0')
    first = of.stops[0]
    return Figure('stops', f'{len(of.stops)}', f'first at {first["time"]:.3f} s')
