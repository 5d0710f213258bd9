# SPDX-License-Identifier: Apache-2.0
"""Reader of a bag as one run: decoded, joints matched by name, samples by stamp."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.bags.columns import ALL, Rows
from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import JointStates
from blf_dsc_controller.bags.torque import TorqueError, applied_torque, next_effort
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.messages.topics import CONTROLLER
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.run import Floats, LearnedArm, Run, Series, Stop

_MOST_FALLS = 10  # of the stamps, by resets of a simulator
_ALTERNATING = 0.9  # ratio of the intervals to and from the state of another publisher
_FEW = 100  # states


class RecordedRun(Run):
    """Run whose arrays are read from its bag's tables each time that they are asked for."""

    def __init__(self, known: dict[str, Any], computed: dict[str, Callable[[Rows], Any]]) -> None:
        """Take what is in memory, and functions that return rows of the other arrays."""
        for name, value in known.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, '_computed', computed)

    def __getattribute__(self, name: str) -> Any:
        computed = object.__getattribute__(self, '__dict__').get('_computed', {})
        return computed[name](ALL) if name in computed else object.__getattribute__(self, name)

    def at(self, name: str, rows: Rows) -> Floats | None:
        """Return some rows of an array; None if it is unknown."""
        values: Floats | None = self.__dict__['_computed'][name](rows)
        return values

    def in_memory(self) -> Run:
        """Return the run with all of its arrays in memory."""
        values = {field.name: getattr(self, field.name) for field in fields(Run)}
        for name, value in values.items():
            if isinstance(value, Series):
                values[name] = Series(value.names, value.stamp, value.values)
        return Run(**values)


def read_run(path: str | Path, namespace: str = '', names: NameMap = NO_NAMES) -> Run:
    """Read the run of a bag into memory.

    `namespace` selects one of several robots, `names` maps its names.

    Raises:
        BagError: there is no bag, it is damaged, it holds no joint states, the topics of several
            robots, or the states of several runs.
        UnreadableMessageError: a message in it cannot be decoded.
    """
    return recorded_run(read_content(Path(path), namespace, names), names, namespace).in_memory()


def recorded_run(content: Content, names: NameMap = NO_NAMES, namespace: str = '') -> RecordedRun:
    """Return the run of a bag; errors as for `read_run`."""
    joints = _joints(content, names)
    states, notes, span = one_run(content, names.joints_of(joints))
    stamp = states.stamp
    within = partial(_within, content, span)
    errors = within(topics.TRACKING_ERROR, joints)
    references, bounds = within(topics.REFERENCE, joints), within(topics.BOUND, joints)
    events = [one for at, one in content.events if span[0] <= at < span[1]]
    learning = _series(within(topics.LEARNING))
    try:
        torque = applied_torque(content, states)
    except TorqueError:
        torque = next_effort(states)

    def exact(found: JointStates | None, k: int, rows: Rows) -> Floats | None:
        return None if found is None else found.series(k).exact(stamp[rows])

    def held(k: int, rows: Rows) -> Floats | None:
        return None if bounds is None else bounds.series(k).held(stamp[rows])

    def error(rows: Rows) -> Floats | None:
        if errors is None and references is not None:
            return np.asarray(states.field(0, rows) - references.series(0).exact(stamp[rows]))
        return exact(errors, 0, rows)

    def reference(rows: Rows) -> Floats | None:
        found, off = exact(references, 0, rows), exact(errors, 0, rows)
        if found is not None and off is not None and _is_decimated(events):
            found = np.where(np.isnan(found), states.field(0, rows) - off, found)
        return found

    return RecordedRun(
        {
            'joints': joints,
            'stamp': stamp,
            'received': states.received,
            'learning': learning,
            'truth': _series(within(topics.TRUTH)),
            'timing': _series(within(topics.TIMING)),
            'monitor': _series(within(topics.MONITOR)),
            'message_counts': content.message_counts,
            'rejected': _rejected_columns(content, learning, namespace),
            'stops': tuple(_stops(events, int(stamp[0]))),
            'arm': _arm(content),
            'learns': _learns(events),
            'notes': notes,
        },
        {
            'position': partial(states.field, 0),
            'velocity': partial(states.field, 1),
            'effort': partial(states.field, 2),
            'torque': torque.at,
            'error': error,
            'reference': reference,
            'xi2': partial(exact, errors, 1),
            'reference_velocity': partial(exact, references, 1),
            'bound': partial(held, 0),
            'torque_limit': partial(held, 2),
        },
    )


