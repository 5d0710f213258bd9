# SPDX-License-Identifier: Apache-2.0
"""Supervision of the law: checks, stops and the torque without it, without ROS.

Begin with `guard`: there a joint state passes through all of it.

The law, or the torque that holds the arm in its place:

    guard             a torque for every joint state, message, silence and error
    in_command        the law of an arm, its hold, and which of the two is in command
    supervisor        the phase, and the reason of the last stop
    running_reference the reference in force, and the time of the law
    motions           trajectories and targets: planned beside the loop, adopted between samples
    retuning          other gains without a jump of the torque

How it takes command:

    start_gate        the rate of the states is known first
    starting          activation, reset, the first state, the return after a gap
    first_torque      what holds an arm that rests, and whether the first torque may be sent

Checks, and what follows:

    state_check       stamps, missed and invalid states, before the law
    state_watchdog    no states at all
    reading           which states are trusted; their turns (`wraps`) and velocities
    sample_check      what the law computed, before its torque is sent; its `stop_cause`
    findings          what the law detects: contacts, wrong sensors (`not_sensors`), oscillations
    oscillation_check what follows from an oscillation: a stop, or a warning
    contact           contacts in words, and whether the arm holds after one

The torque without the law:

    safe_stop         what becomes of an arm after a stop
    hold              the ramp to the torque that holds it, and that torque
    last_state        the trusted state from which it is computed
    braking           damping by which no joint drags another along
    held_torque       what holds the arm where the law stops: `recent_motion`, `model_torque`
    kept_estimates    the estimates that count by then
    observed_load     the load besides the model, observed in the stop
    command_effect    whether commands reach the arm
    swing             joints that swing under the damping

Loads that are declared to drives: `drive_load` (which steps), `load_declaration` (in which
order).

The process that watches the controller: `torque_watchdog`, `sensor_noise`, `watched_journal`.
"""
