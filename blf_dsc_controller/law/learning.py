# SPDX-License-Identifier: Apache-2.0
"""What composite learning does with each sample: rows of the prediction error, and the window.

`observe`, before the torque is known:

columns           the columns of what is learned besides P
prediction        a row [X | u] with X theta = u, of the last interval
joint_sensors     what joint torque sensors show, where there are any

`adapt`, once it is sent:

window            sums of the rows over tau_d
friction          friction from reversals, and how much of it is used
change            whether the arm has changed, so that the window must be forgotten
excitation        whether a window is excited, consistent, and latched
adaptation        the step of theta^, by the tracking error and the latched window
disturbance       the step of d^3, which gives up what is learned
"""

from __future__ import annotations

from blf_dsc_controller.arms.friction import sliding
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import (
    adaptation,
    change,
    columns,
    disturbance,
    excitation,
    external_torque,
    friction,
    joint_sensors,
    load_observer,
    motor_friction,
    prediction,
    reversals,
    window,
)
from blf_dsc_controller.law.compensation import compute_regressors, fill_learned
from blf_dsc_controller.law.innovation import Prior
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.law.window import Window


@inner
def observe(
    settings: Settings, state: State, signals: Signals, t: float, dt: float
) -> None:
    """Compute the regressors at time t [s], and the row of the last interval, `dt` [s] long.

    H of what is learned is left in `signals.H`, the friction compensation in `signals.friction`,
    the row [X | u] in `signals.row.Xu`.
    """
    compute_regressors(settings, state, signals)
    fill_learned(settings, state, signals, dt)
    friction.follow_motion(settings.friction, state.friction, signals.friction)
    fill_columns(settings, signals, t)
    form_row(settings, state, signals, dt)
    friction.filter_shapes(settings.friction, state.friction, signals.dq, dt)


