# SPDX-License-Identifier: Apache-2.0
"""A bag as one run: joints matched by name, samples by stamp, torques by order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import JointStates, TopicMessages, Values
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_traits import OWN, PAPER
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.journal import (
    Event,
    EventType,
    contact_in,
    oscillation_in,
)
from blf_dsc_controller.reference.turns import turns_freely
from blf_dsc_controller.run import (
    Contact,
    LearnedArm,
    Run,
    Series,
    Stamps,
    Stop,
    ToolErrors,
)

_MOST_FALLS = 10  # of the stamps, by resets of a simulator
_ALTERNATING = 0.9  # ratio of the intervals to and from the state of another publisher
_FEWEST_STATES = 100  # from which intervals are judged
_ARRAYS = {  # of a run, with a column per joint: messages, field
    'position': ('states', 0),
    'velocity': ('states', 1),
    'effort': ('states', 2),
    'torque': ('torques', 2),
    'reference': ('references', 0),
    'reference_velocity': ('references', 1),
    'error': ('errors', 0),
    'xi2': ('errors', 1),
    'bound': ('bounds', 0),
    'torque_limit': ('bounds', 2),
}


def read_run(path: str | Path, namespace: str = '', names: NameMap = NO_NAMES) -> Run:
    """Read the run of a bag into memory.

    `namespace` selects one of several robots, `names` maps its names.

    Raises:
        BagError: there is no bag, it is damaged, it holds no joint states, the topics of several
            robots, or the states of several runs.
        UnreadableMessageError: a message in it cannot be decoded.
    """
    return recorded_run(read_content(path, namespace, names), np.asarray)


def recorded_run(
    content: Content, loaded: Callable[[Values], Any] = lambda values: values
) -> Run:
    """Return the run of a bag; errors as for `read_run`.

    Its `Values` are read when needed, unless `loaded` reads them into memory.
    """
    joints = _joints(content)
    run = single_run(content, content.joints_of(joints))
    stamp = run.states.stamp
    begin, end = run.received
    events = [event for at, event in content.events if begin <= at < end]
    config, arm, unusable = _arm(content)
    may_wrap = config is not None and bool(turns_freely(config).any())
    arrays: dict[str, Any] = {
        name: None if values is None else loaded(values)
        for name, values in _arrays(content, run, joints, may_wrap=may_wrap).items()
    }

    def series(topic: topics.Topic, kind: str = 'position') -> Series | None:
        """Return the named values of a topic in the run; None if there are none."""
        found = run.messages_of(content, topic, required=kind)
        if found is None:
            return None
        values = loaded(found.field(JOINT_STATE_FIELDS.index(kind)))
        return Series(found.names, found.stamp, values)

    return Run(
        **arrays,
        joints=joints,
        stamp=stamp,
        received=run.states.received,
        monitor=series(topics.MONITOR),
        truth=series(topics.TRUTH),
        timing=series(topics.TIMING),
        external=series(topics.EXTERNAL_TORQUE, 'effort'),
        stops=tuple(_stops(events, int(stamp[0]))),
        contacts=_contacts(content, events),
        oscillations=tuple(
            oscillation_in(event)
            for event in events
            if event.type is EventType.OSCILLATION
        ),
        arm=arm,
        tool=_tool(config) if config else None,
        learns=_learns([event.content.get('parameters', {}) for event in events]),
        notes=(*run.notes, *_unknown_parameters(content), *unusable),
        sliding=config.robot.sliding(config.joints) if config else (),
        parameters=content.configurations.get(CONTROLLER, {}),
    )


class SingleRun(NamedTuple):
    """One run of one arm in a bag: its joint states, and reception times."""

    states: JointStates  # in the order of their stamps, which increase
    notes: tuple[str, ...]  # what is left out, and why
    # ns, of its first state and of the first of the next run
    received: tuple[int, int]

    def messages_of(
        self,
        content: Content,
        topic: topics.Topic,
        names: Sequence[str] = (),
        required: str = 'position',
    ) -> JointStates | None:
        """Return a topic's messages in the run, by stamp; None if there are none.

        They hold the values of `names`, by default of all, in the field `required`.
        """
        messages = content.topics.get(topic)
        if messages is None:
            return None
        found = messages.joint_states(names or messages.joint_names(), (required,))
        received = found.received
        begin, end = self.received
        is_inside = (received >= begin) & (received < end)
        if not is_inside.any():
            return None
        return found.select(np.flatnonzero(is_inside)).by_stamp()


def _arrays(
    content: Content, run: SingleRun, joints: Sequence[str], *, may_wrap: bool
) -> dict[str, Values | None]:
    """Return the arrays of a run by name, one row per state; None if unknown.

    The controller may count turns on for a joint, as for a continuous one: it `may_wrap`.
    """
    states = run.states
    stamp = states.stamp
    errors = run.messages_of(content, topics.TRACKING_ERROR, joints)
    references = run.messages_of(content, topics.REFERENCE, joints)
    bounds = run.messages_of(content, topics.BOUND, joints)
    sources = {
        'states': states,
        'torques': _torques(content, states),
        'errors': None if errors is None else errors.at_stamps(stamp),
        'references': None if references is None else references.at_stamps(stamp),
        'bounds': None if bounds is None else bounds.held(stamp),
    }
    arrays = {
        name: None if (messages := sources[source]) is None else messages.field(field)
        for name, (source, field) in _ARRAYS.items()
    }
    errors, known = sources['errors'], sources['references']
    if errors is not None:
        # Errors are not decimated: q - xi1 is the reference at every sample. Where the
        # positions may wrap, the controller's is whole turns off.
        if known is None or may_wrap:
            known = states.select(np.full(states.size, -1))
        arrays['reference'] = Values(known, 0, (states.field(0), errors.field(0)))
    return arrays


def _torques(content: Content, states: JointStates) -> JointStates:
    """Return the torque from each state to the next, NaN where it is unknown."""
    try:
        _, torques = applied_torque(content, states)
    except TorqueError:
        return next_effort(states)
    return torques


def _unknown_parameters(content: Content) -> Iterator[str]:
    """Yield a note on recorded parameters that this version does not have."""
    if content.unknown_parameters:
        names = ', '.join(content.unknown_parameters)
        yield f'recorded parameters that this version does not have: {names}'


def single_run(content: Content, joints: Sequence[str]) -> SingleRun:
    """Return one run of one arm.

    The stamps of its states increase. Where they fall, as when a simulator is reset,
    another run begins; the longest one is taken.

    Raises:
        BagError: all stamps are the same, or several publishers share the topic.
    """
    messages = content.topics[topics.JOINT_STATES]
    states = messages.joint_states(joints, ('position',))
    falls = np.flatnonzero(np.diff(states.stamp) < 0)
    _check_publisher(messages.name, states, falls)
    edges = np.concatenate([[0], falls + 1, [states.size]])
    longest = int(np.diff(edges).argmax())
    first, last = edges[longest : longest + 2].tolist()
    in_run = states.select(slice(first, last))
    run = in_run.by_stamp()

    notes = []
    foreign = messages.size - states.size
    if foreign:
        notes.append(
            f'{foreign} of {messages.size} joint states left out: they name other joints'
        )
    others = states.size - in_run.size
    if others:
        notes.append(
            f'{others} of {states.size} joint states left out: their stamps fall {falls.size} '
            f'times, so that {falls.size + 1} runs are in the bag; run {longest + 1}, the longest, '
            'is shown'
        )
    repeated = in_run.size - run.size
    if repeated:
        notes.append(f'{repeated} joint states left out: they repeat the stamp before')
    return SingleRun(run, tuple(notes), _span(states.received, first, last))


def _span(received: Stamps, first: int, last: int) -> tuple[int, int]:
    """Return when [ns] the messages of the states `first` to `last` - 1 were received.

    Before the first state of the bag and after its last one nothing bounds the run.
    """
    no_bound = np.iinfo(np.int64)
    begin = int(received[first]) if first else no_bound.min
    end = int(received[last]) if last < received.size else no_bound.max
    return begin, end


def _check_publisher(topic: str, states: JointStates, falls: NDArray[np.intp]) -> None:
    """Raise BagError unless the states can be those of one publisher with a clock.

    `falls` are the states after which the stamp is an earlier one.
    """
    stamp = states.stamp
    if stamp.size > 1 and (stamp == stamp[0]).all():
        raise BagError(
            f'all {stamp.size} messages of {topic} have the stamp {stamp[0]} ns: each '
            'needs a unique stamp, so the driver has to set header.stamp'
        )
    if falls.size <= _MOST_FALLS and not _alternates(states):
        return
    where = ''
    if falls.size:
        before, after = stamp[falls[0] : falls[0] + 2] * 1e-9
        where = (
            f': its stamps fall {falls.size} times, the first time from {before:.9g} s '
            f'to {after:.9g} s'
        )
    raise BagError(
        f'several publishers share {topic}, or its clock runs backwards{where}; '
        'record one arm for each topic'
    )


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
    """Return the controller's joints in order; without it, other names, or all."""
    sources = (topics.TRACKING_ERROR, topics.REFERENCE, topics.BOUND)
    of_controller = [
        content.topics[topic] for topic in sources if topic in content.topics
    ]
    if not of_controller and content.names.joints:
        return tuple(content.names.joints)
    return (*of_controller, content.topics[topics.JOINT_STATES])[0].joint_names()


