# SPDX-License-Identifier: Apache-2.0
"""Saturation of the torque, in level and rate.

The level limit holds for the whole torque of the joint, which is what its motor bears, and for the
command alone, which is what its driver may cut: the two differ by what the drive adds (`drive`).
The rate is that of the command, and not limited at the first sample after a reset.  The level limit
takes precedence, for example if it is lowered below the last torque.
"""

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.law.state import Signals, State

LEVEL_CUT = 1.0
RATE_CUT = 2.0


@inner
def clip(x: float, low: float, high: float) -> float:
    """Limit x to [low, high]; NaN passes through."""
    if x < low:
        return low
    if x > high:
        return high
    return x


@inner
def saturate(settings: Settings, state: State, signals: Signals, dt: float) -> bool:
    """Limit `signals.demand`, giving the command `signals.torque` [N m]; return whether it is cut.

    `dt` [s] is the time since the last torque.
    """
    saturated = False
    for i in range(settings.n):
        top = settings.torque_limit[i]
        added = signals.added[i]
        low, high = max(-top, added - top), min(top, added + top)
        torque = clip(signals.demand[i], low, high)
        signals.cuts[i] = 0.0
        if torque != signals.demand[i]:
            signals.cuts[i] = LEVEL_CUT
            state.level_cuts[i] += 1.0
        if settings.rate_limit[i] > 0.0 and state.samples[0] > 0.0:
            step = settings.rate_limit[i] * dt
            last = state.torque[i] + added
            slowed = clip(torque, last - step, last + step)
            if slowed != torque:
                signals.cuts[i] += RATE_CUT
                state.rate_cuts[i] += 1.0
            torque = clip(slowed, low, high)
        signals.torque[i] = torque - added
        saturated = saturated or signals.cuts[i] > 0.0
    return saturated
