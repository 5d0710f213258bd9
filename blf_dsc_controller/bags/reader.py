# SPDX-License-Identifier: Apache-2.0
"""Reader of a bag as one run: joints matched by name, samples by stamp, torques by order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import (
    ALL,
    JointStates,
    StoredSeries,
    TopicMessages,
)
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    CONTROLLER,
    JOINT_STATE,
    JOINT_STATES,
    TRACKING_ERROR,
)
from blf_dsc_controller.run import Floats, LearnedArm, Rows, Run, Series, Stop

_MOST_FALLS = 10  # of the stamps, by resets of a simulator
_ALTERNATING = 0.9  # ratio of the intervals to and from the state of another publisher
_FEW = 100  # states


class RecordedRun(Run):
    """Run whose arrays are read from its bag's tables each time that they are asked for."""

    def __init__(
        self,
        stored: Mapping[str, tuple[JointStates | None, int]],
        *,
        is_decimated: bool,
        **values: Any,
    ) -> None:
        """Take states and field of each array, and the values that are in memory.

        `is_decimated`: the reference was published for some samples only.
        """
        for name, value in {**values, '_stored': stored, '_is_decimated': is_decimated}.items():
            object.__setattr__(self, name, value)

    def __getattribute__(self, name: str) -> Any:
        stored = object.__getattribute__(self, '__dict__').get('_stored', ())
        return self.at(name) if name in stored else object.__getattribute__(self, name)

    def holds(self, name: str) -> bool:
        """Return whether some of an array is known."""
        states, k = self._stored[name]
        return (name == 'error' and self.holds('reference')) if states is None else states.has(k)

    def at(self, name: str, rows: Rows = ALL, columns: Rows = ALL) -> Floats | None:
        """Return some rows and joints of an array; None if it is unknown."""
        states, k = self._stored[name]
        if states is None:
            return self._difference('reference', rows, columns) if self.holds(name) else None
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
    states, notes, span = single_run(content, names.joints_of(joints))
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
        return None if found is None else StoredSeries(found)

    errors, references = (
        None if found is None else found.at_stamps(stamp)
        for found in (within(TRACKING_ERROR, joints), within(topics.REFERENCE, joints))
    )
    bounds = within(topics.BOUND, joints)
    held_bounds = None if bounds is None else bounds.held(stamp)
    events = [event for at, event in content.events if span[0] <= at < span[1]]
    settings = [event.content.get('parameters', {}) for event in events]
    learning = series(topics.LEARNING)
    try:
        _, torque = applied_torque(content, states)
    except TorqueError:
        torque = next_effort(states)
    return RecordedRun(
        stored={
            'position': (states, 0),
            'velocity': (states, 1),
            'effort': (states, 2),
            'torque': (torque, 2),
            'error': (errors, 0),
            'reference': (references, 0),
            'xi2': (errors, 1),
            'reference_velocity': (references, 1),
            'bound': (held_bounds, 0),
            'torque_limit': (held_bounds, 2),
        },
        is_decimated=errors is not None
        and any(values.get('telemetry.decimation', 1) > 1 for values in settings),
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
    )


def single_run(
    content: Content, joints: Sequence[str], required: Sequence[str] = ('position',)
) -> tuple[JointStates, tuple[str, ...], tuple[int, int]]:
    """Return the states of one run of one arm, what is left out, and when it was received [ns].

    The stamps of the states increase. Where they fall, as when a simulator is reset, another run
    begins; the longest one is taken.

    Raises:
        BagError: all stamps are the same, or several publishers share the topic.
    """
    messages = content.topics[JOINT_STATES]
    states = messages.joint_states(joints, required)
    stamp, received = states.stamp, states.received
    if stamp.size > 1 and (stamp == stamp[0]).all():
        raise BagError(
            f'all {stamp.size} messages of {messages.name} have the stamp {stamp[0]} ns: each '
            'needs a unique stamp, so the driver has to set header.stamp'
        )
    falls = np.flatnonzero(np.diff(stamp) < 0)
    if falls.size > _MOST_FALLS or _alternates(states):
        where = ''
        if falls.size:
            before, after = stamp[falls[0] : falls[0] + 2] * 1e-9
            where = f': its stamps fall {falls.size} times, the first time '
            where += f'from {before:.9g} s to {after:.9g} s'
        raise BagError(
            f'several publishers share {messages.name}, or its clock runs backwards{where}; '
            'record one arm for each topic'
        )
    edges = np.concatenate([[0], falls + 1, [stamp.size]])
    longest = int(np.diff(edges).argmax())
    first, last = edges[longest : longest + 2].tolist()
    span = (
        int(received[first]) if first else np.iinfo(np.int64).min,
        int(received[last]) if last < stamp.size else np.iinfo(np.int64).max,
    )
    run = states.select(slice(first, last)).by_stamp()
    foreign, others = messages.size - stamp.size, stamp.size - (last - first)
    repeated = last - first - run.size
    notes = {
        f'{foreign} of {messages.size} joint states left out: they name other joints': foreign,
        f'{others} of {stamp.size} joint states left out: their stamps fall {falls.size} times, '
        f'so that {falls.size + 1} runs are in the bag; run {longest + 1}, the longest, is '
        'shown': others,
        f'{repeated} joint states left out: they repeat the stamp before': repeated,
    }
    return run, tuple(text for text, count in notes.items() if count), span


