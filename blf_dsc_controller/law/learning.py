# SPDX-License-Identifier: Apache-2.0
"""What composite learning does with each sample: a row of the prediction error, and the window.

prediction   a row [X | u] with X theta = u, of the last interval
window       sums of the rows over tau_d
excitation   whether a window is excited, consistent, and latched
change       whether the arm has changed, so that the window must be forgotten
ripple       columns of the torque ripple of gears and motors
friction     friction from reversals, and how much of it is used
adaptation   the step of the estimate, once the torque is known
"""

from __future__ import annotations

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law import (
    change,
    excitation,
    friction,
    prediction,
    ripple,
    window,
)
from blf_dsc_controller.law.compensation import compute_regressors, fill_friction
from blf_dsc_controller.law.state import Settings, Signals, State


@inner
def measure_reversals(settings: Settings, state: State, period: float) -> None:
    """Let `friction` measure reversals, with a row each `period` [s].

    It begins T_a after the latch, when the other columns are those of the window, and
    once a full window is known to be of one arm or this one is half full: those of less
    are too vague.
    """
    if settings.friction.learns == 0:
        return
    settling_time = settings.learning_start - settings.window * period
    since_latch = friction.update_since_latch(state.friction, state.latched[0], period)
    is_known = (
        settings.change_detection == 0
        or state.least_residual[0] > 0.0
        or state.rows[0] >= 0.5 * settings.window
    )
    friction.measure_reversals(
        settings.friction,
        state.friction,
        state.filter2,
        state.estimate,
        since_latch <= settling_time or not is_known,
        period,
    )


@inner
def observe(
    settings: Settings, state: State, signals: Signals, t: float, dt: float
) -> None:
    """Compute the regressors; add the row of the last interval; check the excitation when due."""
    compute_regressors(settings, state, signals)
    fill_friction(settings, state, signals, dt)
    friction.follow_motion(settings.friction, state.friction, signals.friction)
    ripple.fill_compensated_ripple(settings, signals, dt)
    prediction.fill_columns(settings, t, signals.dq, signals.Yr)
    ripple.fill_measured_ripple(settings, signals)
    prediction.form_row(settings, state, signals, dt)
    friction.filter_shapes(settings.friction, state.friction, signals.dq, dt)
    if state.samples[0] == 0.0:
        return
    if state.frozen[0] > 0.0:  # the row is of a contact
        state.frozen[0] = max(0.0, state.frozen[0] - dt)
        return
    if int(state.samples[0]) % settings.row_interval == 0:
        window.push_row(state, signals.row)
        measure_reversals(settings, state, settings.row_interval * dt)
    if settings.change_detection == 1:
        change.detect_change(settings, state, signals, dt)
    if int(state.samples[0]) % settings.interval == 0:
        excitation.update_excitation(settings, state, signals, t, dt)
