# SPDX-License-Identifier: Apache-2.0
"""Limits of gains and torques in a sampled loop: what is used of each, and what to change.

They rest on the initial parameter estimate, which is a guess. doc/gains.md says how to choose them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.rules import Excess, Rule, Severity, When
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.warnings.case import Case
from blf_dsc_controller.warnings.reference_load import ReferenceLoad

Floats = NDArray[np.float64]

_MARGIN = 1.25  # recommended torque limit over what the reference needs


def _limits_of_torque(case: Case) -> Iterator[Excess]:
    config, load = case.config, case.load
    for joint, (_, unit, _), need, limit in zip(
        config.joints, config.units, load.torque, config.torque.limit, strict=True
    ):
        yield Excess(
            f'torque.limit: {joint}',
            _MARGIN * need / limit,
            f'has {limit:g} {unit}, but with P^(0) the reference alone needs '
            f'{need:.3g} {unit}: let the reference be slower, or give at least '
            f'{_MARGIN * need:.3g} {unit} if the drive has that much',
        )


def _limits_of_feedback(case: Case) -> Iterator[Excess]:
    config, settings, load = case.config, case.settings, case.load
    T = config.sample_time
    rate = load.rate(settings)
    yield Excess(
        f'{_feedback(config)}: K_p over the inertia',
        rate * T,
        f'is {rate:.3g} 1/s with P^(0), {rate * T:.2g} times the inverse of '
        'sample_time. Above 1 the loop has little margin for delays, above 2 it chatters between '
        f'the limits: lower {_feedback(config)} or sample_time',
    )
    absorbed = float(np.max(settings.disturbance.gain * T / _damping(settings, load)))
    yield Excess(
        'disturbance.gain: in each sample the disturbance estimate absorbs',
        2.0 * absorbed,
        f'{absorbed:.2g} of the velocity feedback. Above a half it oscillates against '
        'K_p: lower disturbance.gain',
    )


def _feedback(config: ControllerConfig) -> str:
    """Return the parameter that sets K_p."""
    of_urdf = config.model == 'urdf'
    return 'feedback.joint_damping' if of_urdf else 'two_link.feedback_gain'


def _damping(settings: Settings, load: ReferenceLoad) -> Floats:
    """Return the damping (n,) [N m s/rad] of the feedback, above zero."""
    return np.asarray(np.maximum(load.damping(settings), 1e-12))


def _limits_of_surface(case: Case) -> Iterator[Excess]:
    settings = case.settings
    if settings.surface.known_rate == 0:
        filtering = settings.surface.time_constant
        rate = float(np.max(settings.surface.gain / 2.0 + settings.surface.mu))
        yield Excess(
            'two_link.surface_gain, two_link.mu: K/2 + mu',
            filtering * rate,
            f'is {rate:.3g} 1/s, but a filter of {filtering:g} s rings above '
            f'{0.25 / filtering:.3g} 1/s: lower the gains',
        )


def _limits_of_slope(case: Case) -> Iterator[Excess]:
    config, settings = case.config, case.settings
    T, damping = config.sample_time, _damping(settings, case.load)
    ratios = settings.barrier.slope_limit * T / damping
    for joint, ratio in zip(config.joints, ratios, strict=True):
        yield Excess(
            f'{_feedback(config)}: past the knee of its barrier {joint} is corrected by',
            ratio / 2.0,
            f'{ratio:.2g} times its error in a sample. Above 2 the error grows: give a '
            'shorter sample_time',
        )


def _has_barrier(case: Case) -> bool:
    return case.settings.has_barrier == 1


_GAINS = When.START | When.LIVE

RULES = (
    Rule('torque.limit', _GAINS, Severity.WARN, _limits_of_torque),
    Rule('feedback', _GAINS, Severity.WARN, _limits_of_feedback),
    Rule('two_link.mu', _GAINS, Severity.WARN, _limits_of_surface, _has_barrier),
    Rule('feedback', _GAINS, Severity.WARN, _limits_of_slope, _has_barrier),
)
