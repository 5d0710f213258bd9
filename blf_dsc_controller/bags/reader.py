# SPDX-License-Identifier: Apache-2.0
"""A bag as one run: joints matched by name, samples by stamp, torques by order; and as a table."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import JointStates, TopicMessages, Values
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import import_extra
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.journal import Event, EventType, contact_in
from blf_dsc_controller.run import (
    Contact,
    LearnedArm,
    Run,
    Series,
    Stop,
    ToolErrors,
)

_MOST_FALLS = 10  # of the stamps, by resets of a simulator
_ALTERNATING = 0.9  # ratio of the intervals to and from the state of another publisher
_FEWEST_STATES = 100  # from which intervals are judged
_ARRAYS = {  # of a run, with a column per joint: unit, messages, field
    'position': ('rad', 'states', 0),
    'velocity': ('rad/s', 'states', 1),
    'effort': ('N m', 'states', 2),
    'torque': ('N m', 'torques', 2),
    'reference': ('rad', 'references', 0),
    'reference_velocity': ('rad/s', 'references', 1),
    'error': ('rad', 'errors', 0),
    'xi2': ('rad/s', 'errors', 1),
    'bound': ('rad', 'bounds', 0),
    'torque_limit': ('N m', 'bounds', 2),
}
_VALUES = {  # prefix of names in the vectors: unit
    **dict.fromkeys((topics.DISTURBANCE, 'bias ', 'coulomb ', 'sin ', 'cos '), 'N m'),
    'viscous ': 'N m s/rad',
    topics.POSITION: 'rad',
    topics.VELOCITY: 'rad/s',
    topics.DISTANCE: 'rad',
    topics.LYAPUNOV: 'J',
    **dict.fromkeys(
        (topics.RATIO, topics.LATCHED, topics.MODEL_CHANGES, topics.LATE_STEPS), '1'
    ),
    **dict.fromkeys((topics.COMPUTE_TIME, topics.LATENCY, topics.LATENESS), 's'),
    **dict.fromkeys(topics.CONTACT, '1'),
    **dict.fromkeys(topics.TOOL[:2], 'm'),
    **dict.fromkeys(topics.TOOL[2:], 'rad'),
    'load mass': 'kg',
    'load ': 'm',
}
_ROWS = 1 << 14
_PARAMETER = 'kg m^2'  # of arms without a URDF


def read_run(path: str | Path, namespace: str = '', names: NameMap = NO_NAMES) -> Run:
    """Read the run of a bag into memory.

    `namespace` selects one of several robots, `names` maps its names.

    Raises:
        BagError: there is no bag, it is damaged, it holds no joint states, the topics of several
            robots, or the states of several runs.
        UnreadableMessageError: a message in it cannot be decoded.
    """
    return recorded_run(read_content(Path(path), namespace, names), np.asarray)


def recorded_run(
    content: Content, loaded: Callable[[Values], Any] = lambda values: values
) -> Run:
    """Return the run of a bag; errors as for `read_run`.

    Its `Values` are read when needed, unless `loaded` reads them into memory.
    """
    joints = _joints(content)
    states, notes, span = single_run(content, content.names.joints_of(joints))
    if content.unknown_parameters:
        names = ', '.join(content.unknown_parameters)
        notes = *notes, f'recorded parameters that this version does not have: {names}'
    stamp = states.stamp

    def within(
        topic: topics.Topic, names: Sequence[str] = (), required: str = 'position'
    ) -> JointStates | None:
        """Return a topic's messages in the run, by stamp; None if there are none."""
        messages = content.topics.get(topic)
        if messages is None:
            return None
        found = messages.joint_states(names or messages.joint_names(), (required,))
        received = found.received
        inside = (received >= span[0]) & (received < span[1])
        return found.select(np.flatnonzero(inside)).by_stamp() if inside.any() else None

    def series(topic: topics.Topic, kind: str = 'position') -> Series | None:
        found = within(topic, required=kind)
        if found is None:
            return None
        values = loaded(found.field(JOINT_STATE_FIELDS.index(kind)))
        return Series(found.names, found.stamp, values)

    errors, references, bounds = (
        within(topic, joints)
        for topic in (topics.TRACKING_ERROR, topics.REFERENCE, topics.BOUND)
    )
    try:
        _, torques = applied_torque(content, states)
    except TorqueError:
        torques = next_effort(states)
    messages: dict[str, Any] = {
        'states': states,
        'torques': torques,
        'errors': errors and errors.at_stamps(stamp),
        'references': references and references.at_stamps(stamp),
        'bounds': bounds and bounds.held(stamp),
    }
    arrays: dict[str, Any] = {
        name: messages[source] and Values(messages[source], k)
        for name, (_, source, k) in _ARRAYS.items()
    }
    if errors:  # its messages are not decimated: the reference is known at every sample
        known = messages['references'] or states.select(np.full(states.size, -1))
        arrays['reference'] = Values(
            known, 0, (states.field(0), messages['errors'].field(0))
        )
    arrays = {name: values and loaded(values) for name, values in arrays.items()}
    events = [event for at, event in content.events if span[0] <= at < span[1]]
    return Run(
        **arrays,
        joints=joints,
        stamp=stamp,
        received=states.received,
        monitor=series(topics.MONITOR),
        truth=series(topics.TRUTH),
        timing=series(topics.TIMING),
        external=series(topics.EXTERNAL_TORQUE, 'effort'),
        stops=tuple(_stops(events, int(stamp[0]))),
        contacts=_contacts(content, events),
        arm=_arm(content),
        tool=_tool(content),
        learns=_learns([event.content.get('parameters', {}) for event in events]),
        notes=notes,
    )


