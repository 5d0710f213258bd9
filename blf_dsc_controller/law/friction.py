# SPDX-License-Identifier: Apache-2.0
"""Learned friction: its torque along the reference, and Coulomb friction from what flips.

Coulomb friction changes its sign where a joint reverses, faster than d^3 can follow: an error of
the estimate pushes the joint twice in each period, and a light one that sticks breaks loose past
its bound.  The window cannot be trusted with it.  Its rows are dominated by the frequencies of the
reference, at which an unknown torque, a sway or a load that swings, is explained by friction:
a sin w t opposite to the velocity takes 0.64 a off the estimate and leaves no residual.  What only
friction has is the step.  So the rows pass a band around the pole p of their filter,

    x_h = (s / (s + p))^2 x,        c^ = (p int c_h e_h dt + l c_0) / (p int c_h^2 dt + l),

with c the column of the joint in the row, e what the other columns leave of its torque, and the
pull l to the initial estimate c_0.  A sine at p / 5 keeps a twenty-sixth of its amplitude.  The
sums forget once they contain `_ENERGY`, some eight reversals.  Everything else that acts on the
estimate is the window's: its columns of Coulomb friction only take up what would otherwise be
mistaken for parameters.
"""

from blf_dsc_controller.compiled.elementary import tanh
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.state import FILTERED, Settings, Signals, State

_ENERGY = 1.0  # of p int c_h^2 dt; a reversal has an eighth of it
_PRIOR = 0.1  # 1 / (reversals that outweigh the initial estimate where f is unmodelled)


@inner
def first_coulomb(settings: Settings) -> int:
    """Return the index of the first column of Coulomb friction in theta."""
    return settings.p + settings.n * (settings.bias + settings.viscous)


@inner
def fill_compensation(settings: Settings, signals: Signals) -> None:
    """Fill columns p.. of `signals.H` with friction at the reference velocity.

    The measured velocity would feed its noise, and chatter at rest, into the torque.
    """
    viscous, coulomb = settings.p + settings.n * settings.bias, first_coulomb(settings)
    for i in range(settings.n):
        if settings.viscous == 1:
            signals.H[i, viscous + i] = signals.dqr[i]
        if settings.coulomb == 1:
            signals.H[i, coulomb + i] = tanh(signals.dqr[i] / settings.coulomb_velocity)


@inner
def high_pass(lags: Array, i: int, gain: float, x: float, begins: bool) -> float:
    """Advance the two lags of joint i and return what they leave of x, at the beginning zero."""
    if begins:
        lags[0, i] = x
        lags[1, i] = 0.0
    for k in range(2):
        lags[k, i] += gain * (x - lags[k, i])
        x -= lags[k, i]
    return x


@inner
def measure_flips(settings: Settings, state: State, dt: float) -> None:
    """Add the last row, `dt` [s] after the one before it, to the sums of c_h e_h and c_h^2.

    They begin T_a after the latch, when the other columns are those of the window.
    """
    if settings.coulomb == 0 or settings.prediction != FILTERED:
        return
    settling_time = settings.learning_start - settings.window * dt
    state.since_latch[0] = state.latched[0] * (state.since_latch[0] + dt)
    begins = state.since_latch[0] <= settling_time
    gain = barrier.filter_gain(1.0 / settings.pole, dt)
    weight = settings.pole * dt
    first, sums = first_coulomb(settings), state.flip_sums
    for i in range(settings.n):
        row = state.filter2[i]
        e = row[settings.m]
        for j in range(settings.m):
            if j != first + i:
                e -= row[j] * state.estimate[j]
        c = high_pass(state.column_lags, i, gain, row[first + i], begins)
        e = high_pass(state.torque_lags, i, gain, e, begins)
        sums[0, i] += weight * c * e
        sums[1, i] += weight * c * c
        if sums[1, i] > _ENERGY:
            sums[0, i] *= _ENERGY / sums[1, i]
            sums[1, i] = _ENERGY


@inner
def follow_flips(settings: Settings, state: State, signals: Signals) -> None:
    """Write c^ minus the estimate to the entries of Coulomb friction in `signals.rate`."""
    if settings.coulomb == 0 or settings.prediction != FILTERED:
        return
    first = first_coulomb(settings)
    for i in range(settings.n):
        j = first + i
        floor = settings.residual_floor / (settings.n * settings.row_weight[i] ** 2)
        pull = _PRIOR * floor / settings.variance[j]
        energy = state.flip_sums[1, i] + pull
        if state.active[j] == 0.0 or energy == 0.0:
            continue
        coulomb = (state.flip_sums[0, i] + pull * settings.initial_estimate[j]) / energy
        signals.rate[j] = coulomb - state.estimate[j]
