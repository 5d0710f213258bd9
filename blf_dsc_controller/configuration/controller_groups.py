# SPDX-License-Identifier: Apache-2.0
"""Groups of the controller's parameters: safety, telemetry, gains, learning, contact.

The gains are those of the control laws (28) and (35), and of composite learning (20) to
(27).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

from blf_dsc_controller.configuration.schema import (
    PerJoint,
    non_negative,
    parameter,
    positive,
)

_of_tool = partial(
    non_negative,
    read_only='the joint bounds follow from it when they are read: change those',
)
_telemetry = partial(
    parameter, read_only='topics are created once, when the node starts'
)
sizing = partial(parameter, read_only='it sets the size of the state of the law')
in_window = partial(
    parameter, read_only='the data in the excitation window depend on it'
)
"""Declare a parameter on which the rows of a window depend."""
_at_start = partial(parameter, read_only='it has no effect later')
_FOUND = 'it says how the gains were found'
_of_joints = partial(non_negative, (), read_only=_FOUND, omittable=True)
_FOLLOWED = 'the other gains follow from it when they are read: change those'
_from_urdf = partial(non_negative, (), read_only=_FOLLOWED, omittable=True)
# per window: fewer do not determine P, more need over 100 MB
_SAMPLES = (10, 1_000_000)
_SLOW = 0.5  # s: sample times from here on are no control loop; they may be ms


@dataclass(frozen=True)
class Safety:
    """Limits past which the controller stops, and the torque of the stop."""

    state_timeout: float = positive(
        0.04,
        'largest delay of a state, by steady clock or stamp; in a second, states may be missing '
        'for this time, or for 0.4 s if that is longer',
        's',
    )
    watchdog: Literal['auto', 'on', 'off'] = parameter(
        'auto',
        'steady-clock watchdog for missing states; auto: only if stamps are wall-clock time',
    )
    expect_watchdog: bool = parameter(
        False,
        'wait for the node torque_watchdog before the first torque; report if it is missing',
        read_only='it says which processes belong together',
    )
    other_commands: Literal['refuse', 'allow'] = parameter(
        'refuse',
        'refuse to start while another node commands the arm, or start beside it',
    )
    velocity: Literal['measured', 'estimated'] = parameter(
        'measured',
        'velocity as measured, or estimated from position differences, starting at rest',
        read_only='the filters hold data that depend on it',
    )
    velocity_limit: PerJoint = positive(
        (50.0, 50.0),
        'speed at which the controller stops; laws without a barrier are braked from 0.9 of '
        'it on (default: 1.2 times the velocity limit of the URDF)',
        'rad/s',
    )
    error_ratio: float = non_negative(
        1.0,
        'tracking error to stop at, relative to the bound; laws without a barrier are braked '
        'before it, relative to how far a joint gets in 0.06 s at velocity_limit; 0: never',
    )
    saturation_time: float = positive(
        0.5,
        'longest time with a torque at its limit, less a quarter of the time below it',
        's',
    )
    first_torque: Literal['check', 'send'] = parameter(
        'check',
        'refuse a first torque that an arm at rest contradicts, or send it unchecked',
    )
    oscillation: Literal['stop', 'warn', 'ignore'] = parameter(
        'stop',
        'what is done about an arm that oscillates; warn: stop only if torques reach a fifth '
        'of their limit',
    )
    torque: Literal['zero', 'damping', 'hold_gravity'] = parameter(
        'zero',
        'safe torque: zero, damping -D dq, or the learned gravity with damping; without gravity, '
        'what the law held fades within 0.5 s when it is deactivated',
    )
    damping: PerJoint = non_negative(
        (2.0, 1.0),
        'damping in the safe torque, at most the inertia of the joint over 0.03 s',
        'N m s/rad',
        'D',
    )


@dataclass(frozen=True)
class Telemetry:
    """What the controller publishes besides its commands."""

    decimation: int = _telemetry(
        10,
        'samples per message of reference and monitor; errors come with every sample',
        at_least=1,
    )


@dataclass(frozen=True)
class Barrier:
    """Bound on the tracking error, and the barrier that enforces it."""

    bound: PerJoint = positive(
        (0.002, 0.002), 'bound on the tracking error', 'rad', 'k_c'
    )
    tool_bound: float = _of_tool(
        0.0, 'bound on the error of robot.tip, from which `bound` follows; 0: none', 'm'
    )
    tool_angle_bound: float = _of_tool(
        0.0,
        'bound on the angle error of robot.tip, from which `bound` follows; 0: none',
        'rad',
    )

    @property
    def bounds_tool(self) -> bool:
        """Whether there is a bound at the tool."""
        return self.tool_bound > 0.0 or self.tool_angle_bound > 0.0


@dataclass(frozen=True)
class Feedback:
    """Feedback terms of the law (28)."""

    inertia: Literal['none', 'surface', 'whole'] = _at_start(
        'surface',
        'what of the feedback acts through the inertia matrix of '
        'P^(0): none of it, so that each joint has gains of its own '
        '(default for a URDF), the rate of the surface filter (paper), or the whole',
    )
    joint_stiffness: PerJoint = _from_urdf(
        'with inertia none: stiffness of each joint, from which gains follow; empty: '
        'gains with which nearly any arm with elastic joints is stable',
        'N m/rad',
    )
    joint_damping: PerJoint = _from_urdf(
        'with inertia none: damping of each joint, likewise', 'N m s/rad'
    )
    stiffness: float = positive(
        1.0,
        'factor on joint_stiffness and joint_damping; with inertia whole, the bandwidth '
        'of the gains relative to what the delay allows, at most 1',
        read_only=_FOLLOWED,
    )
    joint_damping_lag: PerJoint = non_negative(
        (),
        'lag of the damping of each joint; empty: none. A few ms where joints are elastic and '
        'encoders are at the links',
        's',
        read_only='it sets the size of the state of the law',
        omittable=True,
    )

    def lags(self, n: int) -> tuple[float, ...]:
        """Return the lag of the damping of each of n joints [s]."""
        return self.joint_damping_lag or (0.0,) * n


@dataclass(frozen=True)
class DisturbanceEstimate:
    """Adaptive estimate of the disturbance (30)."""

    gain: PerJoint = non_negative(
        (100.0, 100.0),
        'adaptation gain of the disturbance estimate; 0: no estimate',
        'N m/rad',
        'gamma',
    )
    observer_bandwidth: float = non_negative(
        0.0,
        'pole of the load observer, which adds what joint torque sensors show and the '
        'model lacks; 0: none. It needs robot.torque_loop and robot.effort whole; '
        'commissioning proves the sensors, and chooses it by measurement',
        'rad/s',
        'L',
        read_only='it sets the size of the state of the law',
    )


@dataclass(frozen=True)
class Torque:
    """Saturation of the commanded torque."""

    limit: PerJoint = positive(
        (20.0, 20.0),
        'largest torque, both as commanded and including what the drives add',
        'N m',
    )
    rate_limit: PerJoint = non_negative(
        (0.0, 0.0), 'largest rate of commands; 0: no limit', 'N m/s'
    )
    first_step: PerJoint = non_negative(
        (0.0, 0.0),
        'largest first torque, a step from zero, that the drives tolerate; 0: no limit',
        'N m',
    )


@dataclass(frozen=True)
class Learning:
    """Composite learning of the parameters P and of the disturbance columns."""

    enabled: bool = parameter(
        True, 'learn the arm while it moves; false: keep what is known of it'
    )
    window: float = sizing(
        2.0 * math.pi,
        'length of the excitation window; whole reference periods average out disturbances',
        's',
        'tau_d',
        above=0.0,
    )
    ripple_cycles: tuple[float, ...] = sizing(
        (),
        'also estimate a torque ripple of each joint with so many periods per turn; where it '
        'slides, rad per metre',
        above=0.0,
        omittable=True,
    )
    residual_floor: PerJoint = positive(
        (0.07, 0.07),
        'rms unmodelled torque that is not treated as a change of the arm',
        'N m',
    )

    def problems(self, sample_time: float) -> Iterator[str]:
        """Check the window's size."""
        samples = self.window / sample_time
        (fewest, most) = _SAMPLES
        if not fewest - 0.5 <= samples <= most + 0.5:
            text = (
                f'learning.window: got {self.window:g} s, which is {samples:.0f} samples of '
                f'{sample_time:g} s: between {fewest} and {most} are allowed'
            )
            if sample_time >= _SLOW:
                text += f'; if sample_time is in ms, give {1e-3 * sample_time:g}'
            yield text


