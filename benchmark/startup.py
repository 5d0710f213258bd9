# SPDX-License-Identifier: Apache-2.0
"""From the command to the first torque, with compiled kernels at hand and without."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from contestant import Contestant, own_graph, wait_for
from timing import Ratio, ratio

from blf_dsc_controller.messages import topics

_ROUNDS = 3
_NULL = 'null node'
_WARM = 'controller, warm cache'
_COLD = 'controller, cold cache'
_POLL = 0.002  # s


def measure() -> Iterator[Ratio]:
    """Time to the first torque relative to the null node's."""
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
    import rclpy
    from rclpy.experimental import EventsExecutor

    from blf_dsc_controller.messages.telemetry import PlantTelemetry
    from blf_dsc_controller.nodes.endpoints import message_class, qos_profile

    context = rclpy.Context()
    rclpy.init(context=context)
    node: Any = rclpy.create_node('sim_plant', context=context)
    executor = EventsExecutor(context=context)
    executor.add_node(node)
    came: list[float] = []
    states, commands = topics.JOINT_STATES, topics.COMMANDS
    publisher = node.create_publisher(
        message_class(states.type), states.name, qos_profile(states.offered)
    )
    node.create_subscription(
        message_class(commands.type),
        commands.relative,
        lambda _torque: came.append(time.perf_counter()),
        qos_profile(commands.requested),
        raw=True,
    )
    encoder = PlantTelemetry(('joint1', 'joint2'), ())
    state = np.array((2.293, 1.696, 0.0, 0.0, 0.0, 0.0))
    if name == _NULL:
        command = [str(Path(__file__).with_name('null_node.py')), 'raw']
    else:
        command = ['-m', 'blf_dsc_controller.nodes.controller_node']
    begin = time.perf_counter()
    contestant = Contestant(name, command, {'NUMBA_CACHE_DIR': cache})
    stamps = itertools.count(1_000_000_000, 1_000_000)

    def ask() -> None:
        publisher.publish(encoder.joint_states(next(stamps), state)[1])
        executor.spin_once(timeout_sec=_POLL)

    try:
        wait_for(lambda: bool(came), 'the first torque', [contestant], ask)
    finally:
        contestant.end()
        executor.remove_node(node)
        node.destroy_node()
        rclpy.try_shutdown(context=context)
    return came[0] - begin
