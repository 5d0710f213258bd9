# SPDX-License-Identifier: Apache-2.0
"""The controller node against a null node, which echoes a torque immediately.

This process stands in for the plant: it publishes the joint states of a recorded run and receives
the torques. Every contestant is restarted in each round, as a process of its own. The null node
passes serialised messages without decoding them, the least that Python can do.
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
from typing import Any, NamedTuple

import numpy as np
from harness import Contestant, ContestantError, Ratio, own_graph, ratio, wait_for

from blf_dsc_controller.configuration.controller import ControllerConfig, Telemetry
from blf_dsc_controller.configuration.nodes import CONTROLLER, LoopConfig, dump, load_loop
from blf_dsc_controller.law.telemetry import PlantTelemetry
from blf_dsc_controller.messages import topics
from blf_dsc_controller.simulation.loop import simulate

_ROUNDS = 5
_STEPS = 5000
_WARM_UP = 500
_START = 1_000_000_000
_SETTLING = 0.5  # s for discovery, or for a message to arrive
_PATIENCE = 60.0  # s for one torque
_NULL = 'null node'
_QUIET = 'controller, telemetry off'
_UNHEARD = 'controller, telemetry on, no subscriber'
_SPARSE = 'controller, telemetry of every 10th sample, a subscriber'
_HEARD = 'controller, telemetry on, a subscriber'
_RECORDED = 'controller, telemetry on, recorder'
_LISTENED = (_SPARSE, _HEARD)
_PROCESSES = (_NULL, _QUIET, _UNHEARD, _SPARSE, _HEARD, _RECORDED)
_PRESETS = {'recommended': 'node', 'panda': 'node with seven joints'}
_HERE = Path(__file__).parent
_STARTS = 3
_WARM = 'controller, warm cache'
_COLD = 'controller, cold cache'
_POLL = 0.002  # s


class Run(NamedTuple):
    """One contestant in one round."""

    latency: np.ndarray  # (_STEPS,) s, from state published to torque received
    elapsed: float  # s
    cpu: float  # s of the node's process


def _telemetry_of(name: str) -> Telemetry:
    return Telemetry(enabled=name != _QUIET, decimation=10 if name == _SPARSE else 1)


def _silent(context: Any) -> dict[str, Any]:
    """Return options of a node without /rosout, on which nodes of one name would conflict."""
    return {'context': context, 'enable_rosout': False}


class StandIn:
    """Stand-in for the plant that publishes recorded states and waits for torques."""

    def __init__(self, messages: Sequence[bytes]) -> None:
        import rclpy
        from rclpy.experimental import EventsExecutor

        from blf_dsc_controller.nodes.endpoints import message_class, qos_profile

        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node: Any = rclpy.create_node('sim_plant', **_silent(self.context))
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
        self.messages = messages

    def _take(self, _torque: bytes) -> None:
        self.has_torque = True

    def play(self, contestants: Sequence[Contestant], period: float) -> Run:
        """Publish all states, one per `period` [s] or, if 0, each after the previous torque.

        The last of the contestants is the measured node; the others run beside it.
        """
        takers = len(contestants)  # a recorder subscribes to the states, too
        self._wait_for(lambda: self.publisher.get_subscription_count() == takers, contestants)
        self._wait_for(lambda: self.node.count_publishers(self.commands) == 1, contestants)
        self._spin_for(_SETTLING)
        node = contestants[-1]
        self._greet(node)
        latency = np.zeros(len(self.messages))
        begin = time.perf_counter()
        busy = node.cpu_time()
        for k, message in enumerate(self.messages[1:], 1):
            if k == _WARM_UP:
                begin = time.perf_counter()
                busy = node.cpu_time()
            if period:
                due = begin + (k - _WARM_UP if k >= _WARM_UP else k) * period
                while (left := due - time.perf_counter()) > 0.0:
                    self.executor.spin_once(timeout_sec=left)
            self.has_torque = False
            sent = time.perf_counter()
            self.publisher.publish(message)
            while not self.has_torque:
                self.executor.spin_once(timeout_sec=_PATIENCE)
                if time.perf_counter() - sent > _PATIENCE:
                    node.check()
                    raise ContestantError(f'{node.name}: no torque for state {k}')
            latency[k] = time.perf_counter() - sent
        elapsed = time.perf_counter() - begin
        for contestant in contestants:
            contestant.check()
        return Run(latency[_WARM_UP:], elapsed, node.cpu_time() - busy)

    def _greet(self, node: Contestant) -> None:
        """Send the first state until its torque arrives: a half-matched reader loses messages."""
        self.has_torque = False
        end = time.perf_counter() + _PATIENCE
        while time.perf_counter() < end:
            self.publisher.publish(self.messages[0])
            self._spin_for(_SETTLING)
            if self.has_torque:
                return
            node.check()
        raise ContestantError(f'{node.name}: no torque for the first state')

    def _spin_for(self, seconds: float) -> None:
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            self.executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        """Destroy the stand-in's node, so that no participant is left in a later round."""
        self.executor.remove_node(self.node)
        self.node.destroy_node()
        self.context.try_shutdown()
        self.node = self.publisher = self.executor = None
        gc.collect()

    def left_alone(self) -> None:
        """Wait until the last contestant has disappeared."""
        self._wait_for(lambda: self.publisher.get_subscription_count() == 0)
        self._wait_for(lambda: self.node.count_publishers(self.commands) == 0)

    def _wait_for(
        self, condition: Callable[[], bool], contestants: Sequence[Contestant] = ()
    ) -> None:
        what = f'{contestants[-1].name} to appear' if contestants else 'a contestant to disappear'
        wait_for(condition, what, contestants, lambda: self.executor.spin_once(timeout_sec=0.05))


