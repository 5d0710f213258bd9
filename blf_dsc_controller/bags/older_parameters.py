# SPDX-License-Identifier: Apache-2.0
"""Rules that turn parameters recorded by an earlier release into those of this one.

A parameter that goes away leaves its last default in `REMOVED`: a bag that has this
value replays without it. `ADDED` has, for a new parameter, the value with which the law
does what it did before, unless that is its default.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.earlier_names import (
    RENAMED,
    SWITCHES,
    by_point,
    chosen_by,
    is_comparison,
    is_usual,
    of_law,
)
from blf_dsc_controller.configuration.law_traits import LAWS, OWN
from blf_dsc_controller.configuration.plausibility import CHECKED
from blf_dsc_controller.configuration.schema import (
    Value,
    format_value,
    parameters,
    unknown,
    variant_of,
)

REMOVED: dict[str, Value] = {}
"""Last default of each parameter of the first release that is gone now."""

_IGNORED = dict.fromkeys(
    ('backstepping', 'slotine_li'),
    ('learning.compensation', 'learning.bumpless', 'surface.known_rate'),
)
"""Those of `SWITCHES` that had no effect on a law."""

ADDED: dict[str, Value] = {
    'disturbance.observer_bandwidth': 0.0,
    'learning.load_friction': False,
    'safety.oscillation': 'ignore',
    'insist': CHECKED,
}
"""Value of parameters that older bags do not have, where it is not the default."""


def current(recorded: Mapping[str, Any], source: str, law: str = '') -> dict[str, Any]:
    """Return recorded parameters of a controller as those of this version.

    `law` is that of the controller whose parameters changed to these.

    Raises:
        BagError: one of them is gone, and no rule says that the law does the same without it.
    """
    recorded = renamed(recorded, law)
    known = known_names({**recorded, 'law': law} if law else recorded)
    problems = []
    for name, value in recorded.items():
        if name in known:
            continue
        if name not in REMOVED:
            problems.append(
                f'{unknown(name, known)}: this version cannot do without it'
            )
        elif not _is_same(value, REMOVED[name]):
            problems.append(
                f'{name}: recorded with {format_value(value)}, but this version only knows '
                f'{format_value(REMOVED[name])}'
            )
    if problems:
        listing = ''.join(f'\n  - {problem}' for problem in problems)
        raise BagError(
            f'{source} cannot be replayed by this version; use the one that recorded it:{listing}'
        )
    return {name: value for name, value in recorded.items() if name in known}


def renamed(recorded: Mapping[str, Any], law: str = '') -> dict[str, Any]:
    """Return recorded parameters of a controller by their names of this version.

    `law` is as in `current`. `reference.points` were waypoints joint by joint; gains of
    other laws than the recorded one, which had no effect, are left out, and so is a model
    that follows from the URDF. Choices between the law and the paper are those of the law
    `paper`, if they are not what `blf_dsc` does.
    """
    recorded = _with_law_of_choices(recorded, law)
    law = law or recorded.get('law', LAWS[0])
    names = {
        name: of_law(name, law) if is_comparison(name) else RENAMED.get(name, name)
        for name in recorded
    }
    values = {names[name]: value for name, value in recorded.items() if names[name]}
    if values.get('model') == ('urdf' if values.get('robot.urdf') else 'two_link'):
        del values['model']
    points = values.get('reference.points')
    times = values.get('reference.times', ())
    if points is not None and (not points or by_point(points, len(times))):
        del values['reference.points']
        values['reference.waypoints'] = by_point(points, len(times))
    return values


def _with_law_of_choices(recorded: Mapping[str, Any], law: str) -> dict[str, Any]:
    """Return recorded parameters with the law and the gains that `SWITCHES` ask for.

    Switches are left out that ask for what the law does anyhow, or that had no effect on it.
    """
    choices = {name: recorded[name] for name in SWITCHES if name in recorded}
    values = {name: value for name, value in recorded.items() if name not in choices}
    if not choices:
        return values
    if not law:  # all parameters; a bag with some of these is older than the last
        choices.setdefault('surface.known_rate', False)
    unusual = [name for name in choices if not is_usual(name, choices[name], recorded)]
    running = law or recorded.get('law', LAWS[0])
    if unusual and not law and running in OWN:
        running = 'paper'
        values |= {'law': running, **chosen_by(running, recorded)}
    for name, value in choices.items():
        gain = of_law(name, running)
        if gain:
            values[gain] = value
        elif name in unusual and name not in _IGNORED.get(running, ()):
            values[name] = value  # nothing does so any more
    return values


def known_names(recorded: Mapping[str, Any]) -> set[str]:
    """Return the parameters of a controller, with those of a law of a file."""
    cls = variant_of(ControllerConfig, recorded)
    return {parameter.name for parameter in parameters(cls)}


def completed(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Return all parameters of a controller, with those added after the recording.

    The feedback of an arm from a URDF acted through its inertia matrix.
    """
    feedback = {'feedback.inertia': 'whole'} if recorded.get('robot.urdf') else {}
    return {**ADDED, **feedback, **recorded}


def _is_same(value: Any, default: Value) -> bool:
    """Return whether two values are the same; JSON has lists for tuples."""
    if isinstance(value, (list, tuple)) and isinstance(default, (list, tuple)):
        return list(value) == list(default)
    return bool(value == default)