def _alternates(states: JointStates) -> bool:
    """Return whether the states come from two publishers in turn."""
    sequence = states.sequence
    if (np.diff(sequence) <= 0).sum() > _MOST_FALLS and sequence.any():
        return True
    intervals = np.diff(states.stamp)
    if intervals.size < _FEW:
        return False
    pauses = sorted(float(np.median(intervals[k::2])) for k in (0, 1))
    return pauses[0] < _ALTERNATING * pauses[1]


def _joints(content: Content, names: NameMap) -> tuple[str, ...]:
    """Return the controller's joints in its order; without it, those of `names`, or all."""
    sources = (TRACKING_ERROR, topics.REFERENCE, topics.BOUND)
    of_controller = [content.topics[topic] for topic in sources if topic in content.topics]
    if not of_controller and names.joints:
        return tuple(names.joints)
    return (*of_controller, content.topics[JOINT_STATES])[0].joint_names()


def _rejected_columns(content: Content, learning: Series | None, namespace: str) -> dict[str, str]:
    """Return columns that are NaN at the end of learning, with the reason in /diagnostics."""
    if learning is None:
        return {}
    values = learning.at(np.array([learning.stamp.size - 1]))[0]
    columns = [learning.names[j] for j in np.flatnonzero(np.isnan(values))]
    columns = [name for name in columns if name != topics.COMPUTE_TIME]
    reasons: dict[str, str] = {}
    diagnostics = content.topics.get(topics.DIAGNOSTICS)
    for raw in diagnostics.raw if columns and diagnostics is not None else ():
        message: Any = typestore().deserialize_cdr(raw, topics.DIAGNOSTICS.type)
        reasons |= {
            pair.key.removeprefix(topics.REJECTED): pair.value
            for status in message.status
            if status.name.startswith(namespace.strip('/'))
            for pair in status.values
        }
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
    laws = {values['law'] for values in settings if 'law' in values}
    weights = [each['learning.weight'] for each in settings if 'learning.weight' in each]
    return laws <= {'blf_dsc'} and any(weights or [1.0])


class TorqueError(BlfDscError):
    """The torques of a bag are unknown."""


def applied_torque(content: Content, states: JointStates) -> tuple[str, JointStates]:
    """Return the torque from each state to the next as efforts, and its source.

    The states are ordered by stamp. It is the first available of these: commands, if there is one
    for each state; the saturated torque of the controller's telemetry; commands; the effort of the
    next state.

    Raises:
        TorqueError: the bag holds none of them, or commands in an unknown order.
    """
    commands, errors = content.topics.get(COMMANDS), content.topics.get(TRACKING_ERROR)
    if commands is not None and (errors is None or commands.size == states.size):
        return commands.name, _commanded(content, commands, states)
    if errors is not None:
        telemetry = errors.joint_states(states.names, ('effort',)).by_stamp()
        return f'effort of {errors.name}', telemetry.at_stamps(states.stamp)
    found = next_effort(states)
    if np.isnan(found.field(2, slice(0, 1000))).all():
        raise TorqueError(
            f'{content.path} does not hold the torques: there is no command topic (map it: '
            '--map commands=/its/name) and the effort of the joint states is empty'
        )
    return f'effort of {content.topics[JOINT_STATES].name}', found


def next_effort(states: JointStates) -> JointStates:
    """Return the effort measured with the next state; unknown for the last one."""
    return states.select(np.append(np.arange(1, states.size), -1))


def _commanded(content: Content, commands: TopicMessages, states: JointStates) -> JointStates:
    """Return the command after each state: k-th, or last before the next if counts differ."""
    efforts = _by_joint(content, commands, states.names)
    if efforts.size == states.size:
        return efforts
    until = np.append(states.received[1:], np.iinfo(np.int64).max)
    return efforts.select(np.searchsorted(np.maximum.accumulate(efforts.received), until) - 1)


def _by_joint(content: Content, commands: TopicMessages, joints: tuple[str, ...]) -> JointStates:
    """Return commands by name; without names, in the order of `joints` or of the joint states."""
    if commands.type == JOINT_STATE:
        return commands.joint_states(joints, ('effort',))
    size = commands.layout().arrays[0].size
    states = content.topics[JOINT_STATES].layout()
    if size == len(joints):
        return commands.arrays(range(size))
    if size == len(states.names):
        return commands.arrays(states.indices_of(joints))
    raise TorqueError(
        f'{commands.name} has {size} values, but there are {len(joints)} joints, and '
        f'{len(states.names)} in the joint states ({", ".join(states.names)}): their order is '
        'not known'
    )
