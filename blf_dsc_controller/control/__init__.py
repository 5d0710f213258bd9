# SPDX-License-Identifier: Apache-2.0
"""The guarded law as an object, without ROS: what the node and other loops run.

Begin with `guarded_loop`; around it are the ways in and out.

    arm_controller    joint states in, torques out, for a loop of your own: `blf.ArmController`
    guarded_loop      `supervision.guard` with the messages about each state
    telemetry         these messages
    outputs           where they go: a bag, topics, a user's own
    motion_input      trajectories, streams of targets and stops, as they arrive
    goals             goals of the action: `goal_messages`, `goal_tolerances`
    status_report     what `/diagnostics` says
    slow_move         how long a move from rest to rest takes
    realtime          scheduling and memory of the process
    log               what takes texts by their severity
"""
