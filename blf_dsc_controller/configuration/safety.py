# SPDX-License-Identifier: Apache-2.0
"""When the controller stops by itself, and what it commands then."""

from __future__ import annotations

from dataclasses import dataclass

from blf_dsc_controller.configuration.parameter import parameter

SAFE_TORQUES = ('zero', 'damping', 'hold_gravity')
WATCHDOGS = ('auto', 'on', 'off')
VELOCITIES = ('measured', 'estimated')


@dataclass(frozen=True)
class Safety:
    """Limits past which the controller goes to its safe stop, and the torque it goes to."""

    state_timeout: float = parameter(
        0.04,
        'time by which a joint state may be late, on the steady clock and by its stamp',
        unit='s',
        above=0.0,
    )
    watchdog: str = parameter(
        'auto',
        'watch for silence on the steady clock; auto: if the stamps are of this time of day, '
        'which those of a lock-step plant are not',
        choices=WATCHDOGS,
    )
    repeated_states: int = parameter(
        3,
        'states with the stamp of the last one that are passed over in a row',
        unit='samples',
        at_least=0,
        at_most=1_000_000,
    )
    velocity: str = parameter(
        'measured',
        'velocity as measured, or estimated as the difference of two positions, from rest',
        choices=VELOCITIES,
        read_only='the filters hold what was measured with it',
    )
    velocity_limit: float = parameter(
        50.0,
        'velocity of a joint that is taken for a broken measurement',
        unit='rad/s',
        above=0.0,
    )
    error_ratio: float = parameter(
        1.0,
        'tracking error to stop at, as a multiple of the bound; only laws with a barrier are held '
        'to it; 0: never',
        at_least=0.0,
    )
    saturation_time: float = parameter(
        0.5, 'time for which a torque may be at its limit without a break', unit='s', above=0.0
    )
    overrun_fraction: float = parameter(
        0.4,
        'part of the states that may be missed, on average over overrun_window',
        above=0.0,
        at_most=1.0,
    )
    overrun_window: float = parameter(
        1.0, 'time over which missed states are averaged', unit='s', above=0.0
    )
    torque: str = parameter(
        'zero',
        'safe torque: none, damping -D dq, or the learned gravity with damping',
        choices=SAFE_TORQUES,
    )
    damping: tuple[float, ...] = parameter(
        (2.0, 1.0),
        'damping of the safe torques that have any',
        unit='N m s/rad',
        symbol='D',
        at_least=0.0,
        length=('joints',),
    )
    stop_ramp: float = parameter(
        0.0,
        'time from the last torque of the law to the safe one after a fault; 0: at once',
        unit='s',
        at_least=0.0,
    )
    deactivation_ramp: float = parameter(
        0.5, 'the same when the node is deactivated', unit='s', at_least=0.0
    )
    keep_estimates: bool = parameter(
        True,
        'go on from what was learned when the node is activated again; a reset forgets it',
    )