@inner
def learn(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Add the row to the window; detect a change of the arm, and latch a window that suffices.

    `dt` [s] is the sample time.
    """
    samples = int(state.samples[0])
    if samples == 0:
        return
    if samples % settings.window.row_interval == 0:
        if settings.observer.enabled == 1:
            joint_sensors.add_friction_row(settings, state, signals)
        window.push_row(state.window, signals.row.Xu)
        measure_reversals(settings, state, signals, settings.window.row_interval * dt)
    if settings.excitation.change_detection == 1:
        detect_change(settings, state, signals, dt)
    if samples % settings.window.interval == 0:
        check_excitation(settings, state, signals, dt)


@inner
def check_excitation(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Latch the window if it suffices by (27); solve for the friction of the motors then."""
    t = signals.t[0]
    sliding = Window(settings.window, state.window, signals.scratch.window)
    prior = Prior(settings.prior_mean, settings.information)
    excitation.update_excitation(
        settings.excitation,
        state.latch,
        signals.scratch.latch,
        sliding,
        prior,
        settings.model,
        signals.q,
        t,
        dt,
    )
    is_new = state.latch.latched[0] == 1.0 and state.latch.latch_time[0] == t
    if is_new and settings.observer.enabled == 1:
        motor_friction.solve(
            settings.motors,
            state.motors,
            signals.scratch.motors,
            settings.information,
        )


@inner
def fill_columns(settings: Settings, signals: Signals, t: float) -> None:
    """Fill the columns D of [Yr | D] for the row, at the measured motion and time t [s].

    The row's torque has passed the velocity filter, half of the lag, but positions have not.
    """
    column_settings = settings.columns
    for i in range(settings.n):
        q, dq = signals.q[i], signals.dq[i]
        position = q - 0.5 * settings.row.lag * dq
        sign = sliding(dq, column_settings.coulomb_velocity)
        at = columns.Point(t, position, dq, sign, signals.gear_torque[i])
        columns.fill(column_settings, columns.ALL, i, at, signals.row.Yr)


@inner
def form_row(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Form the row [X | u] of the last interval, `dt` [s], and pass it on to what uses it."""
    row_settings, row_state, row = settings.row, state.row, signals.row
    if state.samples[0] > 0.0:
        begins = state.samples[0] <= 1.0
        prediction.delay_torque(row_settings, row_state, signals.applied, begins, dt)
        prediction.fill_interval(row_state, row, dt)
        if settings.observer.enabled == 1:
            joint_sensors.observe_load(settings, state, signals, dt)
        if settings.contact.enabled == 1:
            filter_external_torque(settings, state, signals, dt)
        prediction.pass_poles(row_settings, row_state, row, signals.dqr, dt)
    prediction.keep_regressors(row_state, row)


@inner
def filter_external_torque(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Pass the row of the last interval, `dt` [s], through the pole of `external_torque`.

    It is the row before its own poles.
    """
    for i in range(settings.n):
        extra = friction.breakaway_torque(
            settings.friction, state.friction, state.estimate, i
        )
        external_torque.filter_interval(
            settings.external, state.external, i, signals.row.Xu[i], extra, dt
        )


@inner
def measure_reversals(
    settings: Settings, state: State, signals: Signals, period: float
) -> None:
    """Let `friction` measure reversals, with a row each `period` [s].

    Torque sensors measure the friction alone, from the first row that is not of an arm before.
    Without them, it is what the other columns leave of the torque: from T_a after the latch on,
    when these are those of the window, and once a full window is known to be of one arm or
    this one is half full; with fewer rows they are too uncertain.
    """
    if settings.friction.coulomb == 0:
        return
    latch, rows = state.latch, state.window.rows[0]
    length = settings.window.length
    since_latch = state.friction.since_latch
    since_latch[0] = latch.latched[0] * (since_latch[0] + period)
    if joint_sensors.shows_friction(settings, state):
        settled = rows * period * settings.row.filter_pole >= prediction.SETTLED
        begins = not settled or load_observer.is_missing(signals.effort)
    else:
        settling_time = settings.excitation.learning_start - length * period
        is_known = (
            settings.excitation.change_detection == 0
            or latch.min_residual[0] > 0.0
            or rows >= 0.5 * length
        )
        begins = since_latch[0] <= settling_time or not is_known
    fill_unexplained(settings, state, signals)
    friction.measure_reversals(
        settings.friction, state.friction, signals.friction, begins, period
    )


@inner
def fill_unexplained(settings: Settings, state: State, signals: Signals) -> None:
    """Write e (n,) [N m], the torque without all but Coulomb friction, to `signals.friction`."""
    senses = joint_sensors.shows_friction(settings, state)
    rotors = settings.observer.rotors
    for i in range(settings.n):
        row, excluded = state.row.filter2[i], settings.friction.first_coulomb + i
        if senses:
            e = motor_friction.unexplained(
                state.motors, row, i, rotors, state.estimate, excluded
            )
        else:
            e = friction.unexplained(row, state.estimate, excluded)
        signals.friction.unexplained[i] = e


@inner
def detect_change(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Forget the window if the arm has changed: its rows contradict each other, or the solution.

    Somebody may also have announced it; then nothing that was learned before is in doubt.  If the
    window was latched before it was full, the estimate returns to the one before;
    of friction, only the evidence of the last reversals is taken back.
    """
    excitation_settings, latch, row = settings.excitation, state.latch, signals.row.Xu
    sliding = Window(settings.window, state.window, signals.scratch.window)
    prior = Prior(settings.prior_mean, settings.row_information)
    if settings.window.prior_weight > 0.0:  # without, rows predict too little
        has_changed = change.compare_with_rows(
            state.change,
            signals.scratch.change,
            sliding,
            prior,
            row,
            prediction.mean_square_weight(signals.dqr, settings.row.motion_scale),
            excitation_settings.residual_floor / settings.n,
            int(state.samples[0]),
            dt,
        )
    else:
        has_changed = change.compare_with_solution(
            excitation_settings, state.change, signals.scratch.change, latch, row, dt
        )
    is_announced = state.change.announced[0] == 1.0
    if not (has_changed or is_announced):
        return
    if is_announced:
        state.change.announced[0] = state.change.hasty[0] = 0.0
    else:
        reversals.take_back(state.friction.reversals, state.friction.breakaway)
    if latch.latched[0] == 1.0 and not is_announced:
        friction.return_estimate(
            settings.friction, state.friction, latch.active, state.estimate
        )
        if not window.is_full(settings.window, state.window):
            take_back(settings, state, signals)
    change.count_change(state.change, latch, sliding, prior, state.estimate, dt)
    prediction.forget(state.row)
    motor_friction.forget(state.motors)


@inner
def take_back(settings: Settings, state: State, signals: Signals) -> None:
    """Return to the estimate before the window, with the torque unchanged.

    What is not learned from the window stays: Coulomb friction is identified by reversals, and
    the other friction by the sensors, if there are any.
    """
    senses = joint_sensors.shows_friction(settings, state)
    before = signals.scratch.change.before
    for j in range(settings.m):
        before[j] = state.estimate[j]
        is_sensed = senses and settings.p <= j < settings.motors.size
        if not (is_sensed or friction.is_coulomb(settings.friction, j)):
            state.estimate[j] = state.latch.anchor[j]
    transfer_learned(settings, state, signals, before)


@inner
def transfer_learned(
    settings: Settings, state: State, signals: Signals, before: Array
) -> None:
    """Subtract from d^3 what theta^ has learned since `before` (m,), less what r gives up."""
    disturbance.transfer_learned(state.disturbance, signals.H, state.estimate, before)
    if settings.observer.enabled == 1:
        joint_sensors.transfer_learned(settings, state, signals.H, before)


@inner
def adapt(
    settings: Settings, state: State, signals: Signals, dt: float, saturated: bool
) -> None:
    """Learn from the row, and advance theta^ and d^3 by `dt` [s]: (20), (30).

    While a contact lasts, and something reacts to it, only d^3 is advanced.  `saturated`: the
    torque was cut.
    """
    if state.frozen[0] > 0.0:  # the row is of a contact
        state.frozen[0] = max(0.0, state.frozen[0] - dt)
        if not saturated:
            follow_disturbance(settings, state, signals, dt)
    else:
        learn(settings, state, signals, dt)
        adapt_estimate(settings, state, signals, dt, saturated)
    friction.transfer_learned(
        settings.friction,
        state.friction,
        signals.friction,
        state.estimate,
        state.disturbance,
    )


@inner
def adapt_estimate(
    settings: Settings, state: State, signals: Signals, dt: float, saturated: bool
) -> None:
    """Advance theta^ and d^3 by `dt` [s], with the latched window.

    While a torque is saturated, the tracking error reflects the limit, not the
    parameters, so only the prediction error, which uses the applied torque, adapts the
    estimate.  While a full window is not excited, as at standstill, H^T xi2 is
    correlated noise and ignored (`change_detection`).
    """
    adaptation_settings, workspace = settings.adaptation, signals.scratch.adaptation
    latch, estimate, H = state.latch, state.estimate, signals.H
    adaptation.fill_newton_step(workspace, latch, estimate)
    if latch.latched[0] == 1.0:
        friction.follow_reversals(
            settings.friction,
            state.friction,
            signals.friction,
            latch.active,
            estimate,
            workspace.rate,
        )
        if joint_sensors.shows_friction(settings, state):
            motor_friction.follow_columns(
                state.motors,
                settings.initial_estimate,
                latch.active,
                estimate,
                workspace.rate,
            )
    unexcited = (
        settings.excitation.change_detection == 1
        and window.is_full(settings.window, state.window)
        and latch.lambda_min[0] < settings.excitation.excitation_threshold
    )
    tracks = not saturated and not unexcited
    adaptation.adapt(
        adaptation_settings, workspace, estimate, H, signals.xi2, settings.p, tracks, dt
    )
    if not saturated:
        follow_disturbance(settings, state, signals, dt)
    if latch.latched[0] == 1.0:
        transfer_learned(settings, state, signals, workspace.tracked)
        if settings.observer.enabled == 1:
            joint_sensors.follow_absorbed(settings, state, signals, dt)
        friction.adapt_breakaway(
            settings.friction, state.friction, signals.friction, dt
        )


@inner
def follow_disturbance(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Advance d^3 by `dt` [s]: (30), with gamma M(q, P^(0)) / m if the feedback acts through it."""
    workspace = signals.scratch.disturbance
    disturbance.fill_step(
        settings.disturbance, workspace, state.disturbance, signals.xi2, dt
    )
    if settings.feedback.follows_inertia == 1:
        scale_by_inertia(settings, signals, workspace.step)
    for i in range(settings.n):
        state.disturbance[i] -= workspace.step[i]
        friction.follow_observer(
            state.friction, signals.friction, i, -workspace.step[i]
        )


@inner
def scale_by_inertia(settings: Settings, signals: Signals, x: Array) -> None:
    """Replace x (n,) by M(q, P^(0)) x / m, with m the joint inertia of the settings."""
    momentum = signals.scratch.momentum
    for i in range(settings.n):
        x[i] /= settings.joint_inertia[i]
    settings.model.momentum_regressor(signals.q, x, momentum.Yp, momentum.Yr)
    for i in range(settings.n):
        x[i] = 0.0
        for j in range(settings.p):
            x[i] += momentum.Yp[i, j] * settings.initial_estimate[j]
