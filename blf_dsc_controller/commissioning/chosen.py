# SPDX-License-Identifier: Apache-2.0
"""The configuration that follows from chosen gains, and the bounds that they can keep."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.arms.tuning import defaults_of
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
from blf_dsc_controller.warnings.expected_errors import expected_errors

Floats = NDArray[np.float64]

INTEGRAL = 'disturbance.gain'
"""It is always that of the joints, whatever a file gives."""

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
    before = defaults_of(arm)
    of_arm = {
        name: value
        for name, value in values.items()
        if name.startswith(('robot.', 'feedback.joint_'))
    }
    known, _ = design_of(change(config, {**of_arm, 'feedback.stiffness': 1.0}))
    present = flatten(config)
    followed = {
        name: value
        for name, value in defaults_of(known).items()
        if name == INTEGRAL or (name in present and present[name] == before[name])
    }
    if config.barrier.bounds_tool:  # from which those of the joints follow
        followed.pop('barrier.bound', None)
    return change(config, {**followed, **values})


def _follow_from_tool(config: ControllerConfig) -> bool:
    """Whether the bounds of the joints are those that follow from one at the tool."""
    barrier = config.barrier
    return barrier.bounds_tool and barrier.bound == _bounds_of_tool(config)


def _bounds_of_tool(config: ControllerConfig) -> tuple[float, ...]:
    """Return the bounds (n,) [rad] of the joints that follow from one at the tool."""
    arm, _ = design_of(config)
    bounds = joint_bounds(flatten(config), config.robot, arm)
    return config.barrier.bound if bounds is None else bounds


def capped_stop_damping(config: ControllerConfig, damping: Floats) -> dict[str, Value]:
    """Return the damping of a stop, by dotted name: as usual, but at most `damping` (n,).

    That is the damping of the joints, which has the margin; the usual one may exceed it, by the
    measured inertia.  Empty, if the configuration gives the damping of a stop.
    """
    arm, _ = design_of(config)
    usual = defaults_of(arm)['safety.damping']
    if config.safety.damping != usual:
        return {}
    return {'safety.damping': tuple(np.minimum(usual, damping).tolist())}


def widened_bounds(config: ControllerConfig) -> dict[str, Value]:
    """Return bounds that are wide enough for the errors to expect, by dotted name; empty: all are.

    Friction may act while a load is picked up, so the errors of both add.  Where the bounds of
    the joints follow from a bound at the tool, that one is widened.

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
    return {'barrier.bound': tuple(wide.tolist())}


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
            error = f'up to {needed / _EXCESS:.2g} {unit}'
            if np.isinf(needed):
                error = 'unlimited'
            raise BlfDscError(
                f'the gains that have the margin are too soft for any bound: the error of {joint} '
                f'would be {error}. {_SOFT[0].upper()}{_SOFT[1:]}'
            )
