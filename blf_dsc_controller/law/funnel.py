# SPDX-License-Identifier: Apache-2.0
"""The bound k_c(t): constant, or a funnel that narrows to it.

    k(t) = k_c + (k_0 - k_c) exp(-a t)                                                  [rad]

The potential of the barrier depends on xi and k as k^2 v(xi / k), the straight line past its knee
included, so that along a motion

    V' = dV/dxi (xi1' - xi1 k'/k) + 2 (k'/k) V.

A virtual control with xi1 k'/k added leaves of V' what it is for a bound that stands still, and
2 (k'/k) V, which is not above zero for a bound that narrows (doc/theory-funnel.md).
"""

from math import exp

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.law.state import Signals


@inner
def narrow(settings: Settings, signals: Signals, t: float) -> None:
    """Leave k(t), the knee of the barrier that goes with it, and k'/k [1/s] in `signals`."""
    for i in range(settings.n):
        final = settings.bound[i]
        above = (settings.initial_bound[i] - final) * exp(-settings.funnel_rate * t)
        signals.bound[i] = final + above
        signals.knee[i] = settings.knee[i] * (signals.bound[i] / final)
        signals.narrowing[i] = -settings.funnel_rate * above / signals.bound[i]
