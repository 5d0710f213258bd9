# SPDX-License-Identifier: Apache-2.0
"""The controller's node against a null node, which answers without decoding messages.

This process stands in for the plant. Every contestant is restarted in
each round, as a process of its own. The controller gets the joint states of a simulated run, first
each as soon as the torque before has arrived, then one a millisecond.
"""

from __future__ import annotations

import gc
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from harness import Contestant, ContestantError, Ratio, own_graph, ratio, wait_for

from blf_dsc_controller.configuration.controller import ControllerConfig, Telemetry
from blf_dsc_controller.configuration.nodes import CONTROLLER, LoopConfig, dump, load_loop
from blf_dsc_controller.law.telemetry import PlantTelemetry
from blf_dsc_controller.messages import topics
from blf_dsc_controller.simulation.loop import simulate

_ROUNDS = 3
_STARTS = 2
_STEPS = 2000  # of each mode
_WARM_UP = 500
_START = 1_000_000_000
_PERIOD = 1e-3  # s
_SETTLING = 0.5  # s for discovery, or for a message to arrive
_PATIENCE = 60.0  # s for one torque
_RATE = 'steps a second'
_NULL = 'null node'
_QUIET = 'controller, telemetry off'
_UNHEARD = 'controller, telemetry on, no subscriber'
_HEARD = 'controller, telemetry on, a subscriber'
_RECORDED = 'controller, telemetry on, recorder'
_GROUPS = {  # preset, title, contestants
    'recommended': ('node', (_NULL, _QUIET, _UNHEARD, _HEARD, _RECORDED)),
    'panda': ('node with seven joints', (_NULL, _QUIET, _RECORDED)),
}
_WARM = 'controller, warm cache'
_COLD = 'controller, cold cache'
_NULL_NODE = str(Path(__file__).with_name('null_node.py'))
_CONTROLLER_NODE = ['-m', 'blf_dsc_controller.nodes.controller_node']
_RECORDER_NODE = ['-m', 'blf_dsc_controller.nodes.recorder_node', '--ros-args', '-p']


class StandIn:
    """Stand-in for the plant that publishes recorded states and waits for torques."""

    def __init__(self, messages: Sequence[bytes]) -> None:
        import rclpy
        from rclpy.experimental import EventsExecutor

        from blf_dsc_controller.nodes.endpoints import message_class, qos_profile

        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        # Nodes of one name would conflict on /rosout.
        self.node: Any = rclpy.create_node('sim_plant', context=self.context, enable_rosout=False)
        self.executor: Any = EventsExecutor(context=self.context)
        self.executor.add_node(self.node)
        states, commands = topics.JOINT_STATES, topics.COMMANDS
        self.commands = commands.relative
        self.publisher: Any = self.node.create_publisher(
            message_class(states.type), states.name, qos_profile(states.offered)
        )
        self.node.create_subscription(
            message_class(commands.type),
            commands.relative,
            self._take,
            qos_profile(commands.requested),
            raw=True,
        )
        self.has_torque = False
        self.messages = iter(messages)

    def _take(self, _torque: bytes) -> None:
        self.has_torque = True

    def greet(self, contestants: Sequence[Contestant]) -> None:
        """Send the first state until its torque arrives: a half-matched reader loses messages.

        The last of the contestants is the measured node; the others run beside it.
        """
        takers = len(contestants)  # a recorder subscribes to the states, too
        self._wait_for(lambda: self.publisher.get_subscription_count() == takers, contestants)
        self._wait_for(lambda: self.node.count_publishers(self.commands) == 1, contestants)
        self._spin_for(_SETTLING)
        first, self.has_torque = next(self.messages), False

        def send() -> None:
            self.publisher.publish(first)
            self._spin_for(_SETTLING)

        what = f'the first torque of {contestants[-1].name}'
        wait_for(lambda: self.has_torque, what, contestants, send)

    def play(self, node: Contestant, period: float) -> dict[str, float]:
        """Publish states, one per `period` [s] or, if 0, each after the previous torque.

        Returns latencies [s], from state published to torque received, CPU [s] of the node's
        process, and steps a second.
        """
        latency = np.zeros(_WARM_UP + _STEPS)
        begin, busy = time.perf_counter(), node.cpu_time()
        for k in range(latency.size):
            if k == _WARM_UP:
                begin, busy = time.perf_counter(), node.cpu_time()
            due = begin + (k if k < _WARM_UP else k - _WARM_UP) * period
            while period and (left := due - time.perf_counter()) > 0.0:
                self.executor.spin_once(timeout_sec=left)
            self.has_torque = False
            sent = time.perf_counter()
            self.publisher.publish(next(self.messages))
            while not self.has_torque:
                self.executor.spin_once(timeout_sec=_PATIENCE)
                if time.perf_counter() - sent > _PATIENCE:
                    node.check()
                    raise ContestantError(f'{node.name}: no torque for state {k}')
            latency[k] = time.perf_counter() - sent
        rate, cpu = _STEPS / (time.perf_counter() - begin), node.cpu_time() - busy
        median, most = np.percentile(latency[_WARM_UP:], (50.0, 99.9)).tolist()
        return {'median latency': median, 'p99.9 latency': most, 'CPU': cpu, _RATE: rate}

    def _spin_for(self, seconds: float) -> None:
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            self.executor.spin_once(timeout_sec=0.01)

    def left_alone(self) -> None:
        """Wait until the last contestant has disappeared."""
        self._wait_for(lambda: self.publisher.get_subscription_count() == 0)
        self._wait_for(lambda: self.node.count_publishers(self.commands) == 0)

    def close(self) -> None:
        """Destroy the stand-in's node, so that no participant is left in a later round."""
        self.executor.remove_node(self.node)
        self.node.destroy_node()
        self.context.try_shutdown()
        self.node = self.publisher = self.executor = None
        gc.collect()

    def _wait_for(
        self, condition: Callable[[], bool], contestants: Sequence[Contestant] = ()
    ) -> None:
        what = f'{contestants[-1].name} to appear' if contestants else 'a contestant to disappear'
        wait_for(condition, what, contestants, lambda: self.executor.spin_once(timeout_sec=0.05))


