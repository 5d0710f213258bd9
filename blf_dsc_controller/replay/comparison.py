# SPDX-License-Identifier: Apache-2.0
"""Recorded against replayed messages of the controller, bit for bit."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.content import (
    Content,
    TopicMessages,
    decode_arrays,
    decode_joint_states,
)
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.law.state import Sample
from blf_dsc_controller.messages.cdr import joint_state_layout
from blf_dsc_controller.messages.codecs import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.telemetry import disturbance_names
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    LAMBDA_MIN,
    LATCHED,
    LEARNING,
    MONITOR,
    REFERENCE,
    TRACKING_ERROR,
    Topic,
)
from blf_dsc_controller.replay.states import States
from blf_dsc_controller.run import Floats, Stamps

Columns = Mapping[str, Floats]
"""Values (N,) by the field that holds them, such as `velocity of joint1` or `lambda_min`."""


class Difference(NamedTuple):
    """The first number of a topic that is not the same."""

    topic: str
    field: str
    stamp: int  # ns
    time: float  # s since the first state
    recorded: float
    replayed: float

    def __str__(self) -> str:
        return (
            f'{self.time:.6f} s (stamp {self.stamp} ns), {self.topic}, {self.field}: '
            f'recorded {self.recorded!r}, replayed {self.replayed!r}'
        )


class Comparison(NamedTuple):
    """One topic."""

    topic: str  # name in the bag
    values: int  # numbers compared
    difference: Difference | None
    left_out: str = ''  # what was not compared, and why not


class Commands(NamedTuple):
    """M replayed torques in the order in which they were commanded."""

    stamp: Stamps  # (M,) ns, of the last joint state before each
    torque: Floats  # (M, n) N m
    of_law: NDArray[np.bool_]  # (M,) torques of the law; the others are safe torques
    exact: NDArray[np.bool_]  # (M,) whether the same states led to it as in the recorded run
    number: NDArray[np.intp]  # (M,) of the recorded command

    def first(self, count: int) -> Commands:
        """The first `count` of them."""
        stamp, torque, of_law, exact, number = self
        end = slice(count)
        return Commands(stamp[end], torque[end], of_law[end], exact[end], number[end])


def expected(
    config: ControllerConfig, samples: Sample, monitored: Mapping[int, bytes]
) -> dict[Topic, Columns]:
    """Columns of every topic with a stamp over the replayed samples.

    Args:
        config: of the controller.
        samples: columns of N telemetry samples.
        monitored: messages of the monitor, by the number of their sample.
    """
    joints = config.joints
    errors = {'position': samples.xi1, 'velocity': samples.xi2, 'effort': samples.torque}
    return {
        TRACKING_ERROR: _of_joints(joints, errors),
        REFERENCE: _of_joints(joints, {'position': samples.qr, 'velocity': samples.dqr}),
        LEARNING: {
            **dict(zip(estimate_names(config), samples.estimate.T, strict=True)),
            **dict(zip(disturbance_names(joints), samples.disturbance.T, strict=True)),
            LAMBDA_MIN: samples.lambda_min[:, 0],
            LATCHED: samples.latched[:, 0],
        },
        MONITOR: _of_monitor(monitored, len(samples.xi1)),
    }


def _of_joints(joints: Sequence[str], fields: Mapping[str, Floats]) -> dict[str, Floats]:
    return {
        f'{field} of {joint}': column
        for field, values in fields.items()
        for joint, column in zip(joints, values.T, strict=True)
    }


def _of_monitor(monitored: Mapping[int, bytes], count: int) -> Columns:
    """Columns of the monitor; NaN between its messages."""
    if not monitored:
        return {}
    messages = list(monitored.values())
    names = joint_state_layout(messages[0]).names
    _, values = decode_joint_states(TopicMessages(MONITOR.resolved, raw=messages), names, ())
    table = np.full((count, len(names)), np.nan)
    table[list(monitored)] = values[:, 0]
    return dict(zip(names, table.T, strict=True))


def compare(
    content: Content,
    states: States,
    columns: Mapping[Topic, Columns],
    commands: Commands,
    joints: Sequence[str],
    gappy: Collection[str] = (),
) -> Iterator[Comparison]:
    """Compare each topic of the controller that the bag holds.

    Args:
        content: of the bag.
        states: that the law used.
        columns: replayed values of the topics with a stamp.
        commands: all replayed torques.
        joints: names of the joints.
        gappy: topics of which the recorder missed messages.

    Raises:
        UnreadableMessageError: a message cannot be decoded.
    """
    recorded = content.topics.get(COMMANDS)
    if recorded is not None:
        efforts = [f'effort of {joint}' for joint in joints]
        yield _compare_commands(recorded, commands, efforts, is_gappy=recorded.name in gappy)
    for topic, fields in columns.items():
        recorded = content.topics.get(topic)
        if recorded is not None:
            is_named = topic in (LEARNING, MONITOR)
            yield _compare_stamped(recorded, states, fields, is_named=is_named)


def first(comparisons: Sequence[Comparison]) -> Difference | None:
    """Earliest difference of all topics."""
    found = [one.difference for one in comparisons if one.difference is not None]
    return min(found, key=lambda difference: difference.stamp, default=None)


def _compare_commands(
    recorded: TopicMessages, commands: Commands, fields: Sequence[str], *, is_gappy: bool
) -> Comparison:
    """Compare commands by their number in the run: they have no stamp."""
    count = len(recorded.raw)
    due = int(np.argmin(np.append(commands.of_law, values=False)))
    if count < due or is_gappy:
        reason = f'{count} commands for {due} states that the law used, and they have no stamp'
        return Comparison(recorded.name, 0, None, reason)
    values = decode_arrays(recorded, len(fields))
    if values is None:
        return Comparison(recorded.name, 0, None, f'they are not {len(fields)} values each')
    number = commands.number
    # After a dropped state there may be more replayed torques than commands before the next event.
    later = np.append(np.minimum.accumulate(number[::-1])[::-1][1:], count)
    rows = np.flatnonzero((number < later) & (number < count))
    alike = np.all(_alike(values[number[rows]], commands.torque[rows]), axis=1)
    rows = rows[alike | ~_is_doubtful(alike, commands.exact[rows])]
    left_out = ''
    rest = np.delete(values, number[rows], axis=0)
    # The last command of a node that ends in order is zero, and has no state.
    if len(rest) > 1 or rest.any():
        left_out = (
            f'{len(rest)} torques that the bag does not determine: out of command, by states that '
            'the middleware dropped, or by the watchdog at the end'
        )
    columns = dict(zip(fields, commands.torque[rows].T, strict=True))
    stamps = States(commands.stamp[rows], commands.torque[rows])
    place = np.arange(rows.size)
    return _compare(recorded.name, stamps, place, columns, values[number[rows]], left_out)


def _is_doubtful(alike: NDArray[np.bool_], exact: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Rows of an inexact part from its first mismatch on."""
    k = np.arange(alike.size)
    last_mismatch = np.maximum.accumulate(np.where(exact | alike, -1, k))
    return np.asarray(last_mismatch > np.maximum.accumulate(np.where(exact, k, -1)))


