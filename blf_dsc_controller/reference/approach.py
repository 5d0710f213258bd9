# SPDX-License-Identifier: Apache-2.0
"""The configured reference, the approach to it, and limits of motions.

An arm in motion is taken over at its velocity, in a motion that brakes.  A reference to
hold rests where this ends.  Any other reference is blended into the present motion (see
`terms`), starting at t0, in the shortest time that keeps the limits, found in 10 %
steps and refined by bisection; in motion, and where a law starts again, with a share of
the acceleration, if that is possible and soon enough.  A blend exceeds the speed of its
parts only by a multiple of their distance over its duration, so one exists if both parts
stay strictly within the limits and their distance is finite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.motion_groups import PAST_LIMITS
from blf_dsc_controller.configuration.plausibility import hint_at_degrees
from blf_dsc_controller.errors import (
    BlfDscError,
    StartError,
)
from blf_dsc_controller.reference.terms import (
    Term,
    ending_at_rest,
    evaluate,
    hermite,
    minimum_jerk,
    pack,
    sampled,
    sinusoids_term,
    unpack,
)
from blf_dsc_controller.reference.turns import reference_near
from blf_dsc_controller.run import TURNING, JointUnits

AT_REST = 0.01
"""Largest velocity of an arm at rest [rad/s]."""

_SHORTEST = 0.02  # s
_STEP = 1.1
_BISECTIONS = 5
_BRAKE = 3.0
"""Braking from v in the time h takes up to 1.5 v / h: h = 3 v / limit takes half."""
_IN_MOTION = 0.6
"""Share of limits.acceleration for a takeover in motion, where positions and time permit it.

