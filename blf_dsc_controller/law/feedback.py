# SPDX-License-Identifier: Apache-2.0
"""Feedback of the velocity error xi2: damping and the robust term of (28), by the inertia or not.

    tau_f = -K_p xi2 - d2 |xi1| sat(xi2 / b)                                        [N m]
    a_f = a - omega_v xi2 + tau_c / m                                           [rad/s^2]

a_f is the acceleration that the model is given (see `compensation`), where damping and
the torque tau_c by the error act through the inertia matrix of the initial estimate.

Between the resonance of a link behind its gear and that of link and motor, damping by an
encoder at the link drives what it should damp.  So K_p xi2 of a joint may pass a lag, which
acts there alone: the rest of the torque is small at those frequencies.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.lag import filter_gain


class Settings(NamedTuple):
    """The parameters `feedback.*`, and what follows from them."""

    gain: Annotated[Array, 'n']  # K_p, N m s/rad
    robust_gain: Annotated[Array, 'n']  # d2, N m/rad
    # omega_v, of the damping by the initial estimate's inertia, 1/s
    damping_rate: float
    follows_inertia: int  # 1: barrier and d^3 act through M(q, P^(0)) / m
    decoupled: int  # 1: no feedback acts through M(q, P^(0))
    damping_lag: Annotated[Array, 'n']  # of K_p xi2, s; 0: none
    lags: int  # 1: a joint has one


class State(NamedTuple):
    """What is kept from one sample to the next."""

    # xi2 behind the lags, rad/s; 0 of a joint without one
    lagged: Annotated[Array, 'n * feedback.lags']


class Workspace(NamedTuple):
    """Values of one sample."""

    restoring: Annotated[Array, 'n']  # tau_c, by the error: -dV/dxi1, N m
    acceleration: Annotated[Array, 'n']  # a_f, rad/s^2


@inner
def advance(
    settings: Settings, state: State, xi2: Array, begins: bool, dt: float
) -> None:
    """Pass xi2 (n,) [rad/s] of a sample, `dt` [s] after the last, through the lags of K_p xi2.

    At the first sample, which `begins`, the lags take its value.
    """
    for i in range(xi2.size):
        if settings.damping_lag[i] > 0.0:
            gain = 1.0 if begins else filter_gain(settings.damping_lag[i], dt)
            state.lagged[i] += gain * (xi2[i] - state.lagged[i])


@inner
def joint_torque(
    settings: Settings, state: State, xi1: float, xi2: float, layer: float, i: int
) -> float:
    """Return tau_f of joint i [N m]: - K_p xi2, behind its lag if it has one, and the robust term.

    xi1 [rad] and xi2 [rad/s] are those of this sample, `layer` is b [rad/s].
    """
    robust = settings.robust_gain[i] * abs(xi1)
    damped = state.lagged[i] if settings.damping_lag[i] > 0.0 else xi2
    torque = settings.gain[i] * damped
    torque += robust * clip(xi2 / layer, -1.0, 1.0)
    return float(-torque)
