# SPDX-License-Identifier: Apache-2.0
"""Time from the command to the first torque, with and without cached kernels."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from harness import Contestant, Ratio, own_graph, ratio, wait_for
from node import StandIn

from blf_dsc_controller.law.telemetry import PlantTelemetry

_ROUNDS = 3
_NULL = 'null node'
_WARM = 'controller, warm cache'
_COLD = 'controller, cold cache'
_POLL = 0.002  # s


def measure() -> Iterator[Ratio]:
    """Measure the time to the first torque relative to the null node's."""
    seconds: dict[str, list[float]] = {name: [] for name in (_NULL, _WARM, _COLD)}
    with own_graph(), tempfile.TemporaryDirectory() as caches:
        _first_torque(_WARM, f'{caches}/warm')
        for k in range(_ROUNDS):
            for name, values in seconds.items():
                cache = f'{caches}/{k}' if name == _COLD else f'{caches}/warm'
                values.append(_first_torque(name, cache))
    times = {name: np.array(values) for name, values in seconds.items()}
    for name in (_WARM, _COLD):
        note = f'{np.median(times[name]):.1f} s here'
        yield ratio('first torque', name, _NULL, times[name], times[_NULL], note)


def _first_torque(name: str, cache: str) -> float:
    encoder = PlantTelemetry(('joint1', 'joint2'), ())
    state = np.array((2.293, 1.696, 0.0, 0.0, 0.0, 0.0))
    stamps = itertools.count(1_000_000_000, 1_000_000)
    command = ['-m', 'blf_dsc_controller.nodes.controller_node']
    if name == _NULL:
        command = [str(Path(__file__).with_name('null_node.py')), 'raw']
    with closing(StandIn(())) as arm:

        def publish() -> None:
            arm.publisher.publish(encoder.joint_states(next(stamps), state)[1])
            arm.executor.spin_once(timeout_sec=_POLL)

        begin = time.perf_counter()
        contestant = Contestant(name, command, {'NUMBA_CACHE_DIR': cache})
        try:
            wait_for(lambda: arm.has_torque, 'the first torque', [contestant], publish)
            return time.perf_counter() - begin
        finally:
            contestant.end()
