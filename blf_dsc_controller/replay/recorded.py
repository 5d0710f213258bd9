# SPDX-License-Identifier: Apache-2.0
"""A bag through the configuration that it was recorded with: the same numbers, or where not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.bags.topics import FOREVER, JOINT_TRAJECTORY
from blf_dsc_controller.replay.changes import changes_of, restarts
from blf_dsc_controller.replay.comparison import Comparison, Difference, compare, first
from blf_dsc_controller.replay.errors import LateRecordingError, NothingToCompareError
from blf_dsc_controller.replay.expected import expected
from blf_dsc_controller.replay.law import run_law
from blf_dsc_controller.replay.states import States, answered_states


@dataclass(frozen=True)
class Outcome:
    """What a replay found.

    Attributes:
        states: that were replayed.
        changes: changes of parameters that were replayed.
        comparisons: one for each topic of the controller.
        remarks: what a reader must know to judge the result.
    """

    states: States
    changes: int
    comparisons: tuple[Comparison, ...]
    remarks: tuple[str, ...]

    @property
    def difference(self) -> Difference | None:
        """Earliest difference; None if all that was recorded is the same."""
        return first(self.comparisons)


def replay(path: Path, namespace: str = '') -> Outcome:
    """Replay a bag with its own configuration.

    Args:
        path: folder of the bag, or one of its storage files.
        namespace: of the robot to look at, if the bag holds several.

    Raises:
        NoConfigurationError: the bag does not tell how the controller was configured.
        NothingToCompareError: it holds nothing that the controller said.
        BlfDscError: the bag, or a message in it, cannot be read.
    """
    context = read_context(path)
    content = read_content(path, namespace)
    recorded = context.controller()
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
    gappy = [topic for topic in content.message_counts if context.missed(topic)]
    messages = expected(replayed, states, replayed.told.bound)
    comparisons = tuple(compare(content, states, messages, gappy))
    if not any(one.values for one in comparisons):
        raise NothingToCompareError(path, content.message_counts)
    remarks = [problem] if problem else []
    remarks += [
        f'the recorder did not get all of {on}: {what}' for on, what in context.losses.items()
    ]
    if any(topic.rsplit('/', 1)[-1] == JOINT_TRAJECTORY.leaf for topic in content.message_counts):
        remarks.append(
            'trajectories were sent to the controller: the replay follows the configured reference '
            'throughout'
        )
    if context.version != __version__:
        remarks.append(
            f'recorded by version {context.version or "unknown"} and replayed by {__version__}: '
            'differences may come from the software'
        )
    if again.size:
        remarks.append(
            f'the controller began again with the state of stamp {end} ns: the replay ends before'
        )
    if states.lost is not None:
        remarks.append(
            f'the state of stamp {states.lost} ns was answered but is not in the bag: the replay '
            'ends before it'
        )
    if (difference := first(comparisons)) is not None and difference.time == 0.0:
        remarks.append(
            'the very first sample differs: was the recording begun after the controller, or the '
            'controller started again?'
        )
    return Outcome(states, len(changes), comparisons, tuple(remarks))
