# SPDX-License-Identifier: Apache-2.0
"""Bit-for-bit comparison of replayed outputs with recorded ones, block by block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.topic_messages import JointStates
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.law.telemetry import DECIMATION, Monitor, columns_of, learning_of
from blf_dsc_controller.messages.cdr import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.topics import (
    BOUND,
    COMMANDS,
    DIAGNOSTICS,
    LEARNING,
    MONITOR,
    REFERENCE,
    STATE,
    TRACKING_ERROR,
    Topic,
)
from blf_dsc_controller.run import Floats, Series, Stamps
from blf_dsc_controller.supervision.guard import Guard

_BLOCK = 4096  # outputs compared at once


class Difference(NamedTuple):
    """The first number of a topic that differs."""

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


@dataclass
class Comparison:
    """Result of comparing one topic."""

    topic: str  # name in the bag
    recorded: int  # numbers in the bag that a complete replay would give
    values: int = 0  # numbers compared
    difference: Difference | None = None
    largest: float = 0.0  # difference of two numbers; infinite if only one of them is finite
    left_out: str = ''  # what was not compared, and why

    def add(
        self, stamp: Stamps, start: int, names: Sequence[str], recorded: Floats, replayed: Floats
    ) -> None:
        """Compare tables (N, names) with the stamps (N,) of a run that began at `start`."""
        self.values += recorded.size
        bits = np.ascontiguousarray(recorded).view(np.int64)
        unlike = bits != np.ascontiguousarray(replayed).view(np.int64)
        unlike &= ~(np.isnan(recorded) & np.isnan(replayed))
        if not unlike.any():
            return
        with np.errstate(invalid='ignore', over='ignore'):
            sizes = np.abs(recorded[unlike] - replayed[unlike])
        self.largest = max(self.largest, float(np.nan_to_num(sizes, nan=np.inf).max()))
        if self.difference is None:
            k, j = np.argwhere(unlike)[0]
            pair = float(recorded[k, j]), float(replayed[k, j])
            time = (int(stamp[k]) - start) * 1e-9
            self.difference = Difference(self.topic, names[j], int(stamp[k]), time, *pair)


class Comparer:
    """Compares a guard's outputs with those of a bag as they are added.

    Attributes:
        count, safe_torques: number of samples of the law, and of torques that are not the law's.
        first, last: stamps [ns] of its first and last sample; -1 before the first.
        results: by topic.
    """

    def __init__(self, content: Content, guard: Guard, answers: JointStates | None) -> None:
        """Compare with `content`; `answers` are the messages on tracking errors, in order."""
        self._guard, joints = guard, guard.config.joints
        self._joints, self._estimates = joints, estimate_names(guard.config)
        self._answers = answers
        self.count = self.safe_torques = 0
        self.first = self.last = -1
        self._monitor: Monitor | None = None
        self._bound = b''
        self._rows = np.empty((_BLOCK, guard.controller.sample_vector.size))
        self._stamps: list[int] = []  # of these samples [ns]
        n = len(joints)
        self._answers_rows = np.empty((_BLOCK, 3 * n))  # [xi1, xi2, torque]
        self._answered: list[tuple[int, bool]] = []  # their stamps, and whether they are certain
        self._torques = np.empty((_BLOCK, n))
        self._commands: list[tuple[int, int]] = []  # their stamps and numbers
        self._monitored: list[tuple[int, list[float]]] = []
        self._bounds: list[tuple[int, Floats]] = []
        self._compared = {TRACKING_ERROR: 0, BOUND: 0}  # messages, in order
        self._series: dict[Topic, Series] = {}
        self._names: dict[Topic, tuple[str, ...]] = {COMMANDS: _names(joints, ['effort'])}
        self._recorded: dict[Topic, JointStates] = {}
        self.results: dict[Topic, Comparison] = {}
        for topic, fields in (
            (COMMANDS, (0,)),
            (TRACKING_ERROR, (0, 1, 2)),
            (REFERENCE, (0, 1)),
            (LEARNING, (0,)),
            (MONITOR, (0,)),
            (BOUND, (0, 2)),
        ):
            self._open(content, topic, fields)
        self._fields = {REFERENCE: (0, 1), LEARNING: (0,), MONITOR: (0,)}

    def _open(self, content: Content, topic: Topic, fields: Sequence[int]) -> None:
        messages = content.topics.get(topic)
        if messages is None:
            return
        count = len(self._joints)
        if topic is COMMANDS:
            found = messages.arrays(count)
        elif topic in (LEARNING, MONITOR):
            found = messages.vectors()
            count = len(found.names)
        else:
            found = messages.joint_states(self._joints, ())
            self._names[topic] = _names(self._joints, [JOINT_STATE_FIELDS[k] for k in fields])
        result = Comparison(messages.name, messages.size * count * len(fields))
        self.results[topic] = result
        if found is None:
            result.left_out = f'they do not have {count} values each'
            return
        self._recorded[topic] = found if topic in (COMMANDS, BOUND) else found.by_stamp()
        if topic is COMMANDS:
            self._numbers = found.sequence
            if not self._numbers.any():  # of another recorder
                self._numbers = np.arange(1, found.size + 1)
                if self._answers is not None and found.size < self._answers.size:
                    result.left_out = 'some are missing, and they have neither stamps nor numbers'
                    del self._recorded[topic]
            elif (np.diff(self._numbers) <= 0).any():
                result.left_out = 'they are of several publishers'
                del self._recorded[topic]

    # Outputs of the guard.

    def add_sample(self, stamp: int) -> None:
        """Add the last sample of the law, for the state with this stamp [ns]."""
        guard, controller = self._guard, self._guard.controller
        sample = controller.sample
        if self.first < 0:
            self.first = stamp
        self._rows[len(self._stamps)] = controller.sample_vector
        self._stamps.append(stamp)
        self.last, self.count = stamp, self.count + 1
        if controller.samples == 1 or self._monitor is None:
            self._monitor = Monitor(self._joints, self._estimates, controller.settings)
            self._bound = b''
        if sample.bound.tobytes() != self._bound:
            self.add_bound(stamp, sample.bound)
        if (controller.samples - 1) % DECIMATION == 0:
            values = self._monitor.values(stamp, sample, guard.samples.ratio, sample.bound)
            self._monitored.append((stamp, values))

    def add_bound(self, stamp: int, bound: Floats) -> None:
        """Add a bound [rad], published with this stamp [ns]."""
        self._bound = bound.tobytes()
        limit = self._guard.controller.settings.torque_limit
        self._bounds.append((stamp, np.concatenate((bound, limit))))

    def add_command(self, stamp: int, torque: Floats, *, is_answer: bool, is_certain: bool) -> None:
        """Add a commanded torque (n,) [N m] after a state with this stamp [ns].

        `is_answer`: it answers a message. One that is not certain is not compared.
        """
        n, guard = torque.size, self._guard
        if is_certain:
            self._torques[len(self._commands)] = torque
            self._commands.append((stamp, guard.journal.commands))
        if is_answer:
            row = self._answers_rows[len(self._answered)]
            row[2 * n :] = torque
            row[: 2 * n] = np.nan
            if guard.has_sample:
                row[:n], row[n : 2 * n] = guard.controller.sample.xi1, guard.controller.sample.xi2
            self._answered.append((stamp, is_certain))
        self.safe_torques += not guard.has_sample
        if _BLOCK in (len(self._commands), len(self._answered)):
            self.flush()

    # Comparison.

    def flush(self) -> None:
        """Compare what has been added since the last call."""
        stamp = np.array(self._stamps, dtype=np.int64)
        samples = columns_of(self._rows[: stamp.size], self._guard.controller.settings)
        self._compare_series(REFERENCE, Series(
            self._names.get(REFERENCE, ()), stamp, np.hstack((samples.qr, samples.dqr))
        ))  # fmt: skip
        self._compare_series(LEARNING, learning_of(self._guard.config, stamp, samples))
        if self._monitor is not None and self._monitored:
            at, values = zip(*self._monitored, strict=True)
            monitored = Series(self._monitor.names, np.array(at), np.array(values))
            self._compare_series(MONITOR, monitored)
        stamps, certain = [at for at, _ in self._answered], [sure for _, sure in self._answered]
        rows = self._answers_rows[: len(stamps)]
        self._compare_in_order(TRACKING_ERROR, self._answers, stamps, rows, (0, 1, 2), certain)
        stamps, bounds = [at for at, _ in self._bounds], [bound for _, bound in self._bounds]
        self._compare_in_order(BOUND, self._recorded.get(BOUND), stamps, bounds, (0, 2))
        self._compare_commands()
        for waiting in (
            self._stamps,
            self._monitored,
            self._answered,
            self._bounds,
            self._commands,
        ):
            waiting.clear()

    def _compare_series(self, topic: Topic, replayed: Series) -> None:
        """Compare values of the same name and stamp."""
        recorded, result = self._recorded.get(topic), self.results.get(topic)
        if recorded is None or result is None or not replayed.stamp.size:
            return
        if topic not in self._series:
            self._series[topic] = recorded.series()
        stamps = self._series[topic].stamp
        index = np.minimum(np.searchsorted(stamps, replayed.stamp), stamps.size - 1)
        known = stamps[index] == replayed.stamp
        rows, at = index[known], replayed.stamp[known]
        if topic is REFERENCE:
            values = np.hstack([recorded.field(k, rows) for k in (0, 1)])
            result.add(at, self.first, replayed.names, values, replayed.values[known])
            return
        shared = [name for name in replayed.names if name in recorded.names]
        absent = {*replayed.names, *recorded.names}.difference(shared)
        both = dict.fromkeys((*replayed.names, *recorded.names))
        result.left_out = ', '.join(name for name in both if name in absent)
        result.recorded = stamps.size * len(shared)
        columns = np.array([recorded.names.index(name) for name in shared], np.intp)
        own = replayed.select(shared)[known]
        result.add(at, self.first, shared, recorded.field(0, rows, columns), own)

    def _compare_in_order(
        self,
        topic: Topic,
        recorded: JointStates | None,
        stamps: Sequence[int],
        replayed: Sequence[Floats] | Floats,
        fields: Sequence[int],
        certain: Sequence[bool] = (),
    ) -> None:
        """Compare messages by their number; one with another stamp differs."""
        if recorded is None or topic not in self.results:
            return
        begin = self._compared[topic]
        count = min(len(stamps), recorded.size - begin)
        self._compared[topic] += count
        if count <= 0:
            return
        rows = slice(begin, begin + count)
        known = np.array(certain[:count], np.bool_) if certain else np.ones(count, np.bool_)
        at, own = np.array(stamps[:count])[known], np.array(replayed[:count])[known]
        values = np.hstack([recorded.field(k, rows)[known] for k in fields])
        own[recorded.select(rows).stamp[known] != at] = np.inf
        self.results[topic].add(at, self.first, self._names[topic], values, own)

    def _compare_commands(self) -> None:
        """Compare commands by the number that their publisher gave them."""
        recorded = self._recorded.get(COMMANDS)
        if recorded is None or not self._commands:
            return
        stamps, number = np.array(self._commands).T
        torques = self._torques[: number.size]
        index = np.minimum(np.searchsorted(self._numbers, number), self._numbers.size - 1)
        known = self._numbers[index] == number
        at, own = stamps[known], torques[known]
        values = recorded.field(0, index[known])
        self.results[COMMANDS].add(at, self.first, self._names[COMMANDS], values, own)

    @property
    def duration(self) -> float:
        """Time from the first sample of the law to the last [s]."""
        return (self.last - self.first) * 1e-9

    def finish(self) -> Iterator[Comparison]:
        """Yield the results."""
        self.flush()
        commands, n = self.results.get(COMMANDS), len(self._joints)
        if commands is not None and COMMANDS in self._recorded:
            rest = (commands.recorded - commands.values) // n
            last = self._recorded[COMMANDS].field(0, slice(-1, None))
            # The last command of a node that shuts down normally is zero and belongs to no state.
            if rest == 1 and not last.any():
                commands.recorded -= n
            elif rest:
                commands.left_out = f'{rest} torques that the replay does not reach'
        yield from self.results.values()


def not_compared(content: Content) -> Iterator[str]:
    """Yield the controller's topics in a bag that hold text, not numbers."""
    for topic in (STATE, DIAGNOSTICS):
        if topic in content.topics:
            yield content.topics[topic].name


def _names(joints: Sequence[str], fields: Sequence[str]) -> tuple[str, ...]:
    return tuple(f'{field} of {joint}' for field in fields for joint in joints)
