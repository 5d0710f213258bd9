# SPDX-License-Identifier: Apache-2.0
"""Parameters that were changed while the controller ran, as the bag tells of them.

What changed stands in /parameter_events; when it came into force, in the stamp of the bound that
the controller publishes with each change: that of the last state answered with the old parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from blf_dsc_controller.bags.batch import decode_joint_states
from blf_dsc_controller.bags.content import Content, Recorded
from blf_dsc_controller.bags.run import Stamps
from blf_dsc_controller.bags.topics import BOUND, PARAMETER_EVENTS, REFERENCE
from blf_dsc_controller.bags.types import typestore
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change, parameters
from blf_dsc_controller.replay.law import Change

_FIELDS = {
    1: 'bool_value',
    2: 'integer_value',
    3: 'double_value',
    4: 'string_value',
    8: 'double_array_value',
    9: 'string_array_value',
}


def changes_of(
    content: Content, config: ControllerConfig, known_at: int, node: str, end: int
) -> tuple[ControllerConfig, list[Change], str]:
    """Configuration at the start, what changed later, and in words what cannot be told.

    Args:
        content: of the bag.
        config: as recorded.
        known_at: when it was recorded [ns]; earlier changes are in it.
        node: full name of the controller.
        end: stamp [ns] up to which changes count.

    Raises:
        ConfigurationError: a change that this version does not accept.
    """
    bounds = content.topics.get(BOUND)
    begin = bounds.received[0] if bounds is not None else 0
    stamps = [] if bounds is None else [one for one in _told_again(bounds, config) if one < end]
    ended = None if bounds is None else _received_from(bounds, end)
    later: list[ControllerConfig] = []
    for received, values in _events(content, node):
        if received <= known_at or (ended is not None and received >= ended):
            continue
        config_after = change(later[-1] if later else config, values)
        if received < begin:
            config = config_after
        else:
            later.append(config_after)
    if len(stamps) != len(later):
        problem = (
            f'{len(stamps)} changes of parameters took effect, but the bag tells what changed in '
            f'{len(later)}: the replay goes on with the first configuration'
        )
        return config, [], problem
    return config, [Change(*one) for one in zip(stamps, later, strict=True)], ''


def restarts(content: Content, config: ControllerConfig, start: int) -> Stamps:
    """Stamps [ns] of the states at which the controller began again, after the first at `start`.

    It tells its bound then as well, and its reference is back where it was.
    """
    bounds, references = content.topics.get(BOUND), content.topics.get(REFERENCE)
    if bounds is None or references is None or len(bounds.raw) < 2:
        return np.empty(0, dtype=np.int64)
    stamp, values = decode_joint_states(references, config.joints, ())
    values = values[:, :2].reshape(stamp.size, -1)
    first = values[np.searchsorted(stamp, start)]
    back = stamp[(values == first).all(axis=1) & (stamp > start)]
    return np.intersect1d(back, decode_joint_states(bounds, (), ())[0])


def _told_again(bounds: Recorded, config: ControllerConfig) -> list[int]:
    """Stamps [ns] of the bounds that were told for a change of parameters.

    A bound that narrows is told with every sample, too: what tells a change then has the stamp, or
    the value, of the message before it.
    """
    stamp, values = decode_joint_states(bounds, config.joints, ('position',))
    told_again = np.ones(stamp.size - 1, dtype=np.bool_)
    if config.barrier.widest != config.barrier.bound:
        same = (values[1:, 0] == values[:-1, 0]).all(axis=1)
        told_again = same | (stamp[1:] == stamp[:-1])
    changed: list[int] = stamp[1:][told_again].tolist()
    return changed


def _received_from(bounds: Recorded, end: int) -> int | None:
    """When the first bound of a stamp from `end` on came [ns]; None if there is none."""
    stamp, _ = decode_joint_states(bounds, (), ())
    late = [at for at, one in zip(bounds.received, stamp.tolist(), strict=True) if one >= end]
    return late[0] if late else None


def _events(content: Content, node: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """When it came and new values, of each change of the controller's own parameters."""
    own = {one.name for one in parameters(ControllerConfig)}
    recorded = content.topics.get(PARAMETER_EVENTS)
    if recorded is None:
        return
    for received, raw in zip(recorded.received, recorded.raw, strict=True):
        event: Any = typestore().deserialize_cdr(raw, PARAMETER_EVENTS.type)
        if event.node != node:
            continue
        values = {
            one.name: _value(one.value) for one in event.changed_parameters if one.name in own
        }
        if values:
            yield received, values


def _value(told: Any) -> Any:
    value = getattr(told, _FIELDS[told.type])
    return value.tolist() if hasattr(value, 'tolist') else value
