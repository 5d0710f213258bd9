# SPDX-License-Identifier: Apache-2.0
"""Values that no arm can mean: those of another unit, or of another arm.

What is allowed follows from the arm: from the efforts of its drives, its reach, and the
velocities and ranges of its joints.  A value beyond is refused, unless its parameter is
listed in `insist`: nobody should have to find out in motion that a bound was in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.tuning import UNKNOWN_EFFORT, WIDEST
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.checked import Checked
from blf_dsc_controller.configuration.motion_groups import PAST_LIMITS
from blf_dsc_controller.configuration.robot import ArmConfig, Robot
from blf_dsc_controller.configuration.schema import suggestion
from blf_dsc_controller.configuration.tool_bound import ANGLE, POSITION
from blf_dsc_controller.run import joint_units

CHECKED = (
    'feedback.stiffness',
    'torque.limit',
    'safety.velocity_limit',
    'limits.velocity',
    'limits.position_lower',
    'limits.position_upper',
    'barrier.bound',
    POSITION,
    ANGLE,
    'robot.gravity',
    'robot.payload',
    'robot.drive_payload',
    'robot.drive_payload_centre',
    'robot.rotor_inertia',
    'robot.coulomb',
    'robot.viscous',
    'sensor.resolution',
    'sensor.position_noise',
    'actuator.time_constant',
)
"""Parameters whose values are compared with the arm; gains, at the start."""

_ROUNDED = 1.001  # defaults have four digits
_BROKEN = 10.0  # times the speed of the fastest joint: no measurement
_UNKNOWN = 100.0  # times the speed of motions, where the speed of the joints is unknown
_QUARTER = 0.5 * math.pi  # rad: an arm so far from its reference points elsewhere
_WIDEST = 0.1  # of the reach
_HEAVIEST = 30.0  # m/s^2, on no planet
_CARRIED = 10.0  # times what the strongest joint holds at full reach
_SLOWEST = 1.0  # rad/s^2, of a free drive at its rated torque
_COARSEST = 0.01  # of the range
LONGEST_LAG = 0.1
"""Lag [s] that is too long for any loop; drivers have up to 0.03."""


class _Doubt(NamedTuple):
    """A value that cannot be meant."""

    name: str  # of its parameter
    text: str  # what it got, what the arm allows, and what may be meant


def problems_of_controller(config: Checked) -> Iterator[str]:
    """Yield what no arm can mean among the parameters of a controller."""
    yield from _unknown_words(config.insist)
    chain = None
    if config.model == 'urdf':
        chain = config.robot.chain(config.joints)
        of_robot = list(_refused(_of_robot(config.robot, chain), config.insist))
        if of_robot:  # from which the others follow
            yield from of_robot
            return
    yield from _refused(_of_controller(config, chain), config.insist)


def _of_controller(config: Checked, chain: Chain | None) -> Iterator[_Doubt]:
    yield from _of_velocity(config, chain)
    yield from _of_errors(config)
    if chain is not None:
        yield from _of_drives(config, chain)
        yield from _of_ranges(config, chain)
        yield from _of_tool(config, chain)


def problems_of_plant(
    config: ArmConfig, *, resolution: float, noise: float, lag: float
) -> Iterator[str]:
    """Yield what no arm can mean among the parameters of a simulated one.

    They are `sensor.resolution`, `sensor.position_noise` [rad] and
    `actuator.time_constant` [s].
    """
    yield from _unknown_words(config.insist)
    doubts = _of_sensors(config, resolution, noise, lag)
    yield from _refused(doubts, config.insist)


def _unknown_words(insist: Iterable[str]) -> Iterator[str]:
    """Yield a problem for each entry of `insist` whose value is not checked."""
    for name in insist:
        if name not in CHECKED:
            yield (
                f'insist: got {name}, whose value is not compared with the arm'
                f'{suggestion(name, CHECKED)}'
            )


def _refused(doubts: Iterable[_Doubt], insist: Sequence[str]) -> Iterator[str]:
    """Yield the problem of each parameter, of the first joint that it has one for."""
    first: dict[str, str] = {}
    for name, text in doubts:
        first.setdefault(name, text)
    for name, text in first.items():
        if name not in insist:
            yield f'{name}: {text}; if it is meant, list {name} in insist'


def _of_drives(config: Checked, chain: Chain) -> Iterator[_Doubt]:
    """Check torques against the efforts of the drives."""
    strongest = config.robot.largest_efforts(chain).clip(UNKNOWN_EFFORT).tolist()
    for joint, (_, unit, _), limit, most in zip(
        chain.joints, config.units, config.torque.limit, strongest, strict=True
    ):
        allowed = joint.effort
        source = 'the URDF gives its drive'
        if math.isinf(allowed):
            allowed = most
            source = 'no drive of an arm of this weight has more than'
        if limit > _ROUNDED * allowed:
            text = f'got {limit:g} {unit} for {joint.name}, but {source} {allowed:.4g} {unit}'
            yield _Doubt('torque.limit', text)


def _of_velocity(config: Checked, chain: Chain | None) -> Iterator[_Doubt]:
    """Check the speeds to stop at against those of the joints."""
    limit = max(config.safety.velocity_limit)
    motions = config.limits.velocity
    unlimited = [math.inf] * len(motions)
    speeds = [joint.velocity for joint in chain.joints] if chain else unlimited
    pairs = list(zip(speeds, motions, strict=True))
    known = max((speed for speed, _ in pairs if math.isfinite(speed)), default=0.0)
    assumed = max((motion for speed, motion in pairs if math.isinf(speed)), default=0.0)
    if limit > max(_BROKEN * known, _UNKNOWN * assumed):
        fastest, source = (assumed, ' (limits.velocity)') if assumed else (known, '')
        yield _Doubt(
            'safety.velocity_limit',
            f'got {limit:g} rad/s, but the fastest joint has {fastest:.3g} rad/s{source}: '
            f'{_of_degrees(limit)}',
        )


def _of_ranges(config: Checked, chain: Chain) -> Iterator[_Doubt]:
    """Check the limits of motions against those of the URDF."""
    limits = config.limits
    for joint, fastest in zip(chain.joints, limits.velocity, strict=True):
        if fastest > _ROUNDED * joint.velocity:
            yield _Doubt(
                'limits.velocity',
                f'got {fastest:g} for {joint.name}, but the URDF allows '
                f'{joint.velocity:g}: {_unit_of(joint.kind, fastest)}',
            )
    for joint, lower, upper in zip(
        chain.joints, limits.position_lower, limits.position_upper, strict=True
    ):
        for name, value, is_past in (
            ('limits.position_lower', lower, lower < joint.lower - PAST_LIMITS),
            ('limits.position_upper', upper, upper > joint.upper + PAST_LIMITS),
        ):
            if is_past:
                yield _Doubt(
                    name,
                    f'got {value:g} for {joint.name}, whose range in the URDF is '
                    f'{joint.lower:g} to {joint.upper:g}: {_unit_of(joint.kind, value)}',
                )


def widest_bound(kind: str, lower: float, upper: float) -> float:
    """Return the largest bound [rad or m] on the error of a joint by its limits."""
    allowed = 0.5 * (upper - lower)
    if kind != 'prismatic':
        allowed = min(allowed, _QUARTER)
    return max(allowed, WIDEST)


def _of_errors(config: Checked) -> Iterator[_Doubt]:
    """Check the bounds on errors against the ranges of the joints."""
    if config.barrier.bounds_tool:  # from which they follow
        return
    limits = config.limits
    for joint, kind, bound, lower, upper in zip(
        config.joints,
        config.robot.kinds(config.joints),
        config.barrier.bound,
        limits.position_lower,
        limits.position_upper,
        strict=True,
    ):
        allowed = widest_bound(kind, lower, upper)
        if bound > allowed:
            yield _Doubt(
                'barrier.bound',
                f'got {bound:g} for {joint}, but past {allowed:.3g}, half of its range or a '
                f'quarter turn, nothing is bounded: {_unit_of(kind, bound)}'
                + ('' if kind == 'prismatic' else f'; in mrad? Give {1e-3 * bound:g}'),
            )


def widest_at_tool(chain: Chain) -> tuple[float, float]:
    """Return the largest bounds [m, rad] on the error of a tool by the reach of its arm."""
    return _WIDEST * chain.reach or math.inf, _QUARTER


def _of_tool(config: Checked, chain: Chain) -> Iterator[_Doubt]:
    """Check the bounds at the tool against the reach of the arm."""
    reach = chain.reach
    bound = config.barrier.tool_bound
    widest, turned = widest_at_tool(chain)
    if bound > widest:
        yield _Doubt(
            POSITION,
            f'got {bound:g} m, more than a tenth of the reach, {reach:.3g} m: is it in mm? '
            f'Give {1e-3 * bound:g}',
        )
    angle = config.barrier.tool_angle_bound
    if angle > turned:
        yield _Doubt(
            ANGLE, f'got {angle:g} rad, more than a quarter turn: {_of_degrees(angle)}'
        )


def _of_robot(robot: Robot, chain: Chain) -> Iterator[_Doubt]:
    """Check what is said of the robot against its efforts and its reach."""
    if (gravity := float(np.linalg.norm(robot.gravity))) > _HEAVIEST:
        text = f'got {gravity:.4g} m/s^2: is it in mm/s^2? Give {1e-3 * gravity:.4g}'
        yield _Doubt('robot.gravity', text)
        return
    yield from _of_payloads(robot, chain)
    efforts = robot.efforts(chain)
    speeds = [min(joint.velocity, 1.0) for joint in chain.joints]
    for name, unit, given, most in (
        ('rotor_inertia', 'kg m^2', robot.rotor_inertia, efforts / _SLOWEST),
        ('coulomb', 'N m', robot.coulomb, efforts),
        ('viscous', 'N m s/rad', robot.viscous, efforts / speeds),
    ):
        for joint, value, allowed in zip(
            chain.joints, given, most.tolist(), strict=False
        ):
            if value > allowed:
                own = joint_units(joint.kind).of(unit)
                yield _Doubt(
                    f'robot.{name}',
                    f'got {value:g} {own} for {joint.name}, which its drive could hardly move: '
                    f'its effort allows {allowed:.3g} {own}',
                )


def _of_payloads(robot: Robot, chain: Chain) -> Iterator[_Doubt]:
    """Check loads against what the arm can hold, and their centre against its reach."""
    reach = chain.reach
    centre = float(np.linalg.norm(robot.drive_payload_centre))
    if centre > reach > 0.0:
        yield _Doubt(
            'robot.drive_payload_centre',
            f'got a centre {centre:g} m from the tip, farther than the arm reaches, '
            f'{reach:.3g} m: is it in mm? Give '
            f'{[1e-3 * each for each in robot.drive_payload_centre]}',
        )
    most = _CARRIED * robot.carried(chain)
    for name, mass, default in (
        ('payload', robot.payload, type(robot).payload),
        ('drive_payload', robot.drive_payload, 0.0),
    ):
        if mass > most > 0.0 and mass != default:
            yield _Doubt(
                f'robot.{name}',
                f'got {mass:g} kg, over ten times what the strongest joint holds at full '
                f'reach, {most / _CARRIED:.3g} kg: is it in g? Give {1e-3 * mass:g}',
            )


def _of_sensors(
    config: ArmConfig, resolution: float, noise: float, lag: float
) -> Iterator[_Doubt]:
    """Check the sensors and actuators of a simulated arm."""
    ranges = [math.tau]
    if config.robot.urdf:
        joints = config.robot.chain(config.joints).joints
        ranges += [joint.upper - joint.lower for joint in joints]
    coarsest = _COARSEST * min(ranges)
    if resolution > coarsest:
        yield _Doubt(
            'sensor.resolution',
            f'got {resolution:g} rad, with which the range of a joint has fewer than a hundred '
            f'steps: is it in bits? Give {math.tau / 2.0 ** min(resolution, 64.0):.3g}',
        )
    if noise > coarsest:
        yield _Doubt(
            'sensor.position_noise',
            f'got {noise:g} rad rms, more than a hundredth of the range of a '
            f'joint: {_of_degrees(noise)}',
        )
    if lag > LONGEST_LAG:
        yield _Doubt(
            'actuator.time_constant',
            f'got {lag:g} s, too long for any loop: is it in ms? Give {1e-3 * lag:g}',
        )


def _unit_of(kind: str, value: float) -> str:
    """Ask whether a value of a joint is of another unit."""
    if kind == 'prismatic':
        return f'is it in mm? Give {1e-3 * value:g}'
    return _of_degrees(value)


def hint_at_degrees(at: float, lower: float, upper: float) -> str:
    """Return what to give if an angle [rad] past its limits may be in degrees; or empty."""
    if abs(at) > 2.0 * math.pi and lower <= math.radians(at) <= upper:
        return f'; if this is in degrees, give {math.radians(at):.4g}'
    return ''


def _of_degrees(value: float) -> str:
    return f'is it in degrees? Give {math.radians(value):.3g}'
