# SPDX-License-Identifier: Apache-2.0
"""Changes of the gains of a running law without a jump of its torque.

A jump of the gains at unchanged errors would make the torque jump. Two states of the
law absorb the difference: the surface filter is shifted with the virtual control, so
that alpha2' does not change, and the disturbance estimate, the integrator of the law,
absorbs the rest; it then returns to its own value at the rate of its gain. A joint
whose disturbance gain is 0 has no integrator, so its torque steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_traits import PAPER
from blf_dsc_controller.configuration.rules import (
    Rule,
    Severity,
    When,
    findings,
)
from blf_dsc_controller.factory.laws import law_of
from blf_dsc_controller.factory.settings import settings_in_loop
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.blf_dsc import shift_surface
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.state import Settings

Floats = NDArray[np.float64]

_STABLE = 2.0  # x += -a x diverges for a >= 2


def apply(controller: Controller, config: ControllerConfig) -> None:
    """Replace the gains of a law by those of a configuration."""
    controller.retune(law_of(config), settings_in_loop(config))


def apply_bumpless(
    controller: Controller, config: ControllerConfig, t: float, measurement: Floats
) -> None:
    """Replace the settings of a running law without a jump of its torque.

    `t` [s] and `measurement` (3 n,) are those of the last sample.
    """
    state = controller.state
    signals = controller.signals
    T = config.sample_time
    controller.trial(t, T, measurement)
    beta2 = signals.surface.beta2.copy()
    demand = signals.demand.copy()
    apply(controller, config)
    if controller.settings.has_barrier == 1:
        controller.trial(t, T, measurement)
        shift_surface(state, signals.surface.beta2 - beta2)
    controller.trial(t, T, measurement)
    integrates = controller.settings.disturbance.gain > 0.0
    state.disturbance[integrates] -= (signals.demand - demand)[integrates]


class _Change(NamedTuple):
    """A change of a running law at t [s]."""

    controller: Controller
    config: ControllerConfig
    settings: Settings
    t: float


def problems(controller: Controller, config: ControllerConfig, t: float) -> list[str]:
    """Return why a running law cannot accept a valid configuration at t [s]."""
    case = _Change(controller, config, settings_in_loop(config), t)
    return [
        str(finding) for finding in findings(RULES, case, When.NOW, Severity.REFUSE)
    ]


def _outside_bound(change: _Change) -> Iterator[str]:
    """Yield which joints the bound of a configuration leaves outside."""
    config = change.config
    bounds = barrier.bound_at(change.settings.barrier, change.t)
    errors = np.abs(change.controller.sample.xi1)
    for joint, (unit, _, _), error, bound in zip(
        config.joints, config.units, errors, bounds, strict=True
    ):
        if not error < bound:
            yield (
                f'barrier.bound: {joint} is {error:.6g} {unit} from its reference now, outside of '
                f'a bound of {bound:g} {unit}: choose a wider one, or try again with a smaller '
                'error'
            )


def _above_torque_limit(change: _Change) -> Iterator[str]:
    """Yield which joints are held by more than their limit."""
    config = change.config
    torques = np.abs(change.controller.sample.torque)
    for joint, (_, unit, _), torque, limit in zip(
        config.joints, config.units, torques, config.torque.limit, strict=True
    ):
        if torque > limit:
            yield (
                f'torque.limit: {joint} is held with {torque:.4g} {unit} now, more than a limit of '
                f'{limit:g} {unit}: choose a higher one'
            )


def _diverging_update(change: _Change) -> Iterator[str]:
    """Yield how much each step of the learned estimates overshoots, if they diverge."""
    config, adaptation = change.config, change.settings.adaptation
    latch = change.controller.state.latch
    step, curvature = 'Newton step', 1.0
    if config.law == PAPER:
        step, curvature = 'gradient step', float(np.linalg.norm(latch.Phi, 2))
    step_gain = (
        adaptation.weight
        * float(adaptation.adaptation_gain.max())
        * curvature
        * config.sample_time
    )
    if latch.latched[0] and step_gain >= _STABLE:
        yield (
            f'two_link.learning_weight: the {step} of each sample would correct the '
            f'estimates by {step_gain:.3g} times their error, which diverges at {_STABLE:g} or '
            'more: lower it or two_link.adaptation_gain'
        )


RULES = (
    Rule('barrier.bound', When.NOW, Severity.REFUSE, _outside_bound),
    Rule('torque.limit', When.NOW, Severity.REFUSE, _above_torque_limit),
    Rule('two_link.learning_weight', When.NOW, Severity.REFUSE, _diverging_update),
)
