# SPDX-License-Identifier: Apache-2.0
"""One bag as the page shows it: the run, its configuration, and what happened in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.metrics import latch_time, outside
from blf_dsc_controller.bags.context import Context, read_context
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.configuration.ros_yaml import Section, parse
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.messages.topics import DIAGNOSTICS
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.run import Run

_LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
_MOST_OF_A_KIND = 50
_NANO = 1e-9
_AT_LIMIT = 1.0 - 1e-9


@dataclass(frozen=True)
class Event:
    """Something that happened."""

    time: float  # s since the first sample
    kind: str
    text: str


@dataclass(frozen=True)
class ReportedBag:
    """A bag under the name that the page gives it."""

    name: str
    run: Run
    context: Context
    events: tuple[Event, ...]

    @property
    def sections(self) -> list[Section]:
        """Sections of the recorded configuration, none if it is not there or cannot be read."""
        try:
            return parse(self.context.configuration)
        except ConfigurationError:
            return []

    @property
    def parameters(self) -> dict[str, str]:
        """Every recorded parameter, `node name: parameter` to its value as text."""
        return {
            f'{section.pattern.removeprefix("/")}: {name}': _shown(entry.value)
            for section in self.sections
            for name, entry in sorted(section.entries.items())
        }

    @property
    def lengths(self) -> list[float]:
        """Length of each link [m]; one that is not recorded is that of the first link."""
        entries = {
            name: entry for section in self.sections for name, entry in section.entries.items()
        }
        count = len(self.run.joints)
        names = [name if (name := f'arm.l{i + 1}') in entries else 'arm.l1' for i in range(count)]
        return [float(str(entries[name].value)) if name in entries else 1.0 for name in names]


def read_bags(paths: Sequence[Path], namespace: str = '') -> list[ReportedBag]:
    """Read bags; each is named by its folder, and those above it where that is not enough.

    Raises:
        BlfDscError: one of them cannot be read.
    """
    names = _names(paths)
    return [_read(path, name, namespace) for path, name in zip(paths, names, strict=True)]


def _names(paths: Sequence[Path]) -> list[str]:
    parts = [path.resolve().parts[1:] for path in paths]
    depth = 1
    while len({one[-depth:] for one in parts}) < len({*parts}):
        depth += 1
    names = ['/'.join(one[-depth:]) for one in parts]
    if set(names) == {'bag'}:
        names = ['/'.join(one[-2:]) for one in parts]
    return [
        f'{name} ({names[: k + 1].count(name)})' if names.count(name) > 1 else name
        for k, name in enumerate(names)
    ]


def _read(path: Path, name: str, namespace: str) -> ReportedBag:
    run, context = read_run(path, namespace), read_context(path)
    events = [*_events(run), *_diagnosed(path, run)]
    events += (Event(0.0, 'lost', f'{topic}: {text}') for topic, text in context.losses.items())
    return ReportedBag(name, run, context, tuple(sorted(events, key=lambda event: event.time)))


def _events(run: Run) -> Iterator[Event]:
    latched, violated = latch_time(run), outside(run)
    if latched is not None:
        yield Event(latched, 'learning', 'the first window was excited enough: learning began')
    for column, reason in run.rejected.items():
        text = reason or f'{column} is not estimated: its column was rejected'
        yield Event(run.duration, 'learning', text)
    if violated is not None:
        yield from _spells(run, violated, 'violation', 'outside of its bound')
    if run.torque_limit is not None:
        limited = np.abs(run.torque) >= _AT_LIMIT * run.torque_limit
        yield from _spells(run, limited, 'saturation', 'at its torque limit')


def _spells(run: Run, holds: np.ndarray, kind: str, what: str) -> Iterator[Event]:
    for i, joint in enumerate(run.joints):
        edges = np.diff(np.concatenate([[0], holds[:, i].astype(np.int8), [0]]))
        begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
        for begin, end in list(zip(begins, ends, strict=True))[:_MOST_OF_A_KIND]:
            text = f'{joint} {what} for {end - begin} samples'
            yield Event(float(run.time[begin]), kind, text)
        if begins.size > _MOST_OF_A_KIND:
            more = begins.size - _MOST_OF_A_KIND
            at = float(run.time[begins[_MOST_OF_A_KIND]])
            yield Event(at, kind, f'{joint}: {more} more spells, which are left out here')


def _diagnosed(path: Path, run: Run) -> Iterator[Event]:
    """Each change of a level or a message, at the time of the sample received last."""
    said: dict[str, tuple[int, str]] = {}
    with open_bag(path) as bag:
        if (DIAGNOSTICS.resolved, DIAGNOSTICS.type) not in bag.held:
            return
        for _, received, raw in bag.messages({DIAGNOSTICS.resolved}):
            message: Any = typestore().deserialize_cdr(raw, DIAGNOSTICS.type)
            for status in message.status:
                now = (int(status.level), str(status.message))
                if said.get(status.name) == now:
                    continue
                said[status.name] = now
                level = _LEVELS[min(now[0], len(_LEVELS) - 1)]
                yield Event(_moment(run, received), level, f'{status.name}: {now[1]}')


def _moment(run: Run, received: int) -> float:
    k = int(np.searchsorted(run.received, received)) - 1
    if k < 0:
        return (received - int(run.received[0])) * _NANO
    return float(run.time[k])


def _shown(value: object) -> str:
    return f'[{", ".join(map(_shown, value))}]' if isinstance(value, list) else f'{value}'
