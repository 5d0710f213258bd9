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
from blf_dsc_controller.configuration.law_traits import GAINS, LAWS, OWN
from blf_dsc_controller.configuration.schema import format_value, parameters

RENAMED = {
    'feedback.damping': 'feedback.robust_gain',
    'learning.tell_drive': 'load.tell_drive',
    'learning.load_service': 'load.service',
    'learning.load_frame': 'load.frame',
    'learning.load_in_motion': 'load.in_motion',
}
"""Names of this version, by earlier ones with the same meaning."""

SWITCHES = (
    'learning.prediction',
    'learning.update',
    'learning.compensation',
    'learning.bumpless',
    'surface.known_rate',
)
"""Choices between `blf_dsc` and the paper that all laws had."""

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
    law = given.get('law', LAWS[0])
    for name in given:
        if is_comparison(name):
            found[name] = _of_comparison(name, law)
        elif name in SWITCHES:
            found[name] = _of_switch(name, law, given)
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
    """Return the name of this law's gain for one of `comparison.*` or `SWITCHES`.

    Empty: it has none.
    """
    gain = name.rpartition('.')[2]
    group = GAINS.get(law) if isinstance(law, str) else None
    has_it = group is not None and any(each.name == gain for each in parameters(group))
    return f'{GROUP}.{gain}' if has_it else ''


def _of_comparison(name: str, law: object) -> str:
    new = of_law(name, law)
    if new:
        return f'is called {new}, and belongs to the law {law}'
    return f'it has no effect on the law {law}: leave it out'


def chosen_by(law: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what `blf_dsc` does as gains of `law`, for the arm of given parameters."""
    usual = 'filtered', 'newton', 'reference', True, bool(given.get('robot.urdf'))
    choices = zip(SWITCHES, usual, strict=True)
    named = {of_law(name, law): value for name, value in choices}
    return {name: value for name, value in named.items() if name}


def is_usual(name: str, value: object, given: Mapping[str, Any]) -> bool:
    """Whether laws that lack a switch (of `SWITCHES`) do what its `value` asks for."""
    return bool(chosen_by('paper', given)[of_law(name, 'paper')] == value)


def _of_switch(name: str, law: object, given: Mapping[str, Any]) -> str:
    new = of_law(name, law)
    if new:
        return f'is called {new}, and belongs to the law {law}'
    if law not in OWN or is_usual(name, given[name], given):
        return f'the law {law} has no such choice: leave it out'
    gains = chosen_by('paper', given) | {
        of_law(each, 'paper'): given[each] for each in SWITCHES if each in given
    }
    listed = ', '.join(f'{gain}: {format_value(each)}' for gain, each in gains.items())
    return f'is a choice of the law paper: write law: paper, {listed}'


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
