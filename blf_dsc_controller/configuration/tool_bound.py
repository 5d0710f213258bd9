# SPDX-License-Identifier: Apache-2.0
"""Joint bounds that follow from a bound at the tool.

They are k = lambda w, with the largest lambda for which the tool keeps its bound at every
posture.  w are the errors to expect of the joints, so all joints use about the same part of
their bounds, which leaves the most room.  A joint that hardly moves the tool, as the last one
whose axis goes through it, gets more than that: up to `_SPARE` of the bound if it were alone,
but not beyond `_MOST` times its share.

d is the torque that the model lacks: friction and the residual floor, or the rated payload.  It
includes the friction that a commissioning has measured, and the inertia that it did not see;
without one, what drives may have beyond a guess.
If gains follow from the inertia of the arm, w is in proportion to M^-1 d, with the weight of the
payload.  If each joint has a stiffness of its own, w is d over this stiffness, with the torque of
a payload that moves: a first joint bears no weight, but accelerates the load.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms import tuning
from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.model import inertia_matrices, regressors_at
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.controller_parameters import (
    ControllerParameters,
)
from blf_dsc_controller.configuration.motion_groups import PAST_LIMITS
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.numerics.algebra import inverse, product
from blf_dsc_controller.tool.errors import MOST_JOINTS, Tool

Floats = NDArray[np.float64]

POSITION = 'barrier.tool_bound'
ANGLE = 'barrier.tool_angle_bound'

_FRICTION, _UNSEEN = 'commissioning.friction', 'commissioning.unseen_inertia'

_POSTURES = 40
_REVERSAL = 0.75
"""Of Coulomb friction, an error of it: half of it too much at breakaway, with either sign."""

_SPARE = 0.05  # of the bound at the tool, by one joint alone
_MOST = 5.0  # times the share of a joint by its errors to expect

_MEAN = 0.5
"""Of the limit of acceleration, on average: an error of soft gains takes time to grow."""

_DOWN = 0.9995  # four digits of a joint bound round up by less
_FINEST = 1e-6  # rad, a sixth of a step of a 20 bit encoder
_ROUNDED = 1.0 + 1e-9


def at_reversal(known: Floats, measured: tuple[float, ...]) -> Floats:
    """Return the torque (n,) [N m] that friction may add at a reversal.

    The law compensates what is `known` (n,) [N m]; what was `measured` beyond it (n,), or nothing,
    has either sign.
    """
    friction = np.maximum(known, measured or 0.0)
    return np.asarray(_REVERSAL * (friction + 2.0 * (friction - known)))


def is_given(values: Mapping[str, Any]) -> bool:
    """Whether parameters by dotted name have a bound at the tool."""
    return any(values.get(name, 0.0) > 0.0 for name in (POSITION, ANGLE))


def tool_of(config: ControllerParameters) -> Tool | None:
    """Return the tool of a configuration; None without a bound on its error."""
    if not config.barrier.bounds_tool:
        return None
    limits = config.limits
    return _tool(
        config.robot.chain(config.joints), limits.position_lower, limits.position_upper
    )


def _tool(chain: Chain, lower: tuple[float, ...], upper: tuple[float, ...]) -> Tool:
    return Tool(chain, np.maximum(np.abs(lower), np.abs(upper)) + PAST_LIMITS)


def joint_bounds(
    values: Mapping[str, Any], robot: Robot, arm: tuning.Design
) -> tuple[float, ...] | None:
    """Return the joint bounds (n,) [rad] of parameters by dotted name, and what gains follow from.

    None if these do not fit the arm, as `ControllerConfig.problems` then says.
    """
    lower = tuple(values['limits.position_lower'])
    upper = tuple(values['limits.position_upper'])
    floor = tuple(values['learning.residual_floor'])
    chain = arm.chain
    coulomb = robot.friction(chain)['coulomb']
    n = len(chain.joints)
    seen = tuple(values.get(_FRICTION, ())) or (0.0,) * n
    unseen = tuple(values.get(_UNSEEN, ())) or tuple(robot.unknown_rotors(chain))
    lengths = {len(each) for each in (lower, upper, floor, coulomb, seen, unseen)}
    if lengths != {n} or n > MOST_JOINTS:
        return None
    region = _region(values, n) or (lower, upper)
    stiffness = _stiffness(arm)
    limits = values['limits.acceleration']
    acceleration = tuple(_MEAN * a for a in limits) if stiffness else (0.0,) * n
    unmodelled = floor + at_reversal(np.array(coulomb), seen)
    unmodelled += np.array(acceleration) * unseen
    expected = _expected(
        arm.parameters,
        tuning.initial_estimate(arm),
        robot.payload,
        tuple(unmodelled.tolist()),
        stiffness,
        acceleration,
        *region,
    )
    k = _scaled(
        _tool(chain, lower, upper),
        _levers(chain, lower, upper),
        np.array(expected),
        (values.get(POSITION, 0.0), values.get(ANGLE, 0.0)),
    )
    return tuple(float(f'{_DOWN * each:.4g}') for each in k.tolist())


def _stiffness(arm: tuning.Design) -> tuple[float, ...]:
    """Return the stiffness (n,) [N m/rad] of joints, each on its own; else empty."""
    if arm.joints is None:
        return ()
    gains = tuning.gains_of(arm)
    rate = np.array(gains.surface) / 2.0 + np.array(gains.mu)
    return tuple((np.array(gains.weight) + np.array(gains.feedback) * rate).tolist())


def _region(
    values: Mapping[str, Any], n: int
) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Return least and largest positions (n,) of sinusoids; None for other types."""
    if values['reference.type'] != 'sinusoids':
        return None
    offset = np.array(values['reference.offset'])
    amplitude = np.abs(values['reference.amplitude'])
    if offset.size != n or amplitude.size == 0 or amplitude.size % n:
        return None
    reach = amplitude.reshape(n, -1).sum(axis=1)
    return tuple((offset - reach).tolist()), tuple((offset + reach).tolist())


