# SPDX-License-Identifier: Apache-2.0
"""Compiled checks of every joint state and every sample: flags only.

The supervisor derives the reason of each flag.
"""

from math import isfinite

import numpy as np

from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law.settings import LINEAR, settings_of
from blf_dsc_controller.law.state import sample_of, signals_of, state_of

SUSPECT = 1
OUTSIDE = 2


@kernel
def is_valid_state(q: np.ndarray, dq: np.ndarray, velocity_limit: float) -> bool:
    """Whether a state is finite and no joint faster than the limit [rad/s]."""
    for i in range(q.size):  # noqa: SIM110 - a loop is what compiles well
        if not (isfinite(q[i]) and abs(dq[i]) <= velocity_limit):
            return False
    return True


@kernel
def check_sample(
    settings_vector: np.ndarray,
    state_vector: np.ndarray,
    signals_vector: np.ndarray,
    sample_vector: np.ndarray,
    error_ratio: float,
    ratio: np.ndarray,
    kept: np.ndarray,
) -> int:
    """Check what the law computed in a sample.

    Args:
        settings_vector, state_vector, signals_vector, sample_vector: packed; the state's estimate
            of a rejected column is finite.
        error_ratio: |xi1| / k_c from which on an error is suspect; 0 switches this off.
        ratio: largest |xi1| / k_c so far (n,), updated.
        kept: estimates and d^3 (m + n,) of the last sample that was not suspect, updated.

    Returns:
        SUSPECT for a value that is not finite, a torque at its limit or an error too large;
        OUTSIDE, in addition or alone, for an error past its bound.
    """
    settings = settings_of(settings_vector, None)
    n = settings.n
    m = settings.m
    state = state_of(state_vector, settings)
    signals = signals_of(signals_vector, settings)
    sample = sample_of(sample_vector, settings)
    flags = 0
    for i in range(n):
        now = abs(sample.xi1[i]) / sample.bound[i]
        ratio[i] = max(ratio[i], now) if now == now else ratio[i]  # noqa: PLR0124 - not NaN
        if not now < 1.0:
            flags |= OUTSIDE
        if error_ratio > 0.0 and settings.surface != LINEAR and not now < error_ratio:
            flags |= SUSPECT
        within = abs(signals.demand[i]) <= settings.torque_limit[i]
        if not (within and isfinite(sample.torque[i]) and isfinite(state.disturbance[i])):
            flags |= SUSPECT
    for j in range(m):
        if not isfinite(state.estimate[j]):
            flags |= SUSPECT
    if flags & SUSPECT == 0:
        estimates = part(kept, 0, (m,))
        disturbances = part(kept, m, (n,))
        for j in range(m):
            estimates[j] = state.estimate[j]
        for i in range(n):
            disturbances[i] = state.disturbance[i]
    return flags
