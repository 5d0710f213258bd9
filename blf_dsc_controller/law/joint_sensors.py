# SPDX-License-Identifier: Apache-2.0
"""What joint torque sensors show in each sample, in an arm that has them.

load_observer     the torque on the links beyond the model's, which is added to the law's
torque_sensors    whether it may go on: else it is left out
motor_friction    friction of the motors, which the sensors do not see

`learning` calls these functions.  What they show is of an interval, by the row of
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
    """Let `load_observer` find r by the row of the last interval, before its poles."""
    of, now, row = settings.observer, state.observer, signals.row.Xu
    if now.elapsed[0] == 0.0:
        load_observer.begin(now, state.disturbance)
    if load_observer.is_missing(signals.effort):
        return
    had_settled = load_observer.has_settled(of, now)
    for i in range(settings.n):
        load_observer.filter_interval(of, now, i, row[i], signals.effort[i], dt)
    links = Links(state.estimate, of.rotors, state.motors.absorbed)
    load_observer.update(
        of, now, signals.scratch.observer, links, settings.information, dt
    )
    motor_friction.pass_poles(settings.motors, state.motors, now.late, dt)
    torque_sensors.follow_applied(
        state.sensors, row, settings.m, of.observer_bandwidth, dt
    )
    if load_observer.has_settled(of, now):
        check_sensors(settings, state, signals, not had_settled, dt)


@inner
def check_sensors(
    settings: Settings, state: State, signals: Signals, begins: bool, dt: float
) -> None:
    """Fade r out where it oscillates, or efforts are not those of torque sensors."""
    of, now, work = state.observer, state.sensors, signals.sensors
    limit = settings.torque.limit
    for i in range(settings.n):
        work.differences[i] = of.filtered[i, settings.p] - now.command[i]
    if begins:
        torque_sensors.begin(now, of.torque)
    torque_sensors.watch_shaking(now, work, limit, of.torque, dt)
    is_off = torque_sensors.watch_following(
        now, work, limit, signals.dq, signals.dqr, dt
    )
    torque_sensors.fade(now, of.faded, is_off, dt)


@inner
def shows_friction(settings: Settings, state: State) -> bool:
    """Whether the sensors have shown friction, and nothing speaks against them."""
    return bool(
        settings.observer.enabled == 1
        and state.motors.rows[0] > 0.0
        and state.observer.faded[0] == 0.0
    )


@inner
def add_friction_row(settings: Settings, state: State, signals: Signals) -> None:
    """Add the row to those that show the friction of the motors, unless a sensor is silent."""
    of, now, row = settings.motors, state.motors, signals.row.Xu
    if load_observer.is_missing(signals.effort):
        return
    moving = prediction.moving_share(signals.dqr, settings.row.motion_scale)
    share = motor_friction.fade(of, now, moving)
    for i in range(settings.n):
        weight = prediction.motion_weight(settings.row, signals.dqr[i], i)
        g = motor_friction.friction_of_row(
            now,
            row,
            weight,
            i,
            settings.observer.rotors,
            settings.initial_estimate,
            state.estimate,
        )
        motor_friction.add_row(now, row, i, g, share)


@inner
def transfer_learned(settings: Settings, state: State, H: Array, before: Array) -> None:
    """Let d^3 take what r gives up by the change of theta^ since `before` (m,); H is (n, m)."""
    of, now, d3 = settings.observer, state.observer, state.disturbance
    links = Links(state.estimate, of.rotors, state.motors.absorbed)
    earlier = Links(before, of.rotors, state.motors.absorbed)
    load_observer.transfer_learned(of, now, d3, links, earlier)
    load_observer.hand_over(of, now, d3, H, links, earlier)


@inner
def follow_absorbed(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Let P_f follow, as P^ does; d^3 takes what r loses."""
    now, work = state.motors, signals.scratch.motors
    of, rotors = settings.adaptation, settings.observer.rotors
    motor_friction.follow(now, work, of.weight, of.adaptation_gain, dt)
    load_observer.transfer_learned(
        settings.observer,
        state.observer,
        state.disturbance,
        Links(state.estimate, rotors, now.absorbed),
        Links(state.estimate, rotors, work.before),
    )