So for all starts of a law but its first one.  What the model lacks, as a load that a reset has
made the law forget, acts by the acceleration.
"""
_LONGEST = 30.0  # s, of an approach: a slower one is no approach
_LONGEST_IN_MOTION = 4.0  # s
_MOVING = 2.0 * AT_REST  # rad/s; steps of a motor's velocity reach AT_REST
_PERIOD = 0.005  # s, between two checked samples
_FEWEST_CHECKED = 200  # samples, for short motions
_MOST_CHECKED = 1_000_000  # samples, for very long ones
_ROUNDING = 1e-9  # relative, for motions that just reach a limit

POSITIONS = 'limits.position_lower and limits.position_upper'
"""The parameters of the position limits."""


class Violation(NamedTuple):
    """The largest violation of a limit by a motion."""

    joint: str
    quantity: str  # position, velocity or acceleration
    value: float
    limit: float
    time: float  # s
    # value over limit; positions are relative to the middle of their range
    ratio: float
    units: JointUnits = TURNING  # of the joint

    def __str__(self) -> str:
        """Describe the violation: joint, quantity, value and limit with their unit."""
        per = {'position': '', 'velocity': '/s', 'acceleration': '/s^2'}
        unit = self.units.position + per[self.quantity]
        return (
            f'the {self.quantity} of joint {self.joint!r} would be {self.value:.6g} {unit} at '
            f't = {self.time:.6g} s, past its limit of {self.limit:.6g} {unit}'
        )

    @property
    def parameters(self) -> str:
        """The configuration parameters that set this limit."""
        if self.quantity == 'position':
            return POSITIONS
        return f'limits.{self.quantity}'


class MotionError(BlfDscError):
    """No motion keeps the limits; `violation` is that of the best motion found."""

    def __init__(self, message: str, violation: Violation | None = None) -> None:
        self.violation = violation
        super().__init__(message)


def check_times(begin: float, end: float) -> np.ndarray:
    """Return times from `begin` to `end` [s], dense enough for peak velocities."""
    count = 1 + (end - begin) / _PERIOD
    return np.linspace(begin, end, int(min(max(_FEWEST_CHECKED, count), _MOST_CHECKED)))


def worst_violation(
    vector: np.ndarray, times: np.ndarray, config: ControllerConfig
) -> Violation | None:
    """Return the largest violation by a packed reference at times (k,) [s], or None."""
    qr, dqr, ddqr = sampled(vector, times).transpose(1, 0, 2)
    limits = config.limits
    lower, upper = np.array((limits.position_lower, limits.position_upper))
    middle = 0.5 * (upper + lower)
    reach = 0.5 * (upper - lower)
    worst = None
    for quantity, value, allowed in (
        ('position', qr - middle, reach),
        ('velocity', dqr, np.array(limits.velocity)),
        ('acceleration', ddqr, np.array(limits.acceleration)),
    ):
        ratios = np.abs(value) / allowed
        at, i = np.unravel_index(np.argmax(ratios), ratios.shape)
        ratio = float(ratios[at, i])
        if ratio <= 1.0 + _ROUNDING or (worst is not None and ratio <= worst.ratio):
            continue
        shift = float(middle[i]) if quantity == 'position' else 0.0
        reached = float(value[at, i])
        limit = shift + float(np.copysign(allowed[i], reached))
        time = float(times[at])
        worst = Violation(
            config.joints[i],
            quantity,
            shift + reached,
            limit,
            time,
            ratio,
            config.units[i],
        )
    return worst


def positions_past_limits(
    points: np.ndarray, first: int, config: ControllerConfig
) -> str:
    """Return the joints that positions (k, n) [rad] would hold past their limits.

    Each with the first such point, and its limit; empty if there are none. The points
    are numbered from `first` on.
    """
    limits = np.array((config.limits.position_lower, config.limits.position_upper))
    room = 0.5 * _ROUNDING * (limits[1] - limits[0])
    past = (points < limits[0] - room) | (points > limits[1] + room)
    found = []
    for i in np.flatnonzero(past.any(axis=0)):
        k = int(np.argmax(past[:, i]))
        limit = limits[int(points[k, i] > limits[1, i]), i]
        unit = config.units[i].position
        found.append(
            f'point {first + k} has joint {config.joints[i]!r} at {points[k, i]:.6g} {unit}, '
            f'past its limit of {limit:.6g} {unit}'
        )
    return '; '.join(found)


class BlendedReference(NamedTuple):
    """A packed reference, and the time [s] at which its last blend ends."""

    vector: np.ndarray
    settled: float


def hold(position: np.ndarray) -> Term:
    """Return the term that stays at `position` (n,) [rad]."""
    return ending_at_rest(np.zeros(1), np.zeros((0, len(position), 6)), position)


def braking_time(dq: np.ndarray, config: ControllerConfig) -> float:
    """Return the time [s] to rest from dq (n,) [rad/s], with half of the limits."""
    return max(
        _SHORTEST, float(np.max(_BRAKE * np.abs(dq) / config.limits.acceleration))
    )


def stop(t0: float, q: np.ndarray, dq: np.ndarray, config: ControllerConfig) -> Term:
    """Return the term that comes to rest from q (n,) [rad], dq (n,) [rad/s] at t0."""
    h = braking_time(dq, config)
    points = np.zeros((3, 2, q.size))
    points[0] = q, q + 0.5 * h * dq
    points[1, 0] = dq
    return hermite(np.array([t0, t0 + h]), points)


def blend(
    before: Sequence[Term],
    target: Term,
    t0: float,
    config: ControllerConfig,
    longest: float = inf,
) -> BlendedReference:
    """Blend from `before` to `target`, starting at t0 [s], as fast as the limits allow.

    Raises:
        MotionError: `target` within `_LONGEST`, or every blend within that and `longest` [s],
            violates a limit.
    """
    n = len(config.joints)
    longest = min(longest, _LONGEST)
    found = worst_violation(pack(n, [target]), check_times(t0, t0 + _LONGEST), config)
    if found is not None:
        raise MotionError(
            f'the reference exceeds the limits of the arm: {found}; reduce the motion, or relax '
            f'{found.parameters}',
            found,
        )

    def attempt(duration: float) -> np.ndarray:
        return pack(n, [*before, target._replace(begin=t0, fade=duration)])

    def violation(duration: float) -> Violation | None:
        return worst_violation(
            attempt(duration), check_times(t0, t0 + duration), config
        )

    too_short, duration = 0.0, min(_SHORTEST, longest)
    while (found := violation(duration)) is not None:
        if duration >= longest:
            raise MotionError(
                f'no motion of at most {longest:g} s from here to the reference stays '
                f'within the limits of the arm: in the longest one, {found}; start closer and '
                f'at rest, or relax {found.parameters}',
                found,
            )
        too_short = duration
        duration = min(duration * _STEP, longest)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (too_short + duration)
        if violation(middle) is None:
            duration = middle
        else:
            too_short = middle
    return BlendedReference(attempt(duration), t0 + duration)


def reference_of(config: ControllerConfig) -> np.ndarray:
    """Pack the configured reference; `hold` is at reference.offset at first."""
    reference = config.reference
    if reference.type == 'hold':
        term = hold(np.array(reference.offset))
    elif reference.type == 'waypoints':
        points = reference.rows(len(config.joints))
        term = minimum_jerk(np.array(reference.times), points)
    else:
        term = sinusoids_term(
            reference.offset, reference.amplitude, reference.frequency, reference.phase
        )
    return pack(len(config.joints), [term])


def end_of_waypoints(config: ControllerConfig) -> str:
    """Return where configured waypoints end, in words; empty for another reference."""
    reference = config.reference
    if reference.type != 'waypoints':
        return ''
    last = reference.rows(len(config.joints))[-1]
    posture = ', '.join(
        f'{joint} {value:g} {unit}'
        for joint, value, (unit, _, _) in zip(
            config.joints, last, config.units, strict=True
        )
    )
    return f'the waypoints end after {reference.times[-1]:g} s at {posture}'


def check_takeover(
    config: ControllerConfig,
    bound: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    reference_vector: np.ndarray,
    t: float = 0.0,
) -> None:
    """Check that the law can take over an arm at q, dq (n,) at time t [s].

    A velocity difference v increases the error |xi1| by v^2 / (2 a) until it is removed
    at the acceleration a of `limits`: the error must stay inside the bound k(t) (n,)
    [rad].

    Raises StartError if an error is already outside its bound, where the law is
    undefined, or if it would leave it.
    """
    qr, dqr, ddqr = np.zeros((3, q.size))
    evaluate(reference_vector, t, qr, dqr, ddqr)
    for joint, (unit, _, _), error, limit in zip(
        config.joints, config.units, q - qr, bound, strict=True
    ):
        if not abs(error) < limit:
            raise StartError(
                f'joint {joint!r} starts {error:+.6g} {unit} from the reference, outside its bound '
                f'of {limit:.6g} {unit}: start closer to the reference, or widen barrier.bound'
            )
    limits = np.sqrt(
        2.0 * np.array(config.limits.acceleration) * (bound - np.abs(q - qr))
    )
    for joint, (unit, _, _), difference, limit in zip(
        config.joints, config.units, dq - dqr, limits, strict=True
    ):
        if not abs(difference) < limit:
            raise StartError(
                f'joint {joint!r} starts {difference:+.6g} {unit}/s from the velocity of the '
                f'reference, but within its bound and limits.acceleration it can make up only '
                f'{limit:.6g} {unit}/s: start with the velocity of the reference'
            )


def _via_centre(
    begin: Sequence[Term], target: Term, t: float, config: ControllerConfig
) -> BlendedReference | None:
    """Plan an approach to fast sinusoids via rest at their centre, or None."""
    if config.reference.type != 'sinusoids':
        return None
    try:
        rest = blend(begin, hold(np.array(config.reference.offset)), t, config)
        motion = blend(unpack(rest.vector), target, rest.settled, config)
    except MotionError:
        return None
    return motion if motion.settled <= t + _LONGEST else None


def _check_limits(config: ControllerConfig, q: np.ndarray) -> None:
    """Check that an arm at rest at q (n,) [rad] is at most `PAST_LIMITS` past its limits."""
    limits = zip(
        config.joints,
        config.units,
        config.limits.position_lower,
        config.limits.position_upper,
        strict=True,
    )
    for at, (joint, units, lower, upper) in zip(q, limits, strict=True):
        if lower - PAST_LIMITS <= at <= upper + PAST_LIMITS:
            continue
        unit = units.position
        hint = hint_at_degrees(at, lower, upper) if units == TURNING else ''
        raise StartError(
            f'joint {joint!r} would be held at {at:.6g} {unit}, and its limits are {lower:g} to '
            f'{upper:g} {unit}: if the arm really is there, change limits.position_lower or '
            f'limits.position_upper{hint}'
        )


def plan_start(
    config: ControllerConfig,
    bound: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    t: float = 0.0,
    *,
    again: bool = False,
) -> BlendedReference:
    """Plan the configured reference, with an approach if it is needed.

    At time t [s], the arm is at q (n,) [rad] with dq (n,) [rad/s], and the bound is
    `bound` (n,) [rad].  Continuous joints go the short way (`turns`).  A law that starts
    `again` does so with a share of the acceleration, also from rest.

    Raises:
        StartError: the arm would be held far past its limits, or moves too fast to be held.
        MotionError: no approach keeps the limits.
    """
    if config.reference.type == 'hold':
        return _braked(config, q, dq, t)
    config, _ = reference_near(config, q)
    vector = reference_of(config)
    try:
        check_takeover(config, bound, q, dq, vector, t)
    except StartError:
        pass
    else:
        if _joins(config, dq, vector, t):
            return BlendedReference(vector, t)
    (target,) = unpack(vector)
    if again or np.abs(dq).max() > _MOVING:
        motion = _gently(config, q, dq, target, t)
        if motion is not None:
            return motion
    begin = [stop(t, q, dq, config)]
    try:
        return blend(begin, target, t, config)
    except MotionError:
        motion = _via_centre(begin, target, t, config)
        if motion is None:
            raise
        return motion


def plan_resumption(
    config: ControllerConfig,
    bound: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    reference_vector: np.ndarray,
    t: float,
) -> BlendedReference:
    """Plan the way back to a running reference, whose last motion goes on.

    Arguments as for `check_takeover`.

    Raises:
        StartError: the arm is too far from it.
        MotionError: no way back keeps the limits.
    """
    check_takeover(config, bound, q, dq, reference_vector, t)
    if _joins(config, dq, reference_vector, t):
        return BlendedReference(reference_vector, t)
    target = unpack(reference_vector)[-1]
    motion = _gently(config, q, dq, target, t)
    return motion or blend([stop(t, q, dq, config)], target, t, config)


def _gently(
    config: ControllerConfig, q: np.ndarray, dq: np.ndarray, target: Term, t: float
) -> BlendedReference | None:
    """Plan a motion to `target` with a share of the acceleration; None: there is no way."""
    limits = config.limits
    acceleration = tuple(_IN_MOTION * each for each in limits.acceleration)
    gentle = replace(config, limits=replace(limits, acceleration=acceleration))
    begin, rest = stop(t, q, dq, gentle), t + braking_time(dq, gentle)
    if worst_violation(pack(q.size, [begin]), check_times(t, rest), gentle) is not None:
        return None  # known at once: no blend with it keeps the limits
    try:
        return blend([begin], target, t, gentle, _LONGEST_IN_MOTION)
    except MotionError:
        return None


def _joins(
    config: ControllerConfig, dq: np.ndarray, reference_vector: np.ndarray, t: float
) -> bool:
    """Whether an arm with dq (n,) [rad/s] joins a reference at time t [s] without a blend.

    It does at the velocity of the reference.  From rest it does at any, if the drives
    permit the jump of the torque.
    """
    qr, dqr, ddqr = np.zeros((3, dq.size))
    evaluate(reference_vector, t, qr, dqr, ddqr)
    if np.abs(dq - dqr).max() <= AT_REST:
        return True
    is_limited = any(config.torque.rate_limit)
    return not is_limited and bool(np.abs(dq).max() <= AT_REST)


def _braked(
    config: ControllerConfig, q: np.ndarray, dq: np.ndarray, t: float
) -> BlendedReference:
    """Plan to hold the arm where it comes to rest from q, dq (n,) at time t [s]."""
    for joint, (unit, _, _), speed, limit in zip(
        config.joints, config.units, np.abs(dq), config.limits.velocity, strict=True
    ):
        if speed > limit + AT_REST:
            raise StartError(
                f'joint {joint!r} moves at {speed:.4g} {unit}/s, and its limit is {limit:g} '
                f'{unit}/s: wait until it is slower, or relax limits.velocity'
            )
    if np.abs(dq).max() <= AT_REST:  # what it may still have is noise
        _check_limits(config, q)
        return BlendedReference(pack(q.size, [hold(q)]), t)
    duration = braking_time(dq, config)
    _check_limits(config, q + 0.5 * duration * dq)
    return BlendedReference(pack(q.size, [stop(t, q, dq, config)]), t + duration)
