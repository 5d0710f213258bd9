# SPDX-License-Identifier: Apache-2.0
"""Parameters that were changed while the controller ran, as the bag tells of them.

What changed stands in /parameter_events; when it came into force, in the stamp of the bound that
the controller publishes with each change: that of the last state answered with the old parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from blf_dsc_controller.bags.batch import decode_joint_states
from blf_dsc_controller.bags.content import Content, TopicMessages
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change, parameters
from blf_dsc_controller.messages.topics import BOUND, FOREVER, PARAMETER_EVENTS, REFERENCE
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.replay.law import Change
from blf_dsc_controller.run import Stamps

_FIELDS = {
    1: 'bool_value',
    2: 'integer_value',
    3: 'double_value',
    4: 'string_value',
    8: 'double_array_value',
    9: 'string_array_value',
}


def changes_of(
    content: Content,
    config: ControllerConfig,
    known_at: int,
    node: str,
    end: int,
    until: int = FOREVER,
    told: Stamps | None = None,
    starts: Sequence[int] = (),
) -> tuple[ControllerConfig, list[Change], str]:
    """Configuration at the start, what changed later, and in words what cannot be told.

    Args:
        content: of the bag.
        config: as recorded.
        known_at: when it was recorded [ns]; earlier changes are in it.
        node: full name of the controller.
        end: stamp [ns] up to which changes count.
        until: when the recorder must have heard of them [ns].
        told: stamps of the states that the law answered [ns], in order; None if it is not known.
        starts: stamps [ns] behind which the controller began; its bound is then told anyway.

    Raises:
        ConfigurationError: a change that this version does not accept.
    """
    bounds = content.topics.get(BOUND)
    begin = bounds.received[0] if bounds is not None else 0
    again = [] if bounds is None else _told_again(bounds, config, told, starts)
    again = [one for one in again if one[0] < end and one[1] < until]
    ended = until if bounds is None else min(until, _received_from(bounds, end))
    later: list[ControllerConfig] = []
    for received, values in _events(content, node):
        if received <= known_at or received >= ended:
            continue
        config_after = change(later[-1] if later else config, values)
        if received < begin:
            config = config_after
        else:
            later.append(config_after)
    if len(again) != len(later):
        problem = (
            f'{len(again)} changes of parameters took effect, but the bag tells what changed in '
            f'{len(later)}: the replay goes on with the first configuration'
        )
        return config, [], problem
    changes = [Change(*moment, one) for moment, one in zip(again, later, strict=True)]
    return config, changes, ''


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


def _told_again(
    bounds: TopicMessages, config: ControllerConfig, told: Stamps | None, starts: Sequence[int]
) -> list[tuple[int, int]]:
    """Stamp [ns] of the bounds that were told for a change of parameters, and when they came [ns].

    Not of those that are told at a beginning, with the first state that was answered after each of
    `starts`.  A bound that narrows is told with every sample, too: what tells a change then has the
    stamp, or the value, of the message before it, or the stamp of a state that was not answered.
    """
    stamp, values = decode_joint_states(bounds, config.joints, ('position',))
    answered = stamp if told is None else told
    is_first = np.concatenate([[True], stamp[1:] != stamp[:-1]])
    first = np.searchsorted(answered, starts, side='right')
    begun = answered[first[first < answered.size]]
    told_again = ~(is_first & np.isin(stamp, begun))
    told_again[0] = False
    if config.barrier.widest != config.barrier.bound:
        same = (values[1:, 0] == values[:-1, 0]).all(axis=1)
        told_again[1:] &= same | (stamp[1:] == stamp[:-1]) | ~np.isin(stamp[1:], answered)
    return [(int(stamp[k]), bounds.received[k]) for k in np.flatnonzero(told_again)]


def _received_from(bounds: TopicMessages, end: int) -> int:
    """When the first bound of a stamp from `end` on came [ns]."""
    stamp, _ = decode_joint_states(bounds, (), ())
    late = [at for at, one in zip(bounds.received, stamp.tolist(), strict=True) if one >= end]
    return late[0] if late else FOREVER


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