def single_run(
    content: Content, joints: Sequence[str]
) -> tuple[JointStates, tuple[str, ...], tuple[int, int]]:
    """Return the states of one run of one arm, what is left out, and when it was received [ns].

    The stamps of the states increase. Where they fall, as when a simulator is reset, another run
    begins; the longest one is taken.

    Raises:
        BagError: all stamps are the same, or several publishers share the topic.
    """
    messages = content.topics[topics.JOINT_STATES]
    states = messages.joint_states(joints, ('position',))
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
    foreign = messages.size - stamp.size
    others = stamp.size - (last - first)
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
    if intervals.size < _FEWEST_STATES:
        return False
    pauses = sorted(float(np.median(intervals[k::2])) for k in (0, 1))
    return pauses[0] < _ALTERNATING * pauses[1]


def _joints(content: Content) -> tuple[str, ...]:
    """Return the controller's joints in its order; without it, those with other names, or all."""
    sources = (topics.TRACKING_ERROR, topics.REFERENCE, topics.BOUND)
    of_controller = [
        content.topics[topic] for topic in sources if topic in content.topics
    ]
    if not of_controller and content.names.joints:
        return tuple(content.names.joints)
    return (*of_controller, content.topics[topics.JOINT_STATES])[0].joint_names()


def _arm(content: Content) -> LearnedArm | None:
    """Return the arm of the recorded configuration; None if it has no URDF or cannot be built."""
    if content.configurations.get(topics.CONTROLLER, {}).get('model') == 'urdf':
        from blf_dsc_controller.law.telemetry import learned_arm  # slow: compiles

        with suppress(BlfDscError):
            return learned_arm(content.controller_config())
    return None


def _tool(content: Content) -> ToolErrors | None:
    """Return the errors at the tool of the recorded configuration; None without a bound there."""
    if content.configurations.get(topics.CONTROLLER, {}).get('model') == 'urdf':
        from blf_dsc_controller.configuration.tool_bound import tool_of  # as above

        with suppress(BlfDscError):
            tool = tool_of(content.controller_config())
            return tool.errors if tool else None
    return None


def _stops(events: Iterable[Event], first: int) -> Iterator[Stop]:
    """Yield the stops in the journal; one before the first state gets that state's stamp [ns]."""
    ordered = list(events)
    for k, event in enumerate(ordered):
        if event.type is EventType.STOP:
            starts = [
                later.stamp for later in ordered[k:] if later.type is EventType.START
            ]
            what = event.content['reason'], event.content['text']
            yield Stop(
                max(event.stamp, first), *what, until=starts[0] if starts else None
            )


def _contacts(content: Content, events: Iterable[Event]) -> tuple[Contact, ...] | None:
    """Return the contacts in the journal; None if nothing looked for any."""
    given = content.configurations.get(topics.CONTROLLER, {})
    if not given.get('contact.enabled'):
        return None
    return tuple(
        contact_in(event) for event in events if event.type is EventType.CONTACT
    )


