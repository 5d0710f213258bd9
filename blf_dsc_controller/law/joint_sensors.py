# SPDX-License-Identifier: Apache-2.0
"""What is computed from joint torque sensors in each sample, in an arm that has them.

load_observer     the torque on the links beyond the model's, which is added to the law's
torque_sensors    whether it may go on: else it is left out
motor_friction    friction of the motors, which the sensors do not see

`learning` calls these functions.  They use the last interval, by the row of
`prediction`.
"""

from __future__ import annotations

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import (
    load_observer,
    motor_friction,
    prediction,
    torque_sensors,
)
from blf_dsc_controller.law.load_observer import Links
from blf_dsc_controller.law.state import Settings, Signals, State


@inner
def observe_load(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Compute r of `load_observer` by the row of the last interval, `dt` [s], before its poles.

    Nothing changes while an effort is missing (NaN).
    """
    observer_settings, observer, row = settings.observer, state.observer, signals.row.Xu
    if observer.elapsed[0] == 0.0:
        load_observer.begin(observer, state.disturbance)
    if load_observer.is_missing(signals.effort):
        return
    had_settled = load_observer.has_settled(observer_settings, observer)
    for i in range(settings.n):
        load_observer.filter_interval(
            observer_settings, observer, i, row[i], signals.effort[i], dt
        )
    links = Links(state.estimate, observer_settings.rotors, state.motors.absorbed)
    load_observer.update(
        observer_settings,
        observer,
        signals.scratch.observer,
        links,
        settings.information,
        dt,
    )
    motor_friction.pass_poles(settings.motors, state.motors, observer.lagged, dt)
    torque_sensors.follow_applied(
        state.sensors, row, settings.m, observer_settings.observer_bandwidth, dt
    )
    if load_observer.has_settled(observer_settings, observer):
        check_sensors(settings, state, signals, not had_settled, dt)


@inner
def check_sensors(
    settings: Settings, state: State, signals: Signals, begins: bool, dt: float
) -> None:
    """Fade r out where it oscillates, or efforts are not those of torque sensors.

    `begins`: r has just settled.  `dt` [s] is the sample time.
    """
    observer, sensors, workspace = state.observer, state.sensors, signals.sensors
    limit = settings.torque.limit
    for i in range(settings.n):
        workspace.differences[i] = observer.filtered[i, settings.p] - sensors.command[i]
    if begins:
        torque_sensors.begin(sensors, observer.torque)
    torque_sensors.watch_oscillation(sensors, workspace, limit, observer.torque, dt)
    is_off = torque_sensors.watch_following(
        sensors, workspace, limit, signals.dq, signals.dqr, dt
    )
    torque_sensors.fade(sensors, observer.faded, is_off, dt)


@inner
def shows_friction(settings: Settings, state: State) -> bool:
    """Whether the sensors have measured friction, and r is not in doubt."""
    return bool(
        settings.observer.enabled == 1
        and state.motors.rows[0] > 0.0
        and state.observer.faded[0] == 0.0
    )


@inner
def add_friction_row(settings: Settings, state: State, signals: Signals) -> None:
    """Add the row to the means of `motor_friction`, unless an effort is missing."""
    motor_settings, motors, row = settings.motors, state.motors, signals.row.Xu
    if load_observer.is_missing(signals.effort):
        return
    square_weight = prediction.mean_square_weight(
        signals.dqr, settings.row.motion_scale
    )
    gain = motor_friction.fade(motor_settings, motors, square_weight)
    for i in range(settings.n):
        weight = prediction.motion_weight(settings.row, signals.dqr[i], i)
        g = motor_friction.row_friction(
            motors,
            row,
            weight,
            i,
            settings.observer.rotors,
            settings.initial_estimate,
            state.estimate,
        )
        motor_friction.add_row(motors, row, i, g, gain)


@inner
def transfer_learned(settings: Settings, state: State, H: Array, before: Array) -> None:
    """Let d^3 take what r gives up by the change of theta^ since `before` (m,).

    H is the regressor (n, m) of what is learned.
    """
    observer_settings, observer, d3 = (
        settings.observer,
        state.observer,
        state.disturbance,
    )
    links = Links(state.estimate, observer_settings.rotors, state.motors.absorbed)
    earlier = Links(before, observer_settings.rotors, state.motors.absorbed)
    load_observer.transfer_learned(observer_settings, observer, d3, links, earlier)
    load_observer.hand_over(observer_settings, observer, d3, H, links, earlier)


@inner
def follow_absorbed(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Advance P_f by `dt` [s] as P^ does; d^3 takes what r loses by it."""
    motors, workspace = state.motors, signals.scratch.motors
    adaptation, rotors = settings.adaptation, settings.observer.rotors
    motor_friction.follow(
        motors, workspace, adaptation.weight, adaptation.adaptation_gain, dt
    )
    load_observer.transfer_learned(
        settings.observer,
        state.observer,
        state.disturbance,
        Links(state.estimate, rotors, motors.absorbed),
        Links(state.estimate, rotors, workspace.before),
    )
