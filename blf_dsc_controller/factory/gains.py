# SPDX-License-Identifier: Apache-2.0
"""Gains of the law (28) of a configuration: those of an arm from a URDF, or of two links."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

from blf_dsc_controller.arms import tuning
from blf_dsc_controller.configuration.controller import (
    ControllerConfig,
    used_design_of,
)
from blf_dsc_controller.configuration.two_link import STEEPEST, two_link

_KAPPA = (
    100.0  # weight of the prediction error; less, where Gamma kappa T would exceed 1
)
_EXCITED = 1e-9  # sigma, of rows that are compared with a prior
_LARGEST = 3.0  # kg m^2, of two links; or twice what they are assumed to have


class LawGains(NamedTuple):
    """Gains of the law, and what it knows of the arm."""

    initial_estimate: tuple[float, ...]  # P^(0) (p,)
    radius: float  # omega_a, of the ball that P^ stays in
    initial_bound: tuple[float, ...]  # k_0 (n,) [rad]; k_c: constant bound
    funnel_rate: float  # a, 1/s
    weight: tuple[float, ...]  # w (n,) [N m/rad]
    slope_limit: tuple[float, ...]  # S_lim (n,) [N m/rad]
    surface: tuple[float, ...]  # K (n,) [1/s]
    mu: tuple[float, ...]  # (n,) [1/s]
    feedback: tuple[float, ...]  # K_p (n,) [N m s/rad]
    robust: tuple[float, ...]  # d2 (n,) [N m/rad]
    damping_rate: float  # omega_v, 1/s
    leakage: float  # eta, rad/(N m s)
    adaptation: tuple[float, ...]  # Gamma (p,)
    learning_weight: float  # kappa
    excitation_threshold: float  # sigma


@lru_cache(maxsize=4)
def law_gains(config: ControllerConfig) -> LawGains:
    """Return the gains of the law of a configuration; nothing adapts if learning is disabled."""
    gains = _of_urdf(config) if config.model == 'urdf' else _of_two_links(config)
    if config.learning.enabled:
        return gains
    still = (0.0,) * len(gains.adaptation)
    return gains._replace(adaptation=still, learning_weight=0.0)


def _of_urdf(config: ControllerConfig) -> LawGains:
    """Return the gains that follow from an arm, and a bound that begins as wide as it sags."""
    arm = used_design_of(config)
    gains = tuning.gains_of(arm)
    barrier = config.barrier
    start = barrier.bound
    if not barrier.bounds_tool:  # which holds from the start on
        start = tuning.initial_bound(gains, barrier.bound)
    P = tuning.initial_estimate(arm)
    return LawGains(
        initial_estimate=P,
        radius=tuning.radius(arm),
        initial_bound=start,
        funnel_rate=gains.funnel_rate,
        weight=gains.weight,
        slope_limit=gains.slope_limit,
        surface=gains.surface,
        mu=gains.mu,
        feedback=gains.feedback,
        robust=(0.0,) * len(config.joints),
        damping_rate=gains.damping_rate,
        leakage=0.0,
        adaptation=(gains.adaptation,) * len(P),
        learning_weight=min(_KAPPA, 1.0 / config.sample_time),
        excitation_threshold=_EXCITED,
    )


def _of_two_links(config: ControllerConfig) -> LawGains:
    """Return the gains that are given for the two links."""
    given = two_link(config)
    return LawGains(
        initial_estimate=given.initial_estimate,
        radius=max(_LARGEST, 2.0 * math.hypot(*given.initial_estimate)),
        initial_bound=config.barrier.bound,
        funnel_rate=0.0,
        weight=given.barrier_weight,
        slope_limit=(STEEPEST,) * len(config.joints),
        surface=given.surface_gain,
        mu=given.mu,
        feedback=given.feedback_gain,
        robust=given.robust_gain,
        damping_rate=0.0,
        leakage=given.leakage,
        adaptation=given.adaptation_gain,
        learning_weight=given.learning_weight,
        excitation_threshold=given.excitation_threshold,
    )
