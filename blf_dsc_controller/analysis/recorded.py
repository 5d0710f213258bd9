# SPDX-License-Identifier: Apache-2.0
"""A bag as one run: its arrays, events, and the arm that was learned."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.reader import (
    SingleRun,
    TorqueError,
    applied_torque,
    next_effort,
    single_run,
)
from blf_dsc_controller.bags.topic_messages import JointStates, Values
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
    Floats,
    LearnedArm,
    Run,
    Series,
    Stop,
    ToolErrors,
)

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
        arrays['reference'] = Values(
            partial(_reference, known.field(0), states.field(0), errors.field(0))
        )
    return arrays


def _reference(known: Values, positions: Values, errors: Values, key: Any) -> Floats:
    """Return the reference at an index: the one that is known, or else q - xi1."""
    values = known[key]
    if np.isnan(values).any():
        values = np.where(np.isnan(values), positions[key] - errors[key], values)
    return values


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
