# SPDX-License-Identifier: Apache-2.0
"""The controller node with and without the live view.

No browser has the page open: the controller pays only for the subscriptions; the view draws in a
process of its own, and only while a page is open.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from harness import Contestant, Ratio, own_graph, ratio
from node import _HEARD, _UNHEARD, Run, StandIn, _recorded_states, _started

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop

_ROUNDS = 7
_VIEWED = 'controller, telemetry and view on'
_BESIDE = _UNHEARD, _HEARD
_COMMAND = ('-m', 'blf_dsc_controller.view.node', '--ros-args', '-p', 'port:=8480')


def measure() -> Iterator[Ratio]:
    """Measure latency and CPU of the controller with the view relative to those without it."""
    loop = load_loop('recommended')
    runs: dict[str, list[Run]] = {name: [] for name in (*_BESIDE, _VIEWED)}
    states = _recorded_states(loop)
    with own_graph(), tempfile.TemporaryDirectory() as folder, closing(StandIn(states)) as arm:
        for k in range(_ROUNDS):
            for name, each in runs.items():
                path = Path(folder, f'{k}-{name}'.replace(' ', '_'))
                with _viewed(name, loop.controller, path) as these:
                    each.append(arm.play(these, 1e-3))
                arm.left_alone()
    group = 'view, real time at 1 kHz'
    percentiles = {'median': 50.0, 'p99.9': 99.9}
    for base in _BESIDE:
        for what, percentile in percentiles.items():
            latency = {
                name: np.array([np.percentile(run.latency, percentile) for run in each])
                for name, each in runs.items()
            }
            yield ratio(group, f'{_VIEWED}: {what} latency', base, latency[_VIEWED], latency[base])
        cpu = {name: np.array([run.cpu for run in each]) for name, each in runs.items()}
        yield ratio(group, f'{_VIEWED}: CPU', base, cpu[_VIEWED], cpu[base])


@contextmanager
def _viewed(name: str, config: ControllerConfig, path: Path) -> Iterator[list[Contestant]]:
    """Start the controller's processes, after that of the view if it is measured."""
    views = [Contestant('view', _COMMAND)] if name == _VIEWED else []
    try:
        with _started(_UNHEARD if views else name, config, path) as nodes:
            yield [*views, *nodes]
    finally:
        for view in views:
            view.end()
