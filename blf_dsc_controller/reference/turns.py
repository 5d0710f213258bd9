# SPDX-License-Identifier: Apache-2.0
"""Angles that are the same posture of a joint that turns without end.

Planners and encoders give the angles of continuous joints in one turn, (-pi, pi] or [0,
2 pi).  A motion to such an angle would turn the joint back by nearly a whole turn where
it passes the end of that range.  So each angle is shifted by the whole turns that bring
it nearest to the one before: every motion goes the short way, by half a turn at most.
Where the limits leave less than a turn, only one of the angles is possible, and that is
taken.
"""

from __future__ import annotations

from dataclasses import replace
from math import tau

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig

Floats = NDArray[np.float64]


def turns_freely(config: ControllerConfig) -> NDArray[np.bool_]:
    """Return which joints (n,) turn without end: the continuous ones of a URDF."""
    kinds = config.robot.kinds(config.joints)
    return np.array([kind == 'continuous' for kind in kinds])


def short_way(
    positions: Floats, start: Floats, config: ControllerConfig
) -> tuple[Floats, str]:
    """Return positions (k, n) [rad] that follow each other from `start` (n,) by the short way.

    Also returns what was shifted, in words; empty if nothing was.
    """
    free = turns_freely(config)
    if not free.any():
        return positions, ''
    rises = np.diff(positions, axis=0, prepend=start[np.newaxis])
    turns = -np.cumsum(np.rint(rises / tau), axis=0)
    lower, upper = np.array(
        (config.limits.position_lower, config.limits.position_upper)
    )
    only = np.rint((0.5 * (lower + upper) - positions) / tau)
    turns = np.where(upper - lower < tau, only, turns) * free
    # not `positions + 0`, which is another zero than -0
    shifted = np.where(turns == 0.0, positions, positions + tau * turns)
    return shifted, _told(turns, config.joints)


def reference_near(config: ControllerConfig, q: Floats) -> tuple[ControllerConfig, str]:
    """Return a configuration whose reference begins nearest to q (n,) [rad].

    The second value is the sentence of `short_way` about it.
    """
    reference = config.reference
    if reference.type == 'hold':
        return config, ''
    if reference.type == 'waypoints':
        rows, told = short_way(reference.rows(q.size), q, config)
        given = replace(reference, waypoints=tuple(rows.ravel().tolist()))
    else:
        (offset,), told = short_way(np.array([reference.offset]), q, config)
        given = replace(reference, offset=tuple(offset.tolist()))
    return (replace(config, reference=given) if told else config), told


def _told(turns: Floats, joints: tuple[str, ...]) -> str:
    """Return which joints are shifted by how many turns (k, n), in words."""
    shifted = [
        f'{joint} by {", ".join(f"{count:+g}" for count in np.unique(column[column != 0.0]))}'
        for joint, column in zip(joints, turns.T, strict=True)
        if column.any()
    ]
    if not shifted:
        return ''
    return (
        f'goes the short way, shifted by whole turns: {"; ".join(shifted)} (a continuous '
        'joint turns without end)'
    )