def measure() -> Iterator[Ratio]:
    """Measure latency, CPU and lock-step rate of the controller relative to the null node."""
    for preset, (group, names) in _GROUPS.items():
        loop = load_loop(preset)
        states = _recorded_states(loop)
        real: list[dict[str, dict[str, float]]] = []  # a round: figures by contestant
        lockstep: list[dict[str, dict[str, float]]] = []
        with own_graph(), tempfile.TemporaryDirectory() as folder, closing(StandIn(())) as arm:
            for k in range(_ROUNDS):
                real.append({})
                lockstep.append({})
                for name in names:
                    path = Path(folder, f'{k}-{name}'.replace(' ', '_'))
                    arm.messages = iter(states)
                    with _started(name, loop.controller, path) as contestants:
                        arm.greet(contestants)
                        lockstep[k][name] = arm.play(contestants[-1], 0.0)
                        real[k][name] = arm.play(contestants[-1], _PERIOD)
                        for contestant in contestants:
                            contestant.check()
                    arm.left_alone()
        shown = [(f'{group}, real time at 1 kHz', what, real) for what in [*real[0][_NULL]][:-1]]
        for title, what, rounds in [*shown, (f'{group}, lock-step', _RATE, lockstep)]:
            values = {name: np.array([each[name][what] for each in rounds]) for name in names}
            for name in names[1:]:
                here = f'{np.median(values[name]):.0f} here' if what == _RATE else ''
                yield ratio(title, f'{name}: {what}', _NULL, values[name], values[_NULL], here)


@contextmanager
def _started(name: str, config: ControllerConfig, path: Path) -> Iterator[list[Contestant]]:
    """Start a contestant's processes: its subscriber or recorder, if it has one, then its node."""
    commands = [[_NULL_NODE, CONTROLLER]]
    if name != _NULL:
        params = path.with_suffix('.yaml')
        telemetry = Telemetry(enabled=name != _QUIET)
        observers = int(name == _RECORDED)  # of all outputs
        law = replace(config, telemetry=telemetry, wait_for_subscribers=observers)
        dump(params, {CONTROLLER: law})
        commands = [[*_CONTROLLER_NODE, '--ros-args', '--params-file', str(params)]]
    if name == _RECORDED:
        commands.insert(0, [*_RECORDER_NODE, f'output:={path}'])
    elif name == _HEARD:
        heard = topics.JOINT_STATES, topics.REFERENCE, topics.TRACKING_ERROR, topics.LEARNING
        commands.insert(0, [_NULL_NODE, 'listener', *(topic.relative for topic in heard)])
    contestants: list[Contestant] = []
    try:
        contestants.extend(Contestant(name, command) for command in commands)
        yield contestants
    finally:
        for contestant in reversed(contestants):
            contestant.end()


def _recorded_states(loop: LoopConfig) -> list[bytes]:
    plant = replace(loop.plant, duration=2.0 * (_STEPS + _WARM_UP + 1) * _PERIOD)
    record = simulate(loop.controller, plant)
    telemetry = PlantTelemetry(plant.joints, record.parameters)
    rows = zip(record.stamps.tolist(), record.measurements, strict=True)
    return [telemetry.joint_states(_START + stamp, row)[1] for stamp, row in rows]


def measure_start() -> Iterator[Ratio]:
    """Measure the time to the first torque relative to the null node's."""
    seconds: dict[str, list[float]] = {name: [] for name in (_NULL, _WARM, _COLD)}
    with own_graph(), tempfile.TemporaryDirectory() as caches:
        _first_torque(_WARM, f'{caches}/warm')
        for k in range(_STARTS):
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
    stamps = itertools.count(_START, 1_000_000)
    command = [_NULL_NODE, CONTROLLER] if name == _NULL else _CONTROLLER_NODE
    with closing(StandIn(())) as arm:

        def publish() -> None:
            arm.publisher.publish(encoder.joint_states(next(stamps), state)[1])
            arm.executor.spin_once(timeout_sec=0.002)

        begin = time.perf_counter()
        contestant = Contestant(name, command, {'NUMBA_CACHE_DIR': cache})
        try:
            wait_for(lambda: arm.has_torque, 'the first torque', [contestant], publish)
            return time.perf_counter() - begin
        finally:
            contestant.end()
