# SPDX-License-Identifier: Apache-2.0
"""Prediction error without accelerations: the filtered momentum regressor.

The dynamics d/dt(Yp P) + Yr P + tau_dist = tau, integrated over one sample of held torque, give

    X_k = (Yp_k - Yp_{k-1}) / T + (Yr_k + Yr_{k-1}) / 2,      X_k P + D_k d = tau on [k-1, k]

up to O(T^2).  Both sides pass the same two cascaded poles, which leaves the identity untouched and
takes the noise off the difference quotient.  (22)-(24) need xi2' instead and subtract the estimated
disturbance, which hides the parameter error; here the disturbance is estimated along with P, as the
coefficients d of the columns D.
"""

import numpy as np

from blf_dsc_controller.core import surface
from blf_dsc_controller.core.kernel import kernel
from blf_dsc_controller.core.settings import Settings
from blf_dsc_controller.core.state import Signals, State


@kernel
def bias_columns(settings: Settings, rest: np.ndarray) -> None:
    """Fill columns p.. of `rest` (n, m): one constant torque per joint."""
    for i in range(settings.n):
        for j in range(settings.p, settings.m):
            rest[i, j] = 1.0 if j - settings.p == i else 0.0


@kernel
def filter_row(
    settings: Settings, state: State, signals: Signals, dt: float, torque: np.ndarray
) -> None:
    """Pass [X | u] of the last interval through both poles, leaving it in `signals.row`.

    Args:
        settings: the law's settings.
        state: holds Yp and [Yr | D] of the last sample and the filter's state.
        signals: holds Yp and [Yr | D] of this sample.
        dt: length of the interval [s].
        torque: torque applied over the interval (n,) [N m].
    """
    gain = surface.filter_gain(1.0 / settings.pole, dt)
    for i in range(settings.n):
        for j in range(settings.m + 1):
            if j == settings.m:
                value = torque[i]
            else:
                value = 0.5 * (signals.rest[i, j] + state.rest[i, j])
                if j < settings.p:
                    value += (signals.momentum[i, j] - state.momentum[i, j]) / dt
            state.filter1[i, j] += gain * (value - state.filter1[i, j])
            state.filter2[i, j] += gain * (state.filter1[i, j] - state.filter2[i, j])
            signals.row[i, j] = state.filter2[i, j]


@kernel
def remember(settings: Settings, state: State, signals: Signals) -> None:
    """Keep this sample's Yp and [Yr | D] for the next interval."""
    for i in range(settings.n):
        for j in range(settings.m):
            state.rest[i, j] = signals.rest[i, j]
            if j < settings.p:
                state.momentum[i, j] = signals.momentum[i, j]
