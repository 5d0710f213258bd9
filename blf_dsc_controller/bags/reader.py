# SPDX-License-Identifier: Apache-2.0
"""Reader of a bag as one run: decoded, joints matched by name, samples by stamp."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import ALL, JointStates
from blf_dsc_controller.bags.torque import TorqueError, applied_torque, next_effort
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.messages.topics import CONTROLLER
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.run import Floats, LearnedArm, Rows, Run, Series, Stop

_MOST_FALLS = 10  # of the stamps, by resets of a simulator
_ALTERNATING = 0.9  # ratio of the intervals to and from the state of another publisher
_FEW = 100  # states


class RecordedRun(Run):
    """Run whose arrays are read from its bag's tables each time that they are asked for."""

    _stored: Mapping[str, tuple[JointStates | None, int]]
    _is_decimated: bool

    def __init__(self, **values: Any) -> None:
        """Take what is in memory, and in `_stored` states and field of each other array.

        `_is_decimated`: the reference was published for some samples only.
        """
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __getattribute__(self, name: str) -> Any:
        stored = object.__getattribute__(self, '__dict__').get('_stored', ())
        return self.at(name) if name in stored else object.__getattribute__(self, name)

    def at(self, name: str, rows: Rows = ALL, columns: Rows = ALL) -> Floats | None:
        """Return some rows and joints of an array; None if it is unknown."""
        states, k = self._stored[name]
        if states is None:
            is_known = name == 'error' and self._stored['reference'][0] is not None
            return self._difference('reference', rows, columns) if is_known else None
        values: Floats = states.field(k, rows, columns)
        if name == 'reference' and self._is_decimated:
            lost = np.isnan(values)
            values[lost] = self._difference('error', rows, columns)[lost]
        return values

    def _difference(self, name: str, rows: Rows, columns: Rows) -> Floats:
        """Return the positions less another array."""
        position, other = self.at('position', rows, columns), self.at(name, rows, columns)
        difference: Floats = np.asarray(position) - np.asarray(other)
        return difference

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

    def within(topic: topics.Topic, names: Sequence[str] = ()) -> JointStates | None:
        """Return a topic's messages in the run, by stamp; None if there are none."""
        messages = content.topics.get(topic)
        if messages is None:
            return None
        found = messages.joint_states(names or messages.joint_names(), ('position',))
        received = found.received
        inside = (received >= span[0]) & (received < span[1])
        return found.select(np.flatnonzero(inside)).by_stamp() if inside.any() else None

    def series(topic: topics.Topic) -> Series | None:
        found = within(topic)
        return None if found is None else found.series()

    errors, references = within(topics.TRACKING_ERROR, joints), within(topics.REFERENCE, joints)
    bounds = within(topics.BOUND, joints)
    exact_errors = None if errors is None else errors.at_stamps(stamp)
    exact_references = None if references is None else references.at_stamps(stamp)
    held_bounds = None if bounds is None else bounds.held(stamp)
    events = [event for at, event in content.events if span[0] <= at < span[1]]
    settings = [event.content.get('parameters', {}) for event in events]
    learning = series(topics.LEARNING)
    try:
        torque = applied_torque(content, states)
    except TorqueError:
        torque = next_effort(states)
    return RecordedRun(
        joints=joints,
        stamp=stamp,
        received=states.received,
        learning=learning,
        truth=series(topics.TRUTH),
        timing=series(topics.TIMING),
        monitor=series(topics.MONITOR),
        message_counts=content.message_counts,
        rejected=_rejected_columns(content, learning, namespace),
        stops=tuple(_stops(events, int(stamp[0]))),
        arm=_arm(content),
        learns=_learns(settings),
        notes=notes,
        _stored={
            'position': (states, 0),
            'velocity': (states, 1),
            'effort': (states, 2),
            'torque': (torque.efforts, 2),
            'error': (exact_errors, 0),
            'reference': (exact_references, 0),
            'xi2': (exact_errors, 1),
            'reference_velocity': (exact_references, 1),
            'bound': (held_bounds, 0),
            'torque_limit': (held_bounds, 2),
        },
        _is_decimated=errors is not None
        and any(one.get('telemetry.decimation', 1) > 1 for one in settings),
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


def _learns(settings: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the law ever used the prediction error; true if the journal does not say."""
    laws = {one['law'] for one in settings if 'law' in one}
    weights = [one['learning.weight'] for one in settings if 'learning.weight' in one]
    return laws <= {'blf_dsc'} and any(weights or [1.0])
