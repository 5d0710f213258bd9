# SPDX-License-Identifier: Apache-2.0
"""Rows [X | u] of the prediction error: X theta = u holds for the true theta = [P; d].

`filtered` (default).  d/dt(Yp P) + Yr P + D d = tau, integrated over a sample of held
torque, gives

    X_k = (Yp_k - Yp_{k-1}) / T + (Yr_k + Yr_{k-1}) / 2,      X_k P + D_k d = tau on [k-1, k]

up to O(T^2).  Both sides pass through the same two cascaded poles, which preserves the
identity and filters the noise of the difference quotient.  No acceleration is needed.

`lambda`.  The paper's (24): X = H(q, dq, alpha2, alpha2'), u = Lambda tau with the scalar
Lambda = x^T y / x^T x,  x = [xi2'^ + alpha2'; xi2 + alpha2; 1],  y = [alpha2'; alpha2; 1], and
xi2'^ from the filter (8).  Since tau = [M C G] x and H P = [M C G] y, this is exact only where y is
parallel to x: its error is of first order in xi2 and xi2', and depends on the units.

Besides P, the learning estimates the coefficients d of the disturbance columns

    tau_dist = D d,    D = [ I | diag(dq) | diag(tanh(dq / v_c)) | I sin(w t) | I cos(w t) | ... ]

for each block that is configured, and those of `ripple`.  (22)-(24) instead subtract the
estimate d^3 from the torque, which hides the parameter error.
"""

from math import sqrt

from blf_dsc_controller.arms.friction import sliding
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import external_torque, friction
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.law.state import FILTERED, Settings, Signals, State
from blf_dsc_controller.numerics.elementary import cos, exp, sin


@inner
def set_block(rest: Array, at: int, i: int, value: float) -> None:
    """Set entry (i, i) of the block that starts at column `at`; zero the rest of its row."""
    for k in range(rest.shape[0]):
        rest[i, at + k] = 0.0
    rest[i, at + i] = value


@inner
def fill_columns(settings: Settings, t: float, dq: Array, rest: Array) -> None:
    """Fill columns p.. of `rest` (n, m) with D at time t [s] and velocity dq (n,) [rad/s]."""
    n = settings.n
    for i in range(n):
        at = settings.p
        if settings.bias == 1:
            set_block(rest, at, i, 1.0)
            at += n
        if settings.viscous == 1:
            set_block(rest, at, i, dq[i])
            at += n
        if settings.coulomb == 1:
            set_block(rest, at, i, sliding(dq[i], settings.coulomb_velocity))
            at += n
        for k in range(settings.tones):
            set_block(rest, at, i, sin(settings.frequencies[k] * t))
            set_block(rest, at + n, i, cos(settings.frequencies[k] * t))
            at += 2 * n


@inner
def delay_torque(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Pass the applied torque through the lags of drives and sensors, to `state.late`.

    A measured motion is that of a torque of `robot.lag` ago: half of it is the drives',
    half the velocity filter's.
    """
    begins = settings.lag == 0.0 or state.samples[0] <= 1.0
    gain = 0.0
    if not begins:
        gain = filter_gain(0.5 * settings.lag, dt)
    for i in range(settings.n):
        torque = signals.applied[i]
        for k in range(2):
            if begins:
                state.late[k, i] = torque
            torque = state.late[k, i] + gain * (torque - state.late[k, i])
            state.late[k, i] = torque


@inner
def filter_row(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Pass [X | u] of the last interval through both poles; write the result to `signals.row`.

    Rows of a joint that hardly moves count less: its stiction would be mistaken for
    gravity.
    """
    gain = filter_gain(1.0 / settings.pole, dt)
    p = settings.p
    m = settings.m
    row = signals.row
    for i in range(settings.n):
        weight = settings.row_weight[i]
        if settings.motion_scale > 0.0:
            weight *= abs(signals.dqr[i]) / sqrt(
                signals.dqr[i] ** 2 + settings.motion_scale**2
            )
        for j in range(m):
            row[i, j] = 0.5 * (signals.Yr[i, j] + state.Yr[i, j])
        for j in range(p):
            row[i, j] += (signals.Yp[i, j] - state.Yp[i, j]) * (1.0 / dt)
        row[i, m] = state.late[1, i]
        if settings.contact.enabled == 1:
            extra = friction.breakaway_torque(
                settings.friction, state.friction, state.estimate, i
            )
            external_torque.filter_interval(
                settings.contact, state.contact, i, row[i], extra, dt
            )
        for j in range(m + 1):
            state.filter1[i, j] += gain * (row[i, j] - state.filter1[i, j])
            state.filter2[i, j] += gain * (state.filter1[i, j] - state.filter2[i, j])
            row[i, j] = weight * state.filter2[i, j]


@inner
def differentiate(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Step the filter (8) with damping 1, exactly for held xi2; write ddq^ to `signals`."""
    decay = exp(-settings.omega * dt)
    for i in range(settings.n):
        if state.samples[0] == 0.0:
            state.observed[i] = signals.xi2[i]
            state.observed_rate[i] = 0.0
        else:
            offset = state.observed[i] - signals.xi2[i]
            slope = state.observed_rate[i] + settings.omega * offset
            state.observed[i] = signals.xi2[i] + (offset + slope * dt) * decay
            state.observed_rate[i] = (
                state.observed_rate[i] - settings.omega * slope * dt
            ) * decay
        signals.acceleration[i] = signals.dalpha2[i] + state.observed_rate[i]


@inner
def lambda_row(settings: Settings, state: State, signals: Signals) -> None:
    """Write the row `lambda` to `signals.row`, from ddq^ of `differentiate`.

    Lambda of (24) is dimensionless only if units are ignored.
    """
    products = 1.0
    squares = 1.0
    X = signals.Yp
    for i in range(settings.n):
        products += (
            signals.acceleration[i] * signals.dalpha2[i]
            + signals.dq[i] * state.alpha2[i]
        )
        squares += signals.acceleration[i] ** 2 + signals.dq[i] ** 2
    scale = products / squares
    settings.model.regressor(signals.q, signals.dq, state.alpha2, signals.dalpha2, X)
    for i in range(settings.n):
        for j in range(settings.m):
            signals.row[i, j] = X[i, j] if j < settings.p else scale * signals.Yr[i, j]
        signals.row[i, settings.m] = scale * signals.applied[i]


@inner
def form_row(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Write the configured row of the last interval to `signals.row` (n, m + 1)."""
    if settings.prediction != FILTERED:
        differentiate(settings, state, signals, dt)
        lambda_row(settings, state, signals)
        return
    if state.samples[0] > 0.0:
        delay_torque(settings, state, signals, dt)
        filter_row(settings, state, signals, dt)
    for i in range(settings.n):  # Yp and [Yr | D] for the next interval
        for j in range(settings.m):
            state.Yr[i, j] = signals.Yr[i, j]
            if j < settings.p:
                state.Yp[i, j] = signals.Yp[i, j]
