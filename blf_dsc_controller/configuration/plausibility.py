# SPDX-License-Identifier: Apache-2.0
"""Values that no arm can mean: those of another unit, or of another arm.

What is allowed follows from the arm: from the efforts of its drives, its reach, and the
velocities and ranges of its joints.  A value beyond is refused, unless its parameter is
listed in `insist`: nobody should have to find out in motion that a bound was in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice
from typing import Any

import numpy as np

from blf_dsc_controller.arms.tuning import UNKNOWN_EFFORT, WIDEST
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.controller_parameters import (
    ControllerParameters,
)
from blf_dsc_controller.configuration.motion_groups import PAST_LIMITS
from blf_dsc_controller.configuration.robot import ArmConfig
from blf_dsc_controller.configuration.rules import Rule, Severity, When
from blf_dsc_controller.configuration.schema import suggestion
from blf_dsc_controller.configuration.tool_bound import ANGLE, POSITION
from blf_dsc_controller.run import joint_units

STIFFNESS = 'feedback.stiffness'
"""The parameter of gains that are too high; listed in `insist`, they are not refused."""

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


def of_urdf(config: Any) -> bool:
    """Whether the arm is that of a URDF."""
    return bool(config.robot.urdf)


def _row(
    name: str,
    find: Callable[[Any], Iterable[str]],
    applies: Callable[[Any], bool] = of_urdf,
) -> Rule:
    """Return the rule for a value, of the first joint whose value is implausible."""

    def found(config: Any) -> Iterator[str]:
        for text in islice(find(config), 1):
            yield f'{name}: {text}; if it is meant, list {name} in insist'

    return Rule(name, When.LOAD, Severity.REFUSE, found, applies, can_insist=True)


def _number(
    name: str,
    unit: str,
    values: Callable[[Any], tuple[Any, float]],
    why: str,
    other: str,
    factor: float | Callable[[float], float] = 1e-3,
    applies: Callable[[Any], bool] = of_urdf,
) -> Rule:
    """Return the rule for a number, or for the length of a vector.

    `values` are what it is and the most it may be, `factor` leads from the other unit.
    """

    def convert(value: float) -> float:
        return factor * value if isinstance(factor, float) else factor(value)

    def find(config: Any) -> Iterator[str]:
        value, most = values(config)
        size = float(np.linalg.norm(value))
        if size > most:
            meant = f'{convert(size):.3g}'
            if isinstance(value, tuple):
                meant = str([convert(each) for each in value])
            yield (
                f'got {size:.4g} {unit}, but {why} {most:.3g} {unit}: is it in {other}? '
                f'Give {meant}'
            )

    return _row(name, find, applies)


def _degrees(kind: str, value: float) -> str:
    """Ask whether a value of a joint is of another unit."""
    if kind == 'prismatic':
        return f': is it in mm? Give {1e-3 * value:g}'
    return f': is it in degrees? Give {math.radians(value):.3g}'


def _mrad(kind: str, value: float) -> str:
    also = '' if kind == 'prismatic' else f'; in mrad? Give {1e-3 * value:g}'
    return _degrees(kind, value) + also


def _beyond(
    config: ArmConfig,
    values: Iterable[float],
    allowed: Iterable[float],
    why: str,
    unit: str = 'rad',
    hint: Callable[[str, float], str] = lambda _kind, _value: '',
    sign: float = 1.0,
) -> Iterator[str]:
    """Yield which joints have more than is allowed, or less with a `sign` of -1."""
    kinds = config.robot.kinds(config.joints)
    for joint, kind, value, most in zip(
        config.joints, kinds, values, allowed, strict=False
    ):
        if sign * value > _ROUNDED * sign * most:
            own = joint_units(kind).of(unit)
            yield (
                f'got {value:g} {own} for {joint}, but {why} {most:.4g} {own}'
                f'{hint(kind, value)}'
            )


def _torques(config: ControllerParameters) -> Iterator[str]:
    """Check torques against the efforts of the drives."""
    chain = config.robot.chain(config.joints)
    strongest = config.robot.largest_efforts(chain).clip(UNKNOWN_EFFORT).tolist()
    efforts = [joint.effort for joint in chain.joints]
    unknown = np.where(np.isinf(efforts), strongest, math.inf).tolist()
    compare = partial(_beyond, config, config.torque.limit, unit='N m')
    yield from compare(efforts, 'the URDF gives its drive')
    yield from compare(unknown, 'no drive of an arm of this weight has more than')


def _fastest(config: ControllerParameters) -> tuple[float, float]:
    """Return the speed to stop at, and the most that it may be [rad/s]."""
    motions = config.limits.velocity
    speeds = [math.inf] * len(motions)
    if config.robot.urdf:
        joints = config.robot.chain(config.joints).joints
        speeds = [joint.velocity for joint in joints]
    known = [speed for speed in speeds if math.isfinite(speed)]
    assumed = [
        motion
        for motion, speed in zip(motions, speeds, strict=True)
        if math.isinf(speed)
    ]
    most = max(_BROKEN * max(known, default=0.0), _UNKNOWN * max(assumed, default=0.0))
    return max(config.safety.velocity_limit), most


def _of_drives(name: str, unit: str, least: Callable[[Chain], list[float]]) -> Rule:
    """Return the rule for what a drive moves at its effort, whatever it is `least` (n,)."""

    def find(config: ArmConfig) -> Iterator[str]:
        robot = config.robot
        chain = robot.chain(config.joints)
        most = (robot.efforts(chain) / least(chain)).tolist()
        why = 'which its drive could hardly move: its effort allows'
        return _beyond(config, getattr(robot, name), most, why, unit)

    return _row(f'robot.{name}', find)


def _motions(config: ControllerParameters) -> Iterator[str]:
    joints = config.robot.chain(config.joints).joints
    speeds = [joint.velocity for joint in joints]
    why = 'the URDF allows'
    return _beyond(config, config.limits.velocity, speeds, why, 'rad/s', _degrees)


def _range(end: str, sign: float) -> Rule:
    """Return the rule for the lower or the upper position limits."""

    def find(config: ControllerParameters) -> Iterator[str]:
        joints = config.robot.chain(config.joints).joints
        ends = [getattr(joint, end) + sign * PAST_LIMITS for joint in joints]
        given = getattr(config.limits, f'position_{end}')
        why = f'past its limits in the URDF are less than {PAST_LIMITS:g}, up to'
        return _beyond(config, given, ends, why, 'rad', _degrees, sign)

    return _row(f'limits.position_{end}', find)


def widest_bound(kind: str, lower: float, upper: float) -> float:
    """Return the largest bound [rad or m] on the error of a joint by its limits."""
    allowed = 0.5 * (upper - lower)
    if kind != 'prismatic':
        allowed = min(allowed, _QUARTER)
    return max(allowed, WIDEST)


def _bounds(config: ControllerParameters) -> Iterator[str]:
    """Check the bounds on errors against the ranges of the joints."""
    limits, kinds = config.limits, config.robot.kinds(config.joints)
    widest = map(widest_bound, kinds, limits.position_lower, limits.position_upper)
    why = 'nothing is bounded past half of its range or a quarter turn,'
    return _beyond(config, config.barrier.bound, widest, why, hint=_mrad)


def _bounds_joints(config: ControllerParameters) -> bool:
    return not config.barrier.bounds_tool


def widest_at_tool(chain: Chain) -> tuple[float, float]:
    """Return the largest bounds [m, rad] on the error of a tool by the reach of its arm."""
    return _WIDEST * chain.reach or math.inf, _QUARTER


def _carried(name: str) -> Callable[[ArmConfig], tuple[float, float]]:
    """Return what a load is, and the most that an arm could hold [kg]."""

    def loads(config: ArmConfig) -> tuple[float, float]:
        robot = config.robot
        mass = getattr(robot, name)
        most = _CARRIED * robot.carried(robot.chain(config.joints))
        is_usual = mass == getattr(type(robot), name)
        return mass, math.inf if is_usual else most or math.inf

    return loads


def _coarsest(config: ArmConfig) -> float:
    """Return the most that a sensor may be off by [rad]."""
    ranges = [math.tau]
    if config.robot.urdf:
        joints = config.robot.chain(config.joints).joints
        ranges += [joint.upper - joint.lower for joint in joints]
    return _COARSEST * min(ranges)


def _gravity(name: str) -> Callable[[ArmConfig], tuple[float, float]]:
    """Return the acceleration of gravity by name [m/s^2], and the most on a planet."""
    return lambda config: (math.hypot(*getattr(config.robot, name)), _HEAVIEST)


def _reach(config: ArmConfig) -> float:
    return config.robot.chain(config.joints).reach or math.inf


_IN_DEGREES = math.radians(1.0)

OF_ROBOT = (
    *(
        _number(
            f'robot.{name}',
            'm/s^2',
            _gravity(name),
            'on no planet it is more than',
            'mm/s^2',
        )
        for name in ('gravity', 'drive_gravity')
    ),
    _number(
        'robot.drive_payload_centre',
        'm',
        lambda config: (config.robot.drive_payload_centre, _reach(config)),
        'the arm reaches no farther than',
        'mm',
    ),
    *(
        _number(
            f'robot.{name}',
            'kg',
            _carried(name),
            'ten times what the strongest joint holds at full reach are',
            'g',
        )
        for name in ('payload', 'drive_payload')
    ),
    _of_drives('rotor_inertia', 'kg m^2', lambda _: [_SLOWEST]),
    _of_drives('coulomb', 'N m', lambda _: [1.0]),
    _of_drives(
        'viscous',
        'N m s/rad',
        lambda chain: [min(joint.velocity, 1.0) for joint in chain.joints],
    ),
)
"""Rules of the robot, from which those of the controller follow."""

OF_CONTROLLER = (
    _row('torque.limit', _torques),
    _number(
        'safety.velocity_limit',
        'rad/s',
        _fastest,
        'no joint, ten times as fast as the fastest or a hundred times limits.velocity, has',
        'degrees',
        _IN_DEGREES,
        lambda _: True,
    ),
    _row('limits.velocity', _motions),
    _range('lower', -1.0),
    _range('upper', 1.0),
    _row('barrier.bound', _bounds, _bounds_joints),
    _number(
        POSITION,
        'm',
        lambda config: (config.barrier.tool_bound, _WIDEST * _reach(config)),
        'a tenth of the reach is',
        'mm',
    ),
    _number(
        ANGLE,
        'rad',
        lambda config: (config.barrier.tool_angle_bound, _QUARTER),
        'a quarter turn is',
        'degrees',
        _IN_DEGREES,
    ),
)

OF_PLANT = (
    _number(
        'sensor.resolution',
        'rad',
        lambda config: (config.sensor.resolution, _coarsest(config)),
        'a hundredth of the range of a joint is',
        'bits',
        lambda bits: math.tau / 2.0 ** min(bits, 64.0),
        lambda _: True,
    ),
    _number(
        'sensor.position_noise',
        'rad',
        lambda config: (config.sensor.position_noise, _coarsest(config)),
        'a hundredth of the range of a joint is',
        'degrees',
        _IN_DEGREES,
        lambda _: True,
    ),
    _number(
        'actuator.time_constant',
        's',
        lambda config: (config.actuator.time_constant, LONGEST_LAG),
        'no loop is stable with more than',
        'ms',
        applies=lambda _: True,
    ),
)

_CHECKED = (
    STIFFNESS,
    *(rule.parameter for rule in (*OF_ROBOT, *OF_CONTROLLER, *OF_PLANT)),
)


def _unknown_words(config: ArmConfig) -> Iterator[str]:
    """Yield a problem for each entry of `insist` whose value is not checked."""
    for name in config.insist:
        if name not in _CHECKED:
            yield (
                f'insist: got {name}, whose value is not compared with the arm'
                f'{suggestion(name, _CHECKED)}'
            )


INSISTED = Rule('insist', When.LOAD, Severity.REFUSE, _unknown_words)


def hint_at_degrees(at: float, lower: float, upper: float) -> str:
    """Return what to give if an angle [rad] past its limits may be in degrees; or empty."""
    if abs(at) > 2.0 * math.pi and lower <= math.radians(at) <= upper:
        return f'; if this is in degrees, give {math.radians(at):.4g}'
    return ''