def _learns(settings: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the law ever used the prediction error; true if the journal does not say."""
    laws = {values['law'] for values in settings if 'law' in values}
    weights = [
        each['learning.weight'] for each in settings if 'learning.weight' in each
    ]
    return laws <= {'blf_dsc'} and any(weights or [1.0])


class TorqueError(BlfDscError):
    """The torques of a bag are unknown."""


def applied_torque(content: Content, states: JointStates) -> tuple[str, JointStates]:
    """Return the torque from each state to the next as efforts, and its source.

    The states are ordered by stamp. It is the first available of these: commands, if there is one
    for each state; the saturated torque of the controller's telemetry; the last command before the
    next state; the effort of the next state.

    Raises:
        TorqueError: the bag holds none of them, or commands in an unknown order.
    """
    errors, commands = map(content.topics.get, (topics.TRACKING_ERROR, topics.COMMANDS))
    if commands is not None and (errors is None or commands.size == states.size):
        sent = _by_joint(content, commands, states.names)
        if sent.size != states.size:
            until = np.append(states.received[1:], np.iinfo(np.int64).max)
            before = np.searchsorted(np.maximum.accumulate(sent.received), until) - 1
            sent = sent.select(before)
        return commands.name, sent
    if errors is not None:
        telemetry = errors.joint_states(states.names, ('effort',)).by_stamp()
        return f'effort of {errors.name}', telemetry.at_stamps(states.stamp)
    found = next_effort(states)
    if np.isnan(found.field(2)[:1000]).all():
        raise TorqueError(
            f'{content.path} does not hold the torques: there is no command topic (map it: '
            '--map commands=/its/name) and the effort of the joint states is empty'
        )
    return f'effort of {content.topics[topics.JOINT_STATES].name}', found


def next_effort(states: JointStates) -> JointStates:
    """Return the effort measured with the next state; unknown for the last one."""
    return states.select(np.append(np.arange(1, states.size), -1))


def _by_joint(
    content: Content, commands: TopicMessages, joints: tuple[str, ...]
) -> JointStates:
    """Return commands by name; without names, in the order of `joints` or of the joint states."""
    if commands.type == topics.JOINT_STATE:
        return commands.joint_states(joints, ('effort',))
    numbers, *others = commands.name_lists()
    lists = content.topics[topics.JOINT_STATES].name_lists()
    names = next(names for names in lists if {*joints} <= {*names})
    if others:
        raise TorqueError(
            f'{commands.name}: not every message holds the same number of values'
        )
    if len(numbers) == len(joints):
        return commands.joint_states(numbers, ('effort',))
    if len(numbers) == len(names):
        return commands.joint_states([f'{names.index(j)}' for j in joints], ('effort',))
    raise TorqueError(
        f'{commands.name} has {len(numbers)} values, but there are {len(joints)} joints, and '
        f'{len(names)} in the joint states ({", ".join(names)}): their order is not known'
    )


# The table, for spreadsheets, pandas and MATLAB.


def table(run: Run, rows: slice = slice(None)) -> dict[str, NDArray[Any]]:
    """Return some rows of every series of a run by name and unit, as `torque joint1 [N m]`.

    They are aligned to the stamps of its joint states. `stamp` and `received` are integers, all
    others floats, NaN where unknown, as is the reference's velocity between its messages. Named
    values (monitor, external, truth, timing) are held until the next message.
    """
    stamp = run.stamp[rows]
    columns: dict[str, NDArray[Any]] = {
        'stamp [ns]': stamp,
        'received [ns]': run.received[rows],
        'time [s]': run.time_of(stamp),
    }
    for field, (unit, _, _) in _ARRAYS.items():
        values = getattr(run, field)
        if values is not None:
            for joint, column in zip(run.joints, values[rows].T, strict=True):
                columns[f'{field} {joint} [{unit}]'] = column
    for topic in ('monitor', 'external', 'truth', 'timing'):
        series = getattr(run, topic)
        if series is not None:
            held = series.held(stamp, series.names)
            for name, column in zip(series.names, held.T, strict=True):
                unit = 'N m' if topic == 'external' else _unit(name, run)
                columns[f'{topic} {name} [{unit}]'] = column
    return columns


def _unit(name: str, run: Run) -> str:
    """Return the unit of a named value; parameters of a URDF have their own."""
    if run.arm is not None and name in run.arm.units:
        return run.arm.units[name] or '1'
    if name == topics.LAMBDA_MIN and run.arm is None:
        return 's^-4'
    known = [unit for beginning, unit in _VALUES.items() if name.startswith(beginning)]
    return known[0] if known else '1' if run.arm is not None else _PARAMETER


def export(run: Run, path: Path) -> int:
    """Write the table as CSV or Parquet, by the suffix of `path`; return the number of columns.

    It is written block by block: a run may be larger than memory. Numbers are read back exactly.

    Raises:
        BlfDscError: the suffix is neither .csv nor .parquet.
        MissingExtraError: pyarrow is not installed.
    """
    if path.suffix not in ('.csv', '.parquet'):
        raise BlfDscError(
            f'{path} ends in neither .csv nor .parquet: the file extension selects the format'
        )
    blocks = (slice(begin, begin + _ROWS) for begin in range(0, run.stamp.size, _ROWS))
    (_write_csv if path.suffix == '.csv' else _write_parquet)(
        (table(run, rows) for rows in blocks), path
    )
    return len(table(run, slice(1)))


def _write_csv(tables: Iterator[dict[str, NDArray[Any]]], path: Path) -> None:
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        for k, block in enumerate(tables):
            if k == 0:
                writer.writerow(block)
            writer.writerows(
                zip(*(values.tolist() for values in block.values()), strict=True)
            )


def _write_parquet(tables: Iterator[dict[str, NDArray[Any]]], path: Path) -> None:
    pa = import_extra('pyarrow', 'parquet', 'writing Parquet')
    parquet = import_extra('pyarrow.parquet', 'parquet', 'writing Parquet')
    first = pa.table(next(tables))
    with parquet.ParquetWriter(path, first.schema) as writer:
        writer.write_table(first)
        for block in tables:
            writer.write_table(pa.table(block))
