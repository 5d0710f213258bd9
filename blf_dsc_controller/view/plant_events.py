# SPDX-License-Identifier: Apache-2.0
"""The events of a simulated arm, by its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

_MOST_PLANNED = 1000  # events of a plant


def plant_events(values: Mapping[str, Any]) -> list[tuple[float, str, str]]:
    """Return time [s], kind and text of a simulated arm's events."""
    begin, duration, masses = (
        _numbers(values.get(f'events.{name}'))
        for name in ('begin', 'duration', 'payload')
    )
    nothing = (0.0,) * len(begin)
    duration, masses = duration or nothing, masses or nothing
    found = []
    for k, (at, lasts, mass) in enumerate(
        zip(begin, duration, masses, strict=False), 1
    ):
        texts = (f'{mass:g} kg picked up', f'{mass:g} kg put down')
        first, last = texts if mass else (f'event {k} begins', f'event {k} ends')
        found.append((at, 'plant', first))
        found += [(at + lasts, 'plant', last)] if lasts else []
    return sorted(found)


def _numbers(given: Any) -> tuple[float, ...]:
    """Return a list of finite numbers; empty if it is none, or too long to be shown."""
    is_list = isinstance(given, (list, tuple)) and len(given) <= _MOST_PLANNED
    is_known = is_list and all(
        isinstance(each, (int, float)) and isfinite(each) for each in given
    )
    return tuple(map(float, given)) if is_known else ()
