# SPDX-License-Identifier: Apache-2.0
"""Reader of a bag as one run: decoded, joints matched by name, samples by stamp."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.bags.topic_messages import JointStates
from blf_dsc_controller.bags.torque import TorqueError, applied_torque, next_effort
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import Event, EventType, decode
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.run import Floats, LearnedArm, Run, Series, Stop


def read_run(path: str | Path, namespace: str = '', names: NameMap = NO_NAMES) -> Run:
    """Read the run of a bag; `namespace` selects one of several robots, `names` maps its names.

    Raises:
        BagError: there is no bag, it is damaged, it holds no joint states, or the topics of several
            robots.
        UnreadableMessageError: a message in it cannot be decoded.
    """
    content = read_content(Path(path), namespace, names)
    joints = _joints(content, names)
    theirs = names.joints_of(joints)
    content = content.of_joints(theirs)
    states = content.topics[topics.JOINT_STATES].joint_states(theirs, ('position',)).by_stamp()
    errors = _decode(content, topics.TRACKING_ERROR, joints)
    references = _decode(content, topics.REFERENCE, joints)
    bounds = _decode(content, topics.BOUND, joints)
    events = list(_events(content))
    learning = _vector(content, topics.LEARNING)
    reference = None if references is None else references.position.exact(states.stamp)
    error = None if errors is None else errors.position.exact(states.stamp)
    if error is None and reference is not None:
        error = states.values[:, 0] - reference
    elif error is not None and reference is not None and _is_decimated(events):
        reference = np.where(np.isnan(reference), states.values[:, 0] - error, reference)
    return Run(
        joints=joints,
        stamp=states.stamp,
        received=states.received,
        position=states.values[:, 0],
        velocity=states.values[:, 1],
        torque=_torque(content, states),
        reference=reference,
        error=error,
        bound=None if bounds is None else bounds.position.held(states.stamp),
        torque_limit=None if bounds is None else bounds.effort.held(states.stamp),
        learning=learning,
        truth=_vector(content, topics.TRUTH),
        timing=_vector(content, topics.TIMING),
        monitor=_vector(content, topics.MONITOR),
        message_counts=content.message_counts,
        rejected=_rejected_columns(content, learning, namespace),
        stops=tuple(_stops(events, int(states.stamp[0]))),
        arm=_arm(Path(path)),
        learns=_learns(events),
        effort=states.values[:, 2],
        reference_velocity=None if references is None else references.velocity.exact(states.stamp),
        xi2=None if errors is None else errors.velocity.exact(states.stamp),
    )


def _joints(content: Content, names: NameMap) -> tuple[str, ...]:
    """Return the controller's joints in its order; without it, those of `names`, or all."""
    sources = (topics.TRACKING_ERROR, topics.REFERENCE, topics.BOUND)
    of_controller = [content.topics[one] for one in sources if one in content.topics]
    if not of_controller and names.joints:
        return tuple(names.joints)
    return (*of_controller, content.topics[topics.JOINT_STATES])[0].joint_names()


def _decode(content: Content, topic: topics.Topic, joints: Sequence[str]) -> JointStates | None:
    """Decode a topic's messages of these joints, by stamp; None if there are none."""
    messages = content.topics.get(topic)
    return None if messages is None else messages.joint_states(joints, ('position',)).by_stamp()


def _vector(content: Content, topic: topics.Topic) -> Series | None:
    messages = content.topics.get(topic)
    return None if messages is None else messages.vectors()


def _torque(content: Content, states: JointStates) -> Floats:
    try:
        return applied_torque(content, states)[0]
    except TorqueError:
        return next_effort(states)


def _rejected_columns(content: Content, learning: Series | None, namespace: str) -> dict[str, str]:
    """Return columns that are NaN at the end of learning, with the reason in /diagnostics."""
    if learning is None:
        return {}
    last = dict(zip(learning.names, learning.values[-1], strict=True))
    columns = [
        name for name, value in last.items() if name != topics.COMPUTE_TIME and np.isnan(value)
    ]
    reasons: dict[str, str] = {}
    diagnostics = content.topics.get(topics.DIAGNOSTICS)
    for raw in reversed(diagnostics.raw if columns and diagnostics is not None else []):
        message: Any = typestore().deserialize_cdr(raw, topics.DIAGNOSTICS.type)
        reasons = {
            pair.key.removeprefix(topics.REJECTED): pair.value
            for status in message.status
            if status.name.startswith(namespace.strip('/'))
            for pair in status.values
            if pair.key.startswith(topics.REJECTED)
        }
        if reasons:
            break
    return {column: reasons.get(column, '') for column in columns}


def _events(content: Content) -> Iterator[Event]:
    """Yield the events of the journal, without messages of other nodes' topics of that name."""
    journal = content.topics.get(topics.JOURNAL)
    for raw in journal.raw if journal is not None else ():
        with suppress(BlfDscError):
            yield decode(raw)


def _arm(path: Path) -> LearnedArm | None:
    """Return the arm of the recorded configuration; None unless its URDF can still be read."""
    context = read_context(path)
    if context.facts.get('model') == 'urdf':
        from blf_dsc_controller.messages.samples import learned_arm  # slow: compiles

        with suppress(BlfDscError):
            return learned_arm(context.controller_config())
    return None


def _stops(events: Iterable[Event], first: int) -> Iterator[Stop]:
    """Yield the stops in the journal; one before the first state gets that state's stamp [ns]."""
    ordered = list(events)
    for k, event in enumerate(ordered):
        if event.type is EventType.STOP:
            starts = [one.stamp for one in ordered[k:] if one.type is EventType.START]
            what = event.content['reason'], event.content['text']
            yield Stop(max(event.stamp, first), *what, until=starts[0] if starts else None)


def _is_decimated(events: Iterable[Event]) -> bool:
    """Return whether the reference was published for some samples only."""
    known = (event.content.get('parameters', {}) for event in events)
    return any(one.get('telemetry.decimation', 1) > 1 for one in known)


def _learns(events: Iterable[Event]) -> bool:
    """Return whether the law ever used the prediction error; true if the journal does not say."""
    known = [event.content.get('parameters', {}) for event in events]
    laws = {one['law'] for one in known if 'law' in one}
    weights = [one['learning.weight'] for one in known if 'learning.weight' in one]
    return laws <= {'blf_dsc'} and any(weights or [1.0])