def _arm(
    content: Content,
) -> tuple[ControllerConfig | None, LearnedArm | None, list[str]]:
    """Return the recorded configuration of an arm from a URDF, and this arm; None without one.

    Also what to say if it cannot be built.
    """
    if not content.configurations.get(CONTROLLER, {}).get('robot.urdf'):
        return None, None, []
    from blf_dsc_controller.factory.estimate import learned_arm  # slow: compiles

    try:
        config = content.controller_config()
        return config, learned_arm(config), []
    except BlfDscError as error:
        text = f'what the recorded arm would tell is left out, as it cannot be built: {error}'
        return None, None, [text]


def _tool(config: ControllerConfig) -> ToolErrors | None:
    """Return the errors at the tool as configured; None without a bound there."""
    from blf_dsc_controller.configuration.tool_bound import tool_of  # as above

    tool = tool_of(config)
    return tool.errors if tool else None


def _stops(events: Iterable[Event], first: int) -> Iterator[Stop]:
    """Yield the stops in the journal; an early one gets the first stamp [ns]."""
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
    given = content.configurations.get(CONTROLLER, {})
    if not given.get('contact.enabled'):
        return None
    return tuple(
        contact_in(event) for event in events if event.type is EventType.CONTACT
    )


def _learns(settings: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the law ever learned; true if unknown."""
    laws = {values['law'] for values in settings if 'law' in values}
    switches = [
        each['learning.enabled'] for each in settings if 'learning.enabled' in each
    ]
    return laws <= {OWN, PAPER} and any(switches or [True])


class TorqueError(BlfDscError):
    """The torques of a bag are unknown."""


def applied_torque(content: Content, states: JointStates) -> tuple[str, JointStates]:
    """Return the torque from each state to the next as efforts, and its source.

    The states are ordered by stamp. It is the first available of these: commands, if
    there is one for each state; the saturated torque of the controller's telemetry; the
    last command before the next state; the effort of the next state.

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
    """Return commands by name, or else in the order of `joints` or of the states."""
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
