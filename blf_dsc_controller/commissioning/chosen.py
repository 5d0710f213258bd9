# SPDX-License-Identifier: Apache-2.0
"""The configuration that follows from chosen gains, and the bounds that they can keep."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.arms.tuning import gains_of
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.configuration.plausibility import (
    widest_at_tool,
    widest_bound,
)
from blf_dsc_controller.configuration.schema import Value, change, flatten
from blf_dsc_controller.configuration.tool_bound import (
    ANGLE,
    POSITION,
    joint_bounds,
)
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.supervision.expected_errors import ENDLESS, expected_errors

Floats = NDArray[np.float64]

FOLLOWED = (
    'surface.gain',
    'surface.mu',
    'feedback.gain',
    'feedback.damping_rate',
    'barrier.weight',
    'barrier.slope_limit',
    'disturbance.gain',
)
"""Gains of the law that are always those of the joints, whatever a file gives."""

# with a bound at the tool, these follow from that one and not from gains
_BOUNDS = 'barrier.bound', 'barrier.initial_bound'

_SOFT = 'noise or friction hide the response: measure again with a larger --torque or --travel'

_EXCESS = 1.1  # of a bound over the errors to expect


def as_parameters(stiffness: ArrayLike, damping: ArrayLike) -> dict[str, Value]:
    """Return gains (n,) of the joints by dotted name; no factor makes them softer.

    `stiffness` is in N m/rad, `damping` in N m s/rad.
    """
    return {
        'feedback.joint_stiffness': tuple(np.asarray(stiffness).tolist()),
        'feedback.joint_damping': tuple(np.asarray(damping).tolist()),
        'feedback.stiffness': 1.0,
    }


def with_gains(
    config: ControllerConfig, values: Mapping[str, Value]
) -> ControllerConfig:
    """Return a configuration with values, and what follows from them, as if read from a file.

    `values` have `feedback.joint_stiffness` and `feedback.joint_damping`, and may have what was
    measured of the robot.  Bounds of joints that follow from one at the tool
    follow again.
    """
    changed = _with_gains(config, values)
    if 'barrier.bound' in values or not _follow_from_tool(config):
        return changed
    return _with_gains(config, {**values, 'barrier.bound': _bounds_of_tool(changed)})


def _with_gains(
    config: ControllerConfig, values: Mapping[str, Value]
) -> ControllerConfig:
    """Return a configuration with values, and what follows from them but for the bounds."""
    arm, _ = design_of(config)
    given = _given_bound(config)
    before = gains_of(arm, given)
    of_arm = {
        name: value
        for name, value in values.items()
        if name.startswith(('robot.', 'feedback.joint_'))
    }
    known, _ = design_of(change(config, {**of_arm, 'feedback.stiffness': 1.0}))
    if 'barrier.bound' in values:
        given = np.array(values['barrier.bound'], float)
    after = gains_of(known, given)
    present = flatten(config)
    by_tool = _BOUNDS if config.barrier.bounds_tool else ()
    followed = {
        name: value
        for name, value in after.items()
        if name in FOLLOWED
        or (name in present and present[name] == before[name] and name not in by_tool)
    }
    return change(config, {**followed, **values})


def _given_bound(config: ControllerConfig) -> Floats | None:
    """Return the bounds of the joints (n,) [rad]; None: those that follow from their gains."""
    bound = config.barrier.bound
    usual = gains_of(design_of(config)[0], None)['barrier.bound']
    return None if bound == usual else np.array(bound)


def _follow_from_tool(config: ControllerConfig) -> bool:
    """Whether the bounds of the joints are those that follow from one at the tool."""
    barrier = config.barrier
    return barrier.bounds_tool and barrier.bound == _bounds_of_tool(config)


def _bounds_of_tool(config: ControllerConfig) -> tuple[float, ...]:
    """Return the bounds (n,) [rad] of the joints that follow from one at the tool."""
    arm, _ = design_of(config)
    bounds = joint_bounds(flatten(config), config.robot, arm.chain, arm.parameters)
    return config.barrier.bound if bounds is None else bounds


def capped_stop_damping(config: ControllerConfig, damping: Floats) -> dict[str, Value]:
    """Return the damping of a stop, by dotted name: as usual, but at most `damping` (n,).

    That is the damping of the joints, which has the margin; the usual one may exceed it, by the
    measured inertia.  Empty, if the configuration gives the damping of a stop.
    """
    arm, _ = design_of(config)
    usual = gains_of(arm, np.array(config.barrier.bound))['safety.damping']
    if config.safety.damping != usual:
        return {}
    return {'safety.damping': tuple(np.minimum(usual, damping).tolist())}


def widened_bounds(config: ControllerConfig) -> dict[str, Value]:
    """Return bounds that are wide enough for the errors to expect, by dotted name; empty: all are.

    Friction may act while a load is picked up, so the errors of both add.  Where the bounds of
    the joints follow from a bound at the tool, that one is widened.  A funnel that is given begins
    at these bounds at least; others follow.

    Raises BlfDscError if a joint or the tool would need a bound so wide that it bounds nothing, or
    if the bounds of the joints are given beside one at the tool, and are too narrow.
    """
    barrier = config.barrier
    errors = expected_errors(config, settings_of_config(config))
    least = _EXCESS * (errors.unmodelled + errors.pick_up)
    if (least <= barrier.bound).all():
        return {}
    _check_bound(config, least)
    if barrier.bounds_tool:
        return _widened_at_tool(config, least)
    wide = np.maximum(barrier.bound, [float(f'{each:.2g}') for each in least])
    values: dict[str, Value] = {'barrier.bound': tuple(wide.tolist())}
    arm, _ = design_of(config)
    usual = gains_of(arm, _given_bound(config))['barrier.initial_bound']
    if barrier.initial_bound != usual:
        starts = np.array(barrier.initial_bound)
        starts = np.where(starts > 0.0, np.maximum(starts, wide), 0.0)
        values['barrier.initial_bound'] = tuple(starts.tolist())
    return values


def _widened_at_tool(config: ControllerConfig, least: Floats) -> dict[str, Value]:
    """Return the bound at the tool from which bounds of the joints of `least` (n,) follow."""
    barrier = config.barrier
    over = least / barrier.bound
    if not _follow_from_tool(config):
        j = int(over.argmax())
        unit = config.units[j].position
        raise BlfDscError(
            f'barrier.bound: {config.joints[j]} would be off by up to {least[j] / _EXCESS:.2g} '
            f'{unit} with the gains that have the margin, past its bound of {barrier.bound[j]:g} '
            f'{unit}: drop barrier.bound, which then follows from that at the tool and is widened '
            'with it'
        )
    arm, _ = design_of(config)
    values: dict[str, Value] = {}
    for name, unit, bound, widest in zip(
        (POSITION, ANGLE),
        ('m', 'rad'),
        (barrier.tool_bound, barrier.tool_angle_bound),
        widest_at_tool(arm.chain),
        strict=True,
    ):
        wide = float(f'{bound * over.max():.2g}')
        if wide > max(bound, widest):
            raise BlfDscError(
                f'{name}: with the gains that have the margin it would be {wide:g} {unit}, '
                f'which bounds nothing: {_SOFT}'
            )
        if wide > bound:
            values[name] = wide
    return values


def _check_bound(config: ControllerConfig, least: Floats) -> None:
    """Raise BlfDscError if a joint needs a bound `least` (n,) [rad or m] that bounds nothing.

    That is half of its range or a quarter turn, unless the file gives a wider one.
    """
    limits, kinds = config.limits, config.robot.kinds(config.joints)
    widest = map(widest_bound, kinds, limits.position_lower, limits.position_upper)
    given = config.barrier.bound
    for joint, (unit, _, _), needed, most in zip(
        config.joints, config.units, least, np.maximum(given, [*widest]), strict=True
    ):
        if needed > most:
            far = f'by up to {needed / _EXCESS:.2g} {unit}'
            if needed > ENDLESS:
                far = 'without end'
            raise BlfDscError(
                f'the gains that have the margin are too soft for any bound: {joint} would be off '
                f'{far}. {_SOFT[0].upper()}{_SOFT[1:]}'
            )
