# SPDX-License-Identifier: Apache-2.0
"""Supervision of the law: checks, stops and the safe torque, without ROS.

Begin with `guard`, which shows how a joint state passes through all of it.

The law, or the safe torque in its place:

    guard             a torque for every joint state, message, silence and error
    in_command        the law of an arm, the safe torque, and which of the two is in command
    supervisor        the phase, and the reason of the last stop
    running_reference the reference in force, and the time of the law
    motions, plan     trajectories and targets: planned beside the loop, adopted between samples
    retuning          other gains without a jump of the torque

How it takes command:

    start_gate        the rate of the states is known first
    starting          activation, reset, the first state, the return after a gap
    start, takeover   where it can take over, along which motion and from which torque
    support           what holds an arm that rests
    first_torque      whether the first torque may be sent

Checks, and what follows:

    state_check       stamps, missed and invalid states, before the law
    state_watchdog    no states at all
    readings          turns and velocities of states: `wraps`, `velocity`
    sample_check      what the law computed, before its torque is sent; `stop_cause` says why
    findings          what the law detects: contacts, wrong sensors (`not_sensors`), oscillations
    oscillation_check what follows from an oscillation: a stop, or a warning
    contact           contacts in words, and whether the arm holds after one

The torque without the law:

    safe_stop         what becomes of an arm after a stop
    safe_torque       the ramp to the safe torque, and that torque
    last_state        the state from which it is computed
    braking           damping by which no joint drags another along
    held_torque       what holds the arm where the law stops: `recent_motion`, `model_torque`
    kept_estimates    the estimates that count by then
    observed_load     the load besides the model, observed in the stop
    command_effect    whether commands reach the arm
    stop_speed        whether it speeds up
    swing             joints that swing under the damping; `swing_names` says which

Loads that are declared to drives: `drive_load` (which steps), `load_declaration` (in which
order), `declared_loads` (the law counts them).

The process that watches the controller: `torque_watchdog`, `sensor_noise`, `watched_journal`.

Before anything moves, what cannot work well: `config_warnings` has all of `body_warnings`,
`bound_warnings`, `gear_warnings` and `gain_limits`, by `reference_load` and
`expected_errors`; `not_commissioned`; `digits` for numbers in sentences.
"""
