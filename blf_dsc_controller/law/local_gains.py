# SPDX-License-Identifier: Apache-2.0
"""Stiffness and damping of the law's feedback, joint by joint, at its last sample.

What a law's torque loses for each rad and rad/s more of a joint's position and velocity,
with the model, what is learned and its memory held:

    damping     K_p, and omega_v m where it follows the inertia                 [N m s/rad]
    stiffness   that of the barrier, w (1 + 4 s tan s) / cos^2 s up to the knee, or w,
                and damping times -d beta2 / d xi1                                 [N m/rad]

m is the joint's least inertia.  The barrier's slope grows with the error: a PD in the
motors that has it keeps the bound by itself between two samples.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import direct, inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.blf_dsc import BlfDsc
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.state import Settings, Signals, settings_of, signals_of
from blf_dsc_controller.law.surface import virtual_slope


@inner
def joint_stiffness(
    settings: Settings, signals: Signals, i: int, damping: float
) -> float:
    """Return the stiffness [N m/rad] of joint i with a `damping` [N m s/rad], as above."""
    wall, surface = settings.barrier, settings.surface
    xi, bound = signals.xi1[i], signals.bound[i]
    stiffness = wall.slope_limit[i]
    if abs(xi) < signals.barrier.knee[i]:
        stiffness = barrier.slope(xi, bound, wall.weight[i])
    rate = virtual_slope(xi, bound, surface.gain[i], surface.mu[i])
    return float(stiffness + damping * max(rate - signals.barrier.narrowing[i], 0.0))


@kernel
def fill_local_gains(
    model: ArmModel, settings_vector: Array, signals_vector: Array, gains: Array
) -> None:
    """Write stiffness [N m/rad] and damping [N m s/rad] of the last sample to `gains` (2, n)."""
    settings = settings_of(settings_vector, model)
    signals = signals_of(signals_vector, settings)
    feedback = settings.feedback
    for i in range(settings.n):
        damping = feedback.gain[i] + feedback.damping_rate * settings.joint_inertia[i]
        gains[0, i] = joint_stiffness(settings, signals, i, damping)
        gains[1, i] = damping


class LocalGains:
    """Stiffness and damping of a controller's feedback, compiled."""

    def __init__(self, controller: Controller) -> None:
        """Compile them.

        Raises:
            BlfDscError: it is a law of a file, whose feedback is not known, or its damping
                lags, which no stiffness and damping can do.
        """
        if not isinstance(controller.law, BlfDsc):
            raise BlfDscError(
                f'the feedback of {type(controller.law).__name__}, a law of a file, is not '
                'known: let the host close it'
            )
        feedback = controller.settings.feedback
        if feedback.lags == 1:
            raise BlfDscError(
                f'feedback.joint_damping_lag: got {feedback.damping_lag.max():g} s, but motors '
                'that '
                'close the feedback damp without a lag: set it to 0, drop '
                'feedback.joint_damping_lag, or set drive.feedback: host'
            )
        self._gains = np.zeros((2, controller.settings.n))
        self._arguments = (
            controller.settings.model,
            controller.settings_vector,
            controller.signals_vector,
            self._gains,
        )
        self._fill = direct(fill_local_gains, *self._arguments)

    def evaluate(self) -> Array:
        """Return stiffness [N m/rad] and damping [N m s/rad] (2, n) of the last sample.

        The next call overwrites them.
        """
        self._fill(*self._arguments)
        return self._gains