@dataclass(frozen=True)
class DeclaredLoad:
    """Whether the estimated load is declared to drives that compensate gravity, and how."""

    tell_drive: bool = sizing(
        False, 'declare the estimated load to the drives, once it is known well'
    )
    service: str = sizing(
        '',
        'over ROS: service of the driver that accepts the load, a '
        'ur_msgs/srv/SetPayload or franka_msgs/srv/SetLoad; empty: no load is '
        'declared',
    )
    frame: str = sizing(
        '',
        'over ROS: link in whose frame that service expects the centre; empty: '
        'robot.tip',
    )


@dataclass(frozen=True)
class Contact:
    """External torque, which the learned model does not explain; reactions."""

    enabled: bool = sizing(
        False, 'compute the external torque with its interval, and detect contacts'
    )
    threshold: float = positive(
        8.0,
        'threshold of a contact: distance of the external torque from what model, '
        'noise and a load explain, in standard deviations',
        symbol='h',
    )
    reaction: Literal['none', 'stop', 'hold', 'yield'] = parameter(
        'none',
        'reaction to a contact: none, safe stop, brake and hold, or give way with '
        'only gravity and damping; with a reaction, nothing is learned while a '
        'contact lasts',
    )
    loads: bool = parameter(
        True,
        'what a load at the tip could explain is not a contact',
    )


@dataclass(frozen=True)
class CommissionedGains:
    """What the arm showed while it was measured, by which its gains were chosen."""

    friction: PerJoint = _of_joints(
        'friction that each joint showed while it was measured, which the errors to '
        'expect count; empty: the arm was not measured, and robot.coulomb counts, or 5 % of '
        'the rated torque where none is known',
        'N m',
    )
    unseen_inertia: PerJoint = _of_joints(
        'inertia of each joint beyond that of the model which friction may have '
        'hidden, likewise; empty: none',
        'kg m^2',
    )
