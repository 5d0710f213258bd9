# SPDX-License-Identifier: Apache-2.0
"""One run in a bag: joints matched by name, samples by stamp, torques by order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import JointStates, TopicMessages
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics

_MOST_FALLS = 10  # of the stamps, by resets of a simulator
_ALTERNATING = 0.9  # ratio of the intervals to and from the state of another publisher
_FEWEST_STATES = 100  # from which intervals are judged


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
    # Before the first state of the bag and after its last one nothing bounds the run.
    no_bound = np.iinfo(np.int64)
    received = states.received
    begin = int(received[first]) if first else no_bound.min
    end = int(received[last]) if last < states.size else no_bound.max
    return SingleRun(run, tuple(notes), (begin, end))


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
