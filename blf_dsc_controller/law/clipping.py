# SPDX-License-Identifier: Apache-2.0
"""Limits of a number."""

from blf_dsc_controller.compiled.jit import inner


@inner
def clip(x: float, low: float, high: float) -> float:
    """Limit x to [low, high]; NaN passes through."""
    if x < low:
        return low
    if x > high:
        return high
    return x
