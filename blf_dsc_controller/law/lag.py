# SPDX-License-Identifier: Apache-2.0
"""First-order lags, stepped exactly for an input that is held over a sample."""

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.numerics.elementary import exp


@inner
def filter_gain(time_constant: float, dt: float) -> float:
    """Return 1 - exp(-dt / time_constant), the exact gain of a first-order lag with held input.

    A step of the lag is x += gain (input - x); `time_constant` [s] > 0, `dt` [s].
    """
    return 1.0 - exp(-dt / time_constant)