def _compare_stamped(
    recorded: TopicMessages, states: States, columns: Columns, *, is_named: bool
) -> Comparison:
    names = joint_state_layout(recorded.raw[0]).names
    stamp, values = decode_joint_states(recorded, names, ())
    rows = np.searchsorted(states.stamp, stamp)
    known = np.isin(stamp, states.stamp)
    if is_named:
        fields = dict(zip(names, values[:, 0].T, strict=True))
    else:
        fields = {
            f'{field} of {joint}': values[:, f, j]
            for f, field in enumerate(JOINT_STATE_FIELDS)
            for j, joint in enumerate(names)
            if not np.isnan(values[:, f, j]).all()
        }
    shared = {field: column for field, column in columns.items() if field in fields}
    absent = [field for field in (*columns, *fields) if (field in columns) != (field in fields)]
    rows = rows[known]
    table = np.array([fields[field][known] for field in shared]).reshape(len(shared), rows.size).T
    return _compare(recorded.name, states, rows, shared, table, ', '.join(absent))


def _compare(
    topic: str,
    states: States,
    rows: NDArray[np.intp],
    columns: Columns,
    recorded: Floats,
    left_out: str = '',
) -> Comparison:
    replayed = (
        np.array([column[rows] for column in columns.values()]).reshape(len(columns), rows.size).T
    )
    unlike = ~_alike(recorded, replayed)
    difference = None
    if unlike.any():
        k, j = np.argwhere(unlike)[0]
        difference = Difference(
            topic,
            list(columns)[j],
            int(states.stamp[rows[k]]),
            float(states.time[rows[k]]),
            float(recorded[k, j]),
            float(replayed[k, j]),
        )
    return Comparison(topic, recorded.size, difference, left_out)


def _alike(recorded: Floats, replayed: Floats) -> NDArray[np.bool_]:
    """Where the bits are the same, or both are NaN."""
    bits = np.ascontiguousarray(recorded).view(np.int64)
    equal = bits == np.ascontiguousarray(replayed).view(np.int64)
    return np.asarray(equal | (np.isnan(recorded) & np.isnan(replayed)))
