# SPDX-License-Identifier: Apache-2.0
"""The limits of the torque, on its size and on its rate of change.

The rate counts from the torque commanded last; the first torque after a reset has none before it.
A limit of the size that has been lowered below the last torque counts more than the rate.
"""

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.law.state import Signals, State

LEVEL_CUT = 1.0
RATE_CUT = 2.0


@inner
def clip(x: float, low: float, high: float) -> float:
    """Cut x at `low` and `high`; what is no number stays none."""
    if x < low:
        return low
    if x > high:
        return high
    return x


@inner
def cut_torque(settings: Settings, state: State, signals: Signals, dt: float) -> bool:
    """Cut `signals.demand` to `signals.torque` [N m], counting by joint; True if any was cut.

    `dt` [s] is the time since the last torque.
    """
    is_cut = False
    for i in range(settings.n):
        top = settings.torque_limit[i]
        torque = clip(signals.demand[i], -top, top)
        signals.cuts[i] = 0.0
        if torque != signals.demand[i]:
            signals.cuts[i] = LEVEL_CUT
            state.level_cuts[i] += 1.0
        if settings.rate_limit[i] > 0.0 and state.samples[0] > 0.0:
            step = settings.rate_limit[i] * dt
            last = state.torque[i]
            slowed = clip(torque, last - step, last + step)
            if slowed != torque:
                signals.cuts[i] += RATE_CUT
                state.rate_cuts[i] += 1.0
            torque = clip(slowed, -top, top)
        signals.torque[i] = torque
        is_cut = is_cut or signals.cuts[i] > 0.0
    return is_cut