def one_run(
    content: Content, joints: Sequence[str], required: Sequence[str] = ('position',)
) -> tuple[JointStates, tuple[str, ...], tuple[int, int]]:
    """Return the states of one run of one arm, what is left out, and when it was received [ns].

    The stamps of the states increase. Where they fall, as when a simulator is reset, another run
    begins; the longest one is taken.

    Raises:
        BagError: all stamps are the same, or several publishers share the topic.
    """
    messages = content.topics[topics.JOINT_STATES]
    states = messages.joint_states(joints, required)
    stamp, received, notes = states.stamp, states.received, []
    if states.size > 1 and (stamp == stamp[0]).all():
        raise BagError(
            f'all {stamp.size} messages of {messages.name} have the stamp {stamp[0]} ns: each '
            'needs a unique stamp, so the driver has to set header.stamp'
        )
    if messages.size > states.size:
        count = messages.size - states.size
        notes.append(f'{count} of {messages.size} joint states left out: they name other joints')
    falls = np.flatnonzero(np.diff(stamp) < 0)
    if falls.size > _MOST_FALLS or _alternates(states):
        where = ''
        if falls.size:
            before, after = (stamp[falls[0] + k] * 1e-9 for k in (0, 1))
            where = f': its stamps fall {falls.size} times, the first time '
            where += f'from {before:.9g} s to {after:.9g} s'
        raise BagError(
            f'several publishers share {messages.name}, or its clock runs backwards{where}; '
            'record one arm for each topic'
        )
    begin, end = np.iinfo(np.int64).min, np.iinfo(np.int64).max
    if falls.size:
        edges = np.concatenate([[0], falls + 1, [states.size]])
        longest = int(np.argmax(np.diff(edges)))
        first, last = (int(edge) for edge in edges[longest : longest + 2])
        begin = int(received[first]) if first else begin
        end = int(received[last]) if last < states.size else end
        states = states.select(slice(first, last))
        notes.append(
            f'{stamp.size - states.size} of {stamp.size} joint states left out: their stamps fall '
            f'{falls.size} times, so that {falls.size + 1} runs are in the bag; run '
            f'{longest + 1}, the longest, is shown'
        )
        stamp = states.stamp
    repeated = int((np.diff(stamp) == 0).sum())
    if repeated:
        notes.append(f'{repeated} joint states left out: they repeat the stamp before')
    return states.by_stamp(), tuple(notes), (begin, end)


def _alternates(states: JointStates) -> bool:
    """Return whether the states come from two publishers in turn."""
    sequence = states.sequence
    if (np.diff(sequence) <= 0).sum() > _MOST_FALLS and sequence.any():
        return True
    intervals = np.diff(states.stamp)
    if intervals.size < _FEW:
        return False
    turns = sorted(float(np.median(intervals[k::2])) for k in (0, 1))
    return turns[0] < _ALTERNATING * turns[1]


def _joints(content: Content, names: NameMap) -> tuple[str, ...]:
    """Return the controller's joints in its order; without it, those of `names`, or all."""
    sources = (topics.TRACKING_ERROR, topics.REFERENCE, topics.BOUND)
    of_controller = [content.topics[topic] for topic in sources if topic in content.topics]
    if not of_controller and names.joints:
        return tuple(names.joints)
    return (*of_controller, content.topics[topics.JOINT_STATES])[0].joint_names()


def _within(
    content: Content, span: tuple[int, int], topic: topics.Topic, joints: Sequence[str] = ()
) -> JointStates | None:
    """Return a topic's messages received in a span, by stamp; None if there are none."""
    messages = content.topics.get(topic)
    if messages is None:
        return None
    found = messages.joint_states(joints or messages.joint_names(), ('position',))
    received = found.received
    rows = np.flatnonzero((received >= span[0]) & (received < span[1]))
    if rows.size < found.size:
        found = found.select(rows)
    return found.by_stamp() if rows.size else None


def _series(found: JointStates | None) -> Series | None:
    return None if found is None else found.series()


def _rejected_columns(content: Content, learning: Series | None, namespace: str) -> dict[str, str]:
    """Return columns that are NaN at the end of learning, with the reason in /diagnostics."""
    if learning is None:
        return {}
    values = learning.at(np.array([learning.stamp.size - 1]))[0]
    last = dict(zip(learning.names, values, strict=True))
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


def _arm(content: Content) -> LearnedArm | None:
    """Return the arm of the recorded configuration; None unless its URDF can still be read."""
    if content.configurations.get(CONTROLLER, {}).get('model') == 'urdf':
        from blf_dsc_controller.law.telemetry import learned_arm  # slow: compiles

        with suppress(BlfDscError):
            return learned_arm(content.controller_config())
    return None


def _stops(events: Iterable[Event], first: int) -> Iterator[Stop]:
    """Yield the stops in the journal; one before the first state gets that state's stamp [ns]."""
    ordered = list(events)
    for k, event in enumerate(ordered):
        if event.type is EventType.STOP:
            starts = [later.stamp for later in ordered[k:] if later.type is EventType.START]
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
