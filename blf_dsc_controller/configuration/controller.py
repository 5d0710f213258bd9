# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller: reference, limits, safety, telemetry; the gains are in `gains`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np

from blf_dsc_controller.arms import tuning
from blf_dsc_controller.arms.model import arm_model
from blf_dsc_controller.configuration.gains import (
    ArmGeometry,
    Barrier,
    ComparisonGains,
    DisturbanceEstimate,
    Feedback,
    KnownArm,
    Learning,
    Surface,
    Torque,
)
from blf_dsc_controller.configuration.robot import ArmConfig, given_robot, parameters_of
from blf_dsc_controller.configuration.schema import (
    PerJoint,
    Value,
    non_negative,
    parameter,
    positive,
)

_of_reference = partial(
    parameter, read_only='the reference would jump: send a trajectory on ~/joint_trajectory'
)
_size = partial(parameter, read_only='it sets the size of the state of the law')
_telemetry = partial(parameter, read_only='topics are created once, when the node starts')


@dataclass(frozen=True)
class Reference:
    """The reference to track, until a trajectory arrives on `~/joint_trajectory`.

    Sinusoids are qr_i = offset_i + sum_k amplitude_ik cos(frequency_k t + phase_k); waypoints are
    passed with minimum jerk, at rest at both ends.
    """

    type: Literal['sinusoids', 'waypoints', 'hold'] = _of_reference(
        'sinusoids', 'sinusoids (paper), waypoints (minimum jerk), or hold (the initial position)'
    )
    offset: PerJoint = _of_reference((1.9935, 1.3961), 'centre of the motion', 'rad')
    amplitude: Annotated[tuple[float, ...], 'joints', 'reference.frequency'] = _of_reference(
        (0.3, 0.3), 'amplitude of each tone: one row per joint, row by row', 'rad'
    )
    frequency: tuple[float, ...] = _of_reference(
        (1.0,), 'angular frequency of each tone', 'rad/s', at_least=0.0
    )
    phase: Annotated[tuple[float, ...], 'reference.frequency'] = _of_reference(
        (0.0,), 'phase of each tone', 'rad'
    )
    times: tuple[float, ...] = _of_reference(
        (), 'time of each waypoint from the start', 's', at_least=0.0, omittable=True
    )
    points: Annotated[tuple[float, ...], 'joints', 'reference.times'] = _of_reference(
        (), 'position at each waypoint: one row per joint, row by row', 'rad'
    )

    def problems(self) -> list[str]:
        """Check that there are waypoints if they are used, and that their times increase."""
        if self.type == 'waypoints' and not self.times:
            return ['reference.times: got none, but reference.type waypoints needs at least one']
        return [
            f'reference.times: got {after:g} s after {before:g} s, but they must increase'
            for before, after in pairwise(self.times)
            if after <= before
        ]


@dataclass(frozen=True)
class Approach:
    """Motion to the reference from a start outside the bound; the bound applies along it."""

    enabled: bool = parameter(True, 'guide an arm into the bound; false: do not start outside')
    longest: float = positive(30.0, 'longest duration of the approach', 's')


@dataclass(frozen=True)
class MotionLimits:
    """Limits of each joint for an approach or a received trajectory."""

    position_lower: PerJoint = parameter((-2.0 * math.pi,) * 2, 'lowest position', 'rad')
    position_upper: PerJoint = parameter((2.0 * math.pi,) * 2, 'highest position', 'rad')
    velocity: PerJoint = positive((1.5, 1.5), 'largest velocity', 'rad/s')
    acceleration: PerJoint = positive((2.0, 2.0), 'largest acceleration', 'rad/s^2')

    def problems(self, joints: tuple[str, ...]) -> list[str]:
        """Check that the position limits leave a range."""
        limits = zip(joints, self.position_lower, self.position_upper, strict=True)
        return [
            f'limits.position_upper: got {upper:g} rad for {joint}, but it must be above '
            f'limits.position_lower, {lower:g} rad'
            for joint, lower, upper in limits
            if upper <= lower
        ]


