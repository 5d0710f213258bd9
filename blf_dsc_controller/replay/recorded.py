# SPDX-License-Identifier: Apache-2.0
"""A bag through the configuration that it was recorded with: the same numbers, or where not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.content import Content, read_content
from blf_dsc_controller.bags.context import Context, RecordedController, read_context
from blf_dsc_controller.law.factory import required_fields
from blf_dsc_controller.messages.topics import (
    ACCEPTED_TRAJECTORY,
    COMMANDS,
    FOREVER,
    JOINT_TRAJECTORY,
    Topic,
)
from blf_dsc_controller.replay.changes import changes_of, restarts
from blf_dsc_controller.replay.comparison import Comparison, Difference, compare, first
from blf_dsc_controller.replay.errors import LateRecordingError, NothingToCompareError
from blf_dsc_controller.replay.expected import expected, monitored
from blf_dsc_controller.replay.history import (
    PARAMETERS,
    TRAJECTORY,
    History,
    Order,
    Stop,
    history_of,
    retunings,
    trajectories,
)
from blf_dsc_controller.replay.law import run_law
from blf_dsc_controller.replay.rerun import Rerun, rerun
from blf_dsc_controller.replay.states import States, answered_states, arrivals, told_stamps

_WITHOUT_TRAJECTORIES = (
    'trajectories were sent to the controller, and the bag does not tell when it took them: the '
    'replay follows the configured reference throughout'
)


@dataclass(frozen=True)
class Outcome:
    """What a replay found.

    Attributes:
        states: that were answered by the law and replayed.
        changes: changes of parameters that were replayed.
        comparisons: one for each topic of the controller.
        remarks: what a reader must know to judge the result.
        done: in words, what else was replayed: trajectories, stops, operations.
        departure: where the replayed controller did otherwise than the recorded one; None if
            nowhere.
    """

    states: States
    changes: int
    comparisons: tuple[Comparison, ...]
    remarks: tuple[str, ...]
    done: tuple[str, ...] = ()
    departure: Difference | None = None

    @property
    def difference(self) -> Difference | None:
        """Earliest difference; None if all that was recorded is the same."""
        found = first(self.comparisons)
        if self.departure is None or (found and found.stamp < self.departure.stamp):
            return found
        return self.departure


def replay(path: Path, namespace: str = '') -> Outcome:
    """Replay a bag with its own configuration.

    Args:
        path: folder of the bag, or one of its storage files.
        namespace: of the robot to look at, if the bag holds several.

    Raises:
        BagError: the bag does not tell how the controller was configured.
        NothingToCompareError: it holds nothing that the controller said.
        LateRecordingError: it does not hold the first state that the controller answered.
        BlfDscError: the bag, or a message in it, cannot be read.
    """
    context = read_context(path)
    content = read_content(path, namespace)
    recorded = context.controller()
    gappy = [topic for topic in content.message_counts if context.missed(topic)]
    history = history_of(content)
    if history is None:
        outcome = _replay_law(path, content, recorded, gappy)
    else:
        is_watched = recorded.config.safety.watchdog == 'on'
        in_step = context.facts.get('clock') == 'lockstep' and not is_watched
        outcome = _replay_guard(path, content, recorded, gappy, history, in_step=in_step)
    if not (outcome.departure or any(one.values for one in outcome.comparisons)):
        raise NothingToCompareError(path, content.message_counts)
    remarks = (*outcome.remarks, *_remarks(context, outcome))
    return replace(outcome, remarks=remarks)


def _replay_guard(
    path: Path,
    content: Content,
    recorded: RecordedController,
    gappy: list[str],
    history: History,
    *,
    in_step: bool,
) -> Outcome:
    """Replay all that the controller did, which the bag tells sample by sample."""
    told = told_stamps(content)
    config, changes, problem = changes_of(
        content,
        recorded.config,
        recorded.known_at,
        recorded.node,
        FOREVER,
        history.until,
        told,
        history.starts,
    )
    history = history.including([*retunings(changes), *trajectories(content)])
    came = arrivals(content, config.joints, required_fields(config), history.until)
    found = rerun(config, came, told, history, in_step=in_step)
    states = found.states
    if states.lost is not None and not states.stamp.size:
        raise LateRecordingError(path, states.lost)
    messages = expected(found.replayed, states, found.monitored)
    comparisons = tuple(compare(content, states, messages, gappy, found.commands))
    kinds = [one.what for one in found.done if isinstance(one, Order)]
    remarks = [problem] if problem else []
    if _holds(content, JOINT_TRAJECTORY) and not _holds(content, ACCEPTED_TRAJECTORY):
        remarks.append(_WITHOUT_TRAJECTORIES)
    if found.end:
        remarks.append(f'{found.end}: the replay ends there')
    return Outcome(
        states,
        kinds.count(PARAMETERS),
        comparisons,
        tuple(remarks),
        tuple(_words(found, comparisons)),
        found.departure,
    )


def _replay_law(
    path: Path, content: Content, recorded: RecordedController, gappy: list[str]
) -> Outcome:
    """Replay the law alone: the bag does not tell what was done to the controller, and when."""
    states = answered_states(content, recorded.config.joints, ('position',))
    if states.lost is not None and not states.stamp.size:
        raise LateRecordingError(path, states.lost)
    again = restarts(content, recorded.config, int(states.stamp[0]))
    end = int(again[0]) if again.size else FOREVER
    states = states.until(end)
    config, changes, problem = changes_of(
        content, recorded.config, recorded.known_at, recorded.node, end
    )
    replayed = run_law(config, states, changes)
    messages = expected(replayed, states, monitored(replayed, states, replayed.told.bound))
    comparisons = tuple(compare(content, states, messages, gappy))
    remarks = [problem] if problem else []
    if _holds(content, JOINT_TRAJECTORY) or ACCEPTED_TRAJECTORY in content.topics:
        remarks.append(_WITHOUT_TRAJECTORIES)
    if again.size:
        remarks.append(
            f'the controller began again with the state of stamp {end} ns: the replay ends before'
        )
    if states.lost is not None:
        remarks.append(
            f'the state of stamp {states.lost} ns was answered but is not in the bag: the replay '
            'ends before it'
        )
    return Outcome(states, len(changes), comparisons, tuple(remarks))


def _holds(content: Content, topic: Topic) -> bool:
    """Whether the bag has the topic, with messages or without."""
    return any(name.rsplit('/', 1)[-1] == topic.leaf for name in content.message_counts)


def _words(found: Rerun, comparisons: Sequence[Comparison]) -> Iterator[str]:
    followed = sum(isinstance(one, Order) and one.what == TRAJECTORY for one in found.done)
    if followed:
        yield f'{followed} trajectories replayed where they took effect'
    turns = [
        f'safe stop ({one.reason.value})' if isinstance(one, Stop) else one.what
        for one in found.done
        if isinstance(one, Stop) or one.what not in (TRAJECTORY, PARAMETERS)
    ]
    if len(turns) > 1:  # than the activation with which it begins
        yield f'replayed in turn: {", ".join(turns)}'
    compared = sum(one.values for one in comparisons if one.topic.endswith(COMMANDS.leaf))
    of_law = found.commands.of_law[: compared // len(found.replayed.config.joints)]
    safe = np.count_nonzero(~of_law)
    if safe:
        yield f'{safe} of the commands compared are safe torques, or on the ramp to one'


def _remarks(context: Context, outcome: Outcome) -> Iterator[str]:
    for topic, what in context.losses.items():
        yield f'the recorder did not get all of {topic}: {what}'
    if context.version != __version__:
        yield (
            f'recorded by version {context.version or "unknown"} and replayed by {__version__}: '
            'differences may come from the software'
        )
    difference = outcome.difference
    if difference is not None and difference.time == 0.0:
        yield (
            'the very first sample differs: was the recording begun after the controller, or the '
            'controller started again?'
        )
