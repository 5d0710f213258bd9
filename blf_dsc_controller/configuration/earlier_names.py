# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller as earlier versions named them: what to write instead.

A file with such a name is refused with the remedy (`remedies`); a bag is read by the
names of this version (`bags.older_parameters`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from blf_dsc_controller.configuration.law_file import GROUP
from blf_dsc_controller.configuration.law_traits import GAINS, LAWS
from blf_dsc_controller.configuration.schema import format_value, parameters

RENAMED = {
    'feedback.damping': 'feedback.robust_gain',
    'learning.tell_drive': 'load.tell_drive',
    'learning.load_service': 'load.service',
    'learning.load_frame': 'load.frame',
    'learning.load_in_motion': 'load.in_motion',
}
"""Names of this version, by earlier ones with the same meaning."""

_COMPARISON = 'comparison.'
_REASONS = {
    'feedback.damping': ' (d2), since it damps nothing; the damping of a joint is '
    'feedback.joint_damping, or feedback.gain (K_p)',
}


def remedies(given: Mapping[str, Any]) -> Mapping[str, str]:
    """Return what to write instead of given parameters of earlier versions."""
    found = {
        name: f'is called {new}{_REASONS.get(name, "")}'
        for name, new in RENAMED.items()
        if name in given
    }
    for name in given:
        if is_comparison(name):
            found[name] = _of_comparison(name, given.get('law', LAWS[0]))
    if 'model' in given:
        found['model'] = (
            'follows from robot.urdf: give that, or nothing for the two links'
        )
    if 'reference.points' in given:
        found['reference.points'] = _of_points(given)
    return found


def is_comparison(name: str) -> bool:
    """Whether a parameter is one of `comparison.*`, which all laws had."""
    return name.startswith(_COMPARISON)


def of_law(name: str, law: object) -> str:
    """Return the name by which this law has a gain `comparison.NAME`; empty: it has none."""
    gain = name.removeprefix(_COMPARISON)
    group = GAINS.get(law) if isinstance(law, str) else None
    has_it = group is not None and any(each.name == gain for each in parameters(group))
    return f'{GROUP}.{gain}' if has_it else ''


def _of_comparison(name: str, law: object) -> str:
    new = of_law(name, law)
    if new:
        return f'is called {new}, and belongs to the law {law}'
    return f'it has no effect on the law {law}: leave it out'


def _of_points(given: Mapping[str, Any]) -> str:
    """Return the waypoints of given points."""
    points, times = (given.get(f'reference.{name}') for name in ('points', 'times'))
    remedy = 'write them as reference.waypoints' if points else 'leave it out'
    if isinstance(points, list | tuple) and isinstance(times, list | tuple):
        rows = by_point(points, len(times))
        remedy = f'write reference.waypoints: {format_value(rows)}' if rows else remedy
    return (
        'replaced by reference.waypoints, which has one row per point '
        f'as everywhere in ROS, and not one per joint: {remedy}'
    )


def by_point(points: Sequence[float], count: int) -> list[float]:
    """Return the rows of so many points, joint by joint, point by point.

    Empty if these are not as many in each row.
    """
    if count == 0 or len(points) % count:
        return []
    rows: list[float] = np.reshape(points, (-1, count)).T.ravel().tolist()
    return rows