@lru_cache(maxsize=16)
def _levers(chain: Chain, lower: tuple[float, ...], upper: tuple[float, ...]) -> Floats:
    """Return what each joint alone moves the tool by (n, 2) [m/rad, rad/rad], at most."""
    tool = _tool(chain, lower, upper)
    return np.array([tool.everywhere(each) for each in np.eye(len(chain.joints))])


def _scaled(
    tool: Tool, levers: Floats, w: Floats, bounds: tuple[float, float]
) -> Floats:
    """Return joint bounds (n,) of w (n,) that keep the bounds [m, rad], 0 for none."""
    used = _used(tool.everywhere(w), bounds)
    if used == 0.0:  # no joint moves the tool
        return np.zeros_like(w)
    k = w / used
    alone = _used(k[:, np.newaxis] * levers, bounds)
    k *= np.clip(_SPARE / np.maximum(alone, _SPARE / _MOST), 1.0, _MOST)
    return np.asarray(k / _used(tool.everywhere(k), bounds))


def _used(errors: Floats, bounds: tuple[float, float]) -> Floats:
    """Return which part (...) of the bounds [m, rad], 0 for none, errors (..., 2) use."""
    given = np.array(bounds)
    shares = errors / np.where(given > 0.0, given, np.inf)
    return np.asarray(shares.max(axis=-1))


@lru_cache(maxsize=16)
def _expected(
    base: BaseParameters,
    P0: tuple[float, ...],
    payload: float,
    unmodelled: tuple[float, ...],
    stiffness: tuple[float, ...],
    acceleration: tuple[float, ...],
    lower: tuple[float, ...],
    upper: tuple[float, ...],
) -> tuple[float, ...]:
    """Return w (n,), the largest |M^-1 d|, or |d| over a stiffness, between two postures.

    `acceleration` (n,) [rad/s^2] is the largest with which the payload is moved.
    """
    n = len(unmodelled)
    random = np.random.default_rng(0)
    q = random.uniform(lower, np.maximum(lower, upper), (_POSTURES, n))
    load = payload * base.load
    zero = np.zeros_like(q)
    ddq = random.uniform(-1.0, 1.0, q.shape) * np.array(acceleration)
    weight = product(regressors_at(base.model, q, zero, zero, ddq), load[:, np.newaxis])
    friction = np.broadcast_to(np.array(unmodelled)[:, np.newaxis], weight.shape)
    found = np.zeros(n)
    for P, d in ((np.array(P0), friction), (np.array(P0) + load, weight)):
        if stiffness:
            pushed = d[..., 0] / np.array(stiffness)
        else:
            M = inertia_matrices(base.model, P, q)
            is_arm = np.linalg.eigvalsh(M)[:, 0] > 0.0
            pushed = product(inverse(M[is_arm]), d[is_arm])[..., 0]
        found += np.abs(pushed).max(axis=0, initial=0.0)
    even = found.max() == 0.0  # of no arm at all
    return tuple((np.ones(n) if even else found).tolist())


def certified(config: ControllerParameters) -> tuple[float, float]:
    """Return the bounds [m, rad] at the tool that the joint bounds ensure."""
    tool = tool_of(config)
    assert tool is not None  # noqa: S101 - the caller has looked
    position, angle = tool.everywhere(np.array(config.barrier.bound)).tolist()
    return position, angle


def problems(config: ControllerParameters) -> Iterator[str]:
    """Check that there is a tool, and that the joint bounds keep its bound."""
    barrier = config.barrier
    if not barrier.bounds_tool:
        return
    name = POSITION if barrier.tool_bound > 0.0 else ANGLE
    if config.model != 'urdf':
        yield (
            f'{name}: model {config.model} has no tool: give robot.urdf and robot.tip'
        )
        return
    if not config.robot.tip:
        yield f'{name}: give robot.tip, the link whose origin is the tool'
    if len(config.joints) > MOST_JOINTS:
        yield f'{name}: got {len(config.joints)} joints, but at most {MOST_JOINTS} are allowed'
        return
    if not config.traits.has_barrier:
        yield f'{name}: the law {config.law} keeps no bound: choose blf_dsc, or remove {name}'
    least = min(barrier.bound)
    if least == 0.0:
        yield f'{name}: no joint moves {config.robot.tip}, the tool: give another robot.tip'
    elif least < _FINEST:
        k = barrier.bound.index(least)
        unit = config.units[k].position
        yield (
            f'{name}: the joint bound of {config.joints[k]} would be {least:.2g} {unit}, finer '
            f'than any encoder: give at least {_FINEST / max(least, 1e-300):.2g} times this bound'
        )
    kept = certified(config)
    for name, unit, bound, tool in (
        (POSITION, 'm', barrier.tool_bound, kept[0]),
        (ANGLE, 'rad', barrier.tool_angle_bound, kept[1]),
    ):
        if 0.0 < bound * _ROUNDED < tool:
            yield (
                f'barrier.bound: these joint bounds keep the tool within {tool:.4g} {unit} only, '
                f'but {name} is {bound:g} {unit}: drop barrier.bound, which then follows from it, '
                f'or drop {name}'
            )
