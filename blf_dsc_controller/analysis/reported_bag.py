# SPDX-License-Identifier: Apache-2.0
"""One bag as shown on the page: the run, its configuration and its events."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.analysis.drawn_arm import DrawnArm, arm_of_chain, planar_arm
from blf_dsc_controller.analysis.metrics import change_times, latch_time, outside
from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.reader import recorded_run
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import CONTROLLER, DIAGNOSTICS, PLANT
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.run import Run

_LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
_MOST_OF_A_KIND = 50
_LONGEST = 1000  # characters of a parameter that is shown in full
_AT_LIMIT = 1.0 - 1e-9


class ReportedEvent(NamedTuple):
    """An event of a run."""

    time: float  # s since the first sample
    kind: str
    text: str


@dataclass(frozen=True)
class ReportedBag:
    """A bag with its name on the page."""

    name: str
    run: Run
    content: Content
    parameters: dict[str, str]  # `node name: parameter` to its value as text
    arm: DrawnArm
    events: list[ReportedEvent]  # by time


def read_bags(
    paths: Sequence[Path], namespace: str = '', names: NameMap = NO_NAMES
) -> list[ReportedBag]:
    """Read bags; each is named by its folder, with parent folders if that is ambiguous.

    Raises:
        BlfDscError: one of them cannot be read.
    """
    titles = zip(paths, _names(paths), strict=True)
    return [_read(path, title, namespace, names) for path, title in titles]


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


def _read(path: Path, name: str, namespace: str, names: NameMap) -> ReportedBag:
    content = read_content(path, namespace, names)
    run = recorded_run(content, names, namespace)
    configured = content.configurations
    lost = (
        ReportedEvent(0.0, 'lost', f'{topic}: {text}') for topic, text in content.losses.items()
    )
    left_out = (ReportedEvent(0.0, 'left out', note) for note in run.notes)
    arm, problem = _drawn(content, configured, len(run.joints))
    unread = [ReportedEvent(0.0, 'arm', problem)] if problem else []
    events = (
        *unread, *left_out, *_events(run), *_diagnosed(content, run), *_changed(content, run), *lost
    )  # fmt: skip
    return ReportedBag(
        name,
        run,
        content,
        parameters={
            f'{node}: {parameter}': _shown(value)
            for node in sorted(configured)
            for parameter, value in sorted(configured[node].items())
        },
        arm=arm,
        events=sorted(events, key=lambda event: event.time),
    )


def _drawn(
    content: Content, configured: Mapping[str, Mapping[str, Any]], n: int
) -> tuple[DrawnArm, str]:
    """Return the arm of the recorded URDF, else a planar one; and why a URDF cannot be read."""
    problem = ''
    if configured.get(CONTROLLER, {}).get('model') == 'urdf':
        try:
            config = content.controller_config()
            return arm_of_chain(config.robot.chain(config.joints)), ''
        except BlfDscError as error:
            problem = f'drawn as links in a plane, as its URDF cannot be read: {error}'
    # Links without a length take that of the first.
    known = configured.get(PLANT, {})
    lengths = (known.get(f'arm.l{i + 1}', known.get('arm.l1', 1.0)) for i in range(n))
    return planar_arm([float(f'{length}') for length in lengths]), problem


def _events(run: Run) -> Iterator[ReportedEvent]:
    latched = latch_time(run)
    if latched is not None:
        yield ReportedEvent(latched, 'learning', 'first excited window: learning began')
    for t in change_times(run):
        yield ReportedEvent(t, 'learning', 'the arm has changed: learning restarted')
    for column, reason in run.rejected.items():
        text = reason or f'{column} is not estimated: its column was rejected'
        yield ReportedEvent(run.duration, 'learning', text)
    for t, stop in run.timed_stops:
        yield ReportedEvent(t, 'stop', f'{stop.reason}: {stop.text}')
    for i, joint in enumerate(run.joints):
        violated = outside(run, i)
        if violated is not None:
            yield from _intervals(run, violated, 'violation', joint, 'outside its bound')
        torque, limit = run.column('torque', i), run.column('torque_limit', i)
        if torque is not None and limit is not None:
            limited = np.abs(torque) >= _AT_LIMIT * limit
            yield from _intervals(run, limited, 'saturation', joint, 'at its torque limit')


def _intervals(
    run: Run, holds: np.ndarray, kind: str, joint: str, what: str
) -> Iterator[ReportedEvent]:
    edges = np.diff(np.concatenate([[0], holds.astype(np.int8), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    times = run.time_of(run.stamp[begins])
    for time, begin, end in list(zip(times, begins, ends, strict=True))[:_MOST_OF_A_KIND]:
        yield ReportedEvent(float(time), kind, f'{joint} {what} for {end - begin} samples')
    if begins.size > _MOST_OF_A_KIND:
        text = f'{joint}: {begins.size - _MOST_OF_A_KIND} more intervals, not listed'
        yield ReportedEvent(float(times[_MOST_OF_A_KIND]), kind, text)


def _diagnosed(content: Content, run: Run) -> Iterator[ReportedEvent]:
    """Yield each change of a level or message, at the time of the last sample received."""
    shown: dict[str, tuple[int, str]] = {}
    messages = content.topics.get(DIAGNOSTICS)
    for received, raw in zip(messages.received, messages.raw, strict=True) if messages else ():
        message: Any = typestore().deserialize_cdr(raw, DIAGNOSTICS.type)
        k = int(np.searchsorted(run.received, received)) - 1
        time = float(run.time[k]) if k >= 0 else (received - int(run.received[0])) * 1e-9
        for status in message.status:
            now = (int(status.level), str(status.message))
            if shown.get(status.name) != now:
                shown[status.name] = now
                level = _LEVELS[min(now[0], len(_LEVELS) - 1)]
                yield ReportedEvent(time, level, f'{status.name}: {now[1]}')


def _changed(content: Content, run: Run) -> Iterator[ReportedEvent]:
    """Yield each change of the simulated plant's parameters during the run."""
    for change in content.changes:
        time = (change['stamp'] - int(run.stamp[0])) * 1e-9
        for parameter, value in () if change.get('configured') else change['parameters'].items():
            yield ReportedEvent(time, 'plant', f'{parameter}: {_shown(value)}')


def _shown(value: object) -> str:
    if isinstance(value, str) and len(value) > _LONGEST:  # a URDF
        digest = zlib.crc32(value.encode())
        return f'{value[:40]} ... ({len(value)} characters, CRC {digest:08x})'
    return f'[{", ".join(map(_shown, value))}]' if isinstance(value, list) else f'{value}'
