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
    first_layout,
)
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.messages.codecs import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.samples import learning_of
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    LEARNING,
    MONITOR,
    REFERENCE,
    TRACKING_ERROR,
    Topic,
)
from blf_dsc_controller.replay.rerun import Commands, Difference, Rerun
from blf_dsc_controller.run import Floats, Stamps

Columns = Mapping[str, Floats]  # values (N,) by field, such as `velocity of joint1`, `lambda_min`


class Comparison(NamedTuple):
    """One topic."""

    topic: str  # name in the bag
    values: int  # numbers compared
    difference: Difference | None
    left_out: str = ''  # what was not compared, and why not


def compare(
    content: Content, config: ControllerConfig, run: Rerun, gappy: Collection[str] = ()
) -> Iterator[Comparison]:
    """Compare each topic of the controller that the bag holds.

    `gappy` are topics of which the recorder missed messages.

    Raises:
        UnreadableMessageError: a message cannot be decoded.
    """
    recorded = content.topics.get(COMMANDS)
    if recorded is not None:
        efforts = [f'effort of {joint}' for joint in config.joints]
        is_gappy = recorded.name in gappy
        yield _compare_commands(recorded, run.commands, efforts, is_gappy=is_gappy)
    stamps = run.states.stamp
    for topic, columns in _expected(config, run).items():
        recorded = content.topics.get(topic)
        if recorded is not None:
            is_named = topic in (LEARNING, MONITOR)
            yield _compare_stamped(recorded, stamps, columns, is_named=is_named)


def _expected(config: ControllerConfig, run: Rerun) -> dict[Topic, Columns]:
    """Columns of every topic with a stamp over the replayed samples; NaN between two messages."""
    joints, samples = config.joints, run.samples
    learning = learning_of(config, run.states.stamp, samples)
    errors = {'position': samples.xi1, 'velocity': samples.xi2, 'effort': samples.torque}
    monitor: dict[str, Floats] = {}
    if run.monitored:
        messages = TopicMessages(MONITOR.resolved, raw=list(run.monitored.values()))
        names = first_layout(messages).names
        _, values = decode_joint_states(messages, names, ())
        table = np.full((len(samples.xi1), len(names)), np.nan)
        table[list(run.monitored)] = values[:, 0]
        monitor = dict(zip(names, table.T, strict=True))
    return {
        TRACKING_ERROR: _of_joints(joints, errors),
        REFERENCE: _of_joints(joints, {'position': samples.qr, 'velocity': samples.dqr}),
        LEARNING: dict(zip(learning.names, learning.values.T, strict=True)),
        MONITOR: monitor,
    }


def _of_joints(joints: Sequence[str], fields: Mapping[str, Floats]) -> dict[str, Floats]:
    return {
        f'{field} of {joint}': column
        for field, values in fields.items()
        for joint, column in zip(joints, values.T, strict=True)
    }


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
    # Where the states in between are not certain, compare up to the first mismatch.
    exact, k = commands.exact[rows], np.arange(rows.size)
    mismatch = np.maximum.accumulate(np.where(exact | alike, -1, k))
    rows = rows[alike | (mismatch <= np.maximum.accumulate(np.where(exact, k, -1)))]
    left_out = ''
    rest = np.delete(values, number[rows], axis=0)
    # The last command of a node that ends in order is zero, and has no state.
    if len(rest) > 1 or rest.any():
        left_out = (
            f'{len(rest)} torques that the bag does not determine: out of command, by states that '
            'the middleware dropped, or by the watchdog at the end'
        )
    stamp, torque = commands.stamp[rows], commands.torque[rows]
    return _compare(recorded.name, stamp, stamp[:1], fields, values[number[rows]], torque, left_out)


def _compare_stamped(
    recorded: TopicMessages, stamps: Stamps, columns: Columns, *, is_named: bool
) -> Comparison:
    names = first_layout(recorded).names
    stamp, values = decode_joint_states(recorded, names, ())
    known = np.isin(stamp, stamps)
    if is_named:
        fields = dict(zip(names, values[:, 0].T, strict=True))
    else:
        by_field = dict(zip(JOINT_STATE_FIELDS, values.swapaxes(0, 1), strict=True))
        fields = _of_joints(names, by_field)
        fields = {name: column for name, column in fields.items() if not np.isnan(column).all()}
    shared = [field for field in columns if field in fields]
    absent = [field for field in (*columns, *fields) if (field in columns) != (field in fields)]
    stamp = stamp[known]
    rows = np.searchsorted(stamps, stamp)
    shape = len(shared), rows.size
    return _compare(
        recorded.name,
        stamp,
        stamps[:1],
        shared,
        np.array([fields[field][known] for field in shared]).reshape(shape).T,
        np.array([columns[field][rows] for field in shared]).reshape(shape).T,
        ', '.join(absent),
    )


def _compare(
    topic: str,
    stamp: Stamps,
    start: Stamps,
    fields: Sequence[str],
    recorded: Floats,
    replayed: Floats,
    left_out: str,
) -> Comparison:
    """Compare tables (N, fields) with the stamps (N,), of a run that began at `start` (1,)."""
    difference = None
    for k, j in np.argwhere(~_alike(recorded, replayed))[:1]:
        time = float((stamp[k] - start[0]) * 1e-9)
        pair = float(recorded[k, j]), float(replayed[k, j])
        difference = Difference(topic, fields[j], int(stamp[k]), time, *pair)
    return Comparison(topic, recorded.size, difference, left_out)


def _alike(recorded: Floats, replayed: Floats) -> NDArray[np.bool_]:
    """Where the bits are the same, or both are NaN."""
    bits = np.ascontiguousarray(recorded).view(np.int64)
    equal = bits == np.ascontiguousarray(replayed).view(np.int64)
    return np.asarray(equal | (np.isnan(recorded) & np.isnan(replayed)))
