# SPDX-License-Identifier: Apache-2.0
"""The configuration that follows from chosen gains, and the bounds that they can keep."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import JointGains
from blf_dsc_controller.arms.tuning import gains_of
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.configuration.plausibility import widest_bound
from blf_dsc_controller.configuration.schema import Value, change, flatten
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.supervision.expected_errors import expected_errors

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

_ROOM = 1.1  # bound over the errors to expect


def with_gains(
    config: ControllerConfig, values: Mapping[str, Value]
) -> ControllerConfig:
    """Return a configuration with values, and what follows from them, as if read from a file.

    `values` have `feedback.joint_stiffness` and `feedback.joint_damping`, and may have
    `robot.lag` and `robot.rotor_inertia`.
    """
    names = 'feedback.joint_stiffness', 'feedback.joint_damping'
    gains = JointGains(*(np.array(values[name], float) for name in names))
    arm, _ = design_of(config)
    bound = np.array(values.get('barrier.bound', config.barrier.bound), float)
    before = gains_of(arm, np.array(config.barrier.bound))
    lag = float(np.asarray(values.get('robot.lag', arm.lag), float))
    rotors = np.array(values.get('robot.rotor_inertia', arm.rotors), float)
    follows = arm._replace(joints=gains, stiffness=1.0, lag=lag, rotors=rotors)
    after = gains_of(follows, bound)
    present = flatten(config)
    followed = {
        name: value
        for name, value in after.items()
        if name in FOLLOWED or (name in present and present[name] == before[name])
    }
    return change(config, {**followed, **values})


def kept_stop(config: ControllerConfig, damping: Floats) -> dict[str, Value]:
    """Return the damping of a stop by dotted name: as it is, but no more than `damping` (n,).

    Gains have a margin with that of the joints.  By the measured inertia it could be more.
    None, if the damping of a stop is given.
    """
    arm, _ = design_of(config)
    usual = gains_of(arm, np.array(config.barrier.bound))['safety.damping']
    if config.safety.damping != usual:
        return {}
    return {'safety.damping': tuple(np.minimum(usual, damping).tolist())}


def kept_bound(config: ControllerConfig) -> dict[str, Value]:
    """Return the bounds wide enough for the errors to expect, by dotted name.

    Friction may act while a load is picked up, so the errors of both add.  None, if the
    bounds of the joints follow from one at the tool.  Funnels that are given begin at these
    bounds at least; others follow.  Raises BlfDscError if a joint needs one that bounds
    nothing.
    """
    barrier = config.barrier
    if barrier.bounds_tool:
        return {}
    errors = expected_errors(config, settings_of_config(config))
    least = _ROOM * (errors.unmodelled + errors.pick_up)
    if (least <= barrier.bound).all():
        return {}
    _check_bound(config, least)
    wide = np.array([float(f'{each:.2g}') for each in np.maximum(barrier.bound, least)])
    values: dict[str, Value] = {'barrier.bound': tuple(wide.tolist())}
    arm, _ = design_of(config)
    usual = gains_of(arm, np.array(barrier.bound))['barrier.initial_bound']
    if barrier.initial_bound != usual:
        starts = np.array(barrier.initial_bound)
        starts = np.where(starts > 0.0, np.maximum(starts, wide), 0.0)
        values['barrier.initial_bound'] = tuple(starts.tolist())
    return values


def _check_bound(config: ControllerConfig, least: Floats) -> None:
    """Refuse errors to expect (n,) [rad or m] of half of a joint's range, or a quarter turn.

    One within a bound that the file gives and insists on may be so large.
    """
    limits, kinds = config.limits, config.robot.kinds(config.joints)
    widest = map(widest_bound, kinds, limits.position_lower, limits.position_upper)
    given = config.barrier.bound
    for joint, kind, needed, most in zip(
        config.joints, kinds, least, np.maximum(given, [*widest]), strict=True
    ):
        if needed > most:
            unit = 'm' if kind == 'prismatic' else 'rad'
            raise BlfDscError(
                f'the gains that have the margin are too soft for any bound: {joint} would be off '
                f'by up to {needed / _ROOM:.2g} {unit}. Noise or friction hide the response: '
                'measure again with a larger --torque or --travel'
            )
