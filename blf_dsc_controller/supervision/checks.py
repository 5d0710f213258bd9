# SPDX-License-Identifier: Apache-2.0
"""The quick look at every state and every answer, whether there is anything to judge at all.

It says yes or no only; whoever gets a no finds out why, in words, at leisure.
"""

from math import isfinite

import numpy as np

from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law.sample import sample_of
from blf_dsc_controller.law.settings import LINEAR, settings_of
from blf_dsc_controller.law.state import signals_of, state_of

SUSPECT = 1
OUTSIDE = 2


@kernel
def state_is_sound(q: np.ndarray, dq: np.ndarray, velocity_limit: float) -> bool:
    """Whether a state is finite and no joint faster than the limit [rad/s]."""
    for i in range(q.size):  # noqa: SIM110 - a loop is what compiles well
        if not (isfinite(q[i]) and abs(dq[i]) <= velocity_limit):
            return False
    return True


@kernel
def look(
    settings_vector: np.ndarray,
    state_vector: np.ndarray,
    signals_vector: np.ndarray,
    sample_vector: np.ndarray,
    error_ratio: float,
    ratio: np.ndarray,
    kept: np.ndarray,
) -> int:
    """Look at what the law has made of a sample.

    Args:
        settings_vector: packed `Settings`.
        state_vector: packed `State` after the sample; a refused column is a number there.
        signals_vector: packed `Signals` of the sample.
        sample_vector: packed `Sample`.
        error_ratio: |xi1| / k_c from which on an error is suspect; 0 switches this off.
        ratio: largest |xi1| / k_c so far (n,), brought up to date.
        kept: estimates and d^3 (m + n,) of the last answer that was not suspect, brought up to
            date.

    Returns:
        SUSPECT if a number is not finite, a torque at its limit or an error too large; OUTSIDE, in
        addition or alone, if an error is not within its bound.
    """
    settings = settings_of(settings_vector, None)
    n = settings.n
    m = settings.m
    state = state_of(state_vector, settings)
    signals = signals_of(signals_vector, settings)
    told = sample_of(sample_vector, settings)
    verdict = 0
    for i in range(n):
        now = abs(told.xi1[i]) / told.bound[i]
        ratio[i] = max(ratio[i], now) if now == now else ratio[i]  # noqa: PLR0124 - not NaN
        if not now < 1.0:
            verdict |= OUTSIDE
        if error_ratio > 0.0 and settings.surface != LINEAR and not now < error_ratio:
            verdict |= SUSPECT
        within = abs(signals.demand[i]) <= settings.torque_limit[i]
        if not (within and isfinite(told.torque[i]) and isfinite(state.disturbance[i])):
            verdict |= SUSPECT
    for j in range(m):
        if not isfinite(state.estimate[j]):
            verdict |= SUSPECT
    if verdict & SUSPECT == 0:
        estimates = part(kept, 0, (m,))
        disturbances = part(kept, m, (n,))
        for j in range(m):
            estimates[j] = state.estimate[j]
        for i in range(n):
            disturbances[i] = state.disturbance[i]
    return verdict