def measure() -> Iterator[Ratio]:
    """Measure latency, CPU and lock-step rate of the controller relative to the null nodes."""
    for preset, group in _PRESETS.items():
        yield from _measure(preset, group)


def _measure(preset: str, group: str) -> Iterator[Ratio]:
    loop = load_loop(preset)
    real: dict[str, list[Run]] = {name: [] for name in _PROCESSES}
    lockstep: dict[str, list[Run]] = {name: [] for name in _PROCESSES}
    states = _recorded_states(loop)
    with own_graph(), tempfile.TemporaryDirectory() as folder, closing(StandIn(states)) as arm:
        for k in range(_ROUNDS):
            for name in _PROCESSES:
                for runs, period in ((real, 1e-3), (lockstep, 0.0)):
                    tag = f'{k}-{name}-{period}'.replace(' ', '_')
                    with _started(name, loop.controller, Path(folder, tag)) as these:
                        runs[name].append(arm.play(these, period))
                    arm.left_alone()
    yield from _real_time(f'{group}, real time at 1 kHz', real)
    yield from _rates(f'{group}, lock-step', lockstep)


def _real_time(group: str, runs: dict[str, list[Run]]) -> Iterator[Ratio]:
    median = {name: np.array([np.median(r.latency) for r in each]) for name, each in runs.items()}
    tail = {
        name: np.array([np.percentile(r.latency, 99.9) for r in each])
        for name, each in runs.items()
    }
    cpu = {name: np.array([r.cpu for r in each]) for name, each in runs.items()}
    base = _NULL
    for name in list(runs)[1:]:
        yield ratio(group, f'{name}: median latency', base, median[name], median[base])
        yield ratio(group, f'{name}: p99.9 latency', base, tail[name], tail[base])
        yield ratio(group, f'{name}: CPU', base, cpu[name], cpu[base])


def _rates(group: str, runs: dict[str, list[Run]]) -> Iterator[Ratio]:
    rate = {name: np.array([_STEPS / r.elapsed for r in each]) for name, each in runs.items()}
    base = _NULL
    for name in list(runs)[1:]:
        note = f'{np.median(rate[name]):.0f} steps a second here'
        yield ratio(group, f'{name}: steps a second', base, rate[name], rate[base], note)


@contextmanager
def _started(name: str, config: ControllerConfig, path: Path) -> Iterator[list[Contestant]]:
    """Start a contestant's processes: its subscriber or recorder, if it has one, then its node."""
    commands = [_command(name, config, path.with_suffix('.yaml'))]
    if name == _RECORDED:
        module = 'blf_dsc_controller.nodes.recorder_node'
        commands.insert(0, ['-m', module, '--ros-args', '-p', f'output:={path}'])
    elif name in _LISTENED:
        commands.insert(0, [str(_HERE / 'null_node.py'), 'listen'])
    contestants: list[Contestant] = []
    try:
        contestants.extend(Contestant(name, command) for command in commands)
        yield contestants
    finally:
        for contestant in reversed(contestants):
            contestant.end()


def _command(name: str, config: ControllerConfig, params: Path) -> list[str]:
    if name == _NULL:
        return [str(_HERE / 'null_node.py'), 'echo']
    telemetry = _telemetry_of(name)
    observers = int(name == _RECORDED)  # of all outputs
    dump(params, {CONTROLLER: replace(config, telemetry=telemetry, wait_for_subscribers=observers)})
    module = 'blf_dsc_controller.nodes.controller_node'
    return ['-m', module, '--ros-args', '--params-file', str(params)]


def _recorded_states(loop: LoopConfig) -> list[bytes]:
    plant = replace(loop.plant, duration=(_STEPS + _WARM_UP) * 1e-3)
    record = simulate(loop.controller, plant)
    telemetry = PlantTelemetry(plant.joints, record.parameters)
    rows = zip(record.stamps[:-1].tolist(), record.measurements, strict=False)
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
    stamps = itertools.count(1_000_000_000, 1_000_000)
    command = ['-m', 'blf_dsc_controller.nodes.controller_node']
    if name == _NULL:
        command = [str(Path(__file__).with_name('null_node.py')), 'echo']
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