@dataclass(frozen=True)
class Safety:
    """Limits past which the controller makes a safe stop, and the torque of that stop."""

    state_timeout: float = positive(0.04, 'largest delay of a state, by steady clock or stamp', 's')
    watchdog: Literal['auto', 'on', 'off'] = parameter(
        'auto', 'steady-clock watchdog for missing states; auto: only if stamps are wall-clock time'
    )
    repeated_states: int = non_negative(
        3, 'consecutive states with an unchanged stamp to ignore', 'samples', at_most=1_000_000
    )
    velocity: Literal['measured', 'estimated'] = parameter(
        'measured',
        'velocity as measured, or estimated from position differences, starting at rest',
        read_only='the filters hold data that depend on it',
    )
    velocity_limit: float = positive(
        50.0, 'velocity above which a measurement counts as broken', 'rad/s'
    )
    error_ratio: float = non_negative(
        1.0, 'tracking error to stop at, relative to the bound, for laws with a barrier; 0: never'
    )
    saturation_time: float = positive(
        0.5, 'longest time of torques at their limit, less a quarter of the time without', 's'
    )
    overrun_fraction: float = positive(
        0.4, 'largest fraction of missed states, averaged over overrun_window', at_most=1.0
    )
    overrun_window: float = positive(1.0, 'time over which missed states are averaged', 's')
    first_torque: Literal['check', 'send'] = parameter(
        'check', 'refuse a first torque that an arm at rest contradicts, or send it unchecked'
    )
    torque: Literal['zero', 'damping', 'hold_gravity'] = parameter(
        'zero', 'safe torque: zero, damping -D dq, or the learned gravity with damping'
    )
    damping: PerJoint = non_negative((2.0, 1.0), 'damping in the safe torque', 'N m s/rad', 'D')
    stop_ramp: float = non_negative(0.0, 'ramp to the safe torque after a fault; 0: at once', 's')
    deactivation_ramp: float = non_negative(0.5, 'the same ramp when the node is deactivated', 's')
    fade_time: float = positive(0.5, 'time to fade the safe torque without usable states', 's')


@dataclass(frozen=True)
class Telemetry:
    """What the controller publishes besides its commands."""

    enabled: bool = _telemetry(True, 'publish reference, errors, estimates and monitors')
    decimation: int = _telemetry(
        10,
        'samples per message of reference and monitor; errors come with every sample',
        at_least=1,
    )


@dataclass(frozen=True)
class ControllerConfig(ArmConfig):
    """Parameters of the node `blf_dsc_controller`; the defaults are the recommended set."""

    law: Literal['blf_dsc', 'model_based', 'backstepping', 'slotine_li'] = _size(
        'blf_dsc', 'control law'
    )
    model: Literal['two_link', 'urdf'] = _size('two_link', 'model of the arm')
    arm: ArmGeometry = ArmGeometry()
    reference: Reference = Reference()
    approach: Approach = Approach()
    limits: MotionLimits = MotionLimits()
    barrier: Barrier = Barrier()
    surface: Surface = Surface()
    feedback: Feedback = Feedback()
    disturbance: DisturbanceEstimate = DisturbanceEstimate()
    torque: Torque = Torque()
    learning: Learning = Learning()
    comparison: ComparisonGains = ComparisonGains()
    truth: KnownArm = KnownArm()
    safety: Safety = Safety()
    telemetry: Telemetry = Telemetry()

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> Mapping[str, Value]:
        """Return gains and limits for the arm of a URDF; the defaults suit the two-link arm."""
        period = given.get('sample_time', ArmConfig.sample_time)
        if given.get('model', 'urdf' if given.get('robot.urdf') else '') != 'urdf':
            return {'surface.time_constant': max(period, Surface().time_constant)}
        robot, chain = given_robot(given)
        arm = tuning.Design(
            chain,
            parameters_of(robot, chain),
            robot.efforts(chain),
            robot.rotors(chain),
            robot.payload,
            robot.lag,
        )
        bound = np.array(given.get('barrier.bound', ()))
        return {
            'model': 'urdf',
            'learning.weighing': given.get('learning.prediction', 'filtered') == 'filtered',
            **tuning.gains_of(arm, period, bound if bound.size == len(chain.joints) else None),
        }

    def problems(self) -> Iterator[str]:
        """Check the parameters against each other, joints and estimates against the model."""
        if self.model == 'urdf':
            needed = None
            count = parameters_of(self.robot, self.robot.chain(self.joints)).model.p
        else:
            model = arm_model(self.model, self.arm.l1, self.arm.gravity)
            needed, count = model.n, model.p
        learning, learned = self.learning, (self.model, self.learning.prediction)
        if learning.weighing and learned != ('urdf', 'filtered'):
            needs = 'model urdf and learning.prediction filtered'
            yield f'learning.weighing: got true with {", ".join(learned)}, but needs {needs}'
            return
        yield from self.arm_problems(f'model {self.model}', needed)
        yield from self.reference.problems()
        yield from self.limits.problems(self.joints)
        yield from self.barrier.problems(self.joints)
        yield from self.truth.problems(self.law, self.model, count, self.learning.radius)
        yield from self.learning.problems(self.sample_time, self.model, count)
