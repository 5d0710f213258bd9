# SPDX-License-Identifier: Apache-2.0
"""The controller's node against a null node, which answers without decoding messages.

This process stands in for the plant: it publishes the joint states of a simulated run, one a
millisecond. Every contestant is restarted in each round, as a process of its own.
"""

from __future__ import annotations

import gc
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from harness import Ratio, ratio
from rclpy.experimental import EventsExecutor

from blf_dsc_controller.cli.session import localhost_environment, own_domain
from blf_dsc_controller.configuration.controller import ControllerConfig, Telemetry
from blf_dsc_controller.configuration.nodes import CONTROLLER, LoopConfig, dump, load_loop
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.telemetry import PlantTelemetry
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile
from blf_dsc_controller.simulation.loop import simulate

_ROUNDS = 3
_STARTS = 2
_STEPS = 2000
_WARM_UP = 500
_START = 1_000_000_000
_PERIOD = 1e-3  # s
_SETTLING = 0.5  # s for discovery, or for a message to arrive
_PATIENCE = 60.0  # s for one torque
_START_UP = 120.0  # s, including compilation of kernels
_ENDING = 20.0  # s from SIGINT to the end
_TAIL = 2000  # characters of stderr quoted in an error
_CPUCLOCK_SCHED = 2  # as clock_getcpuclockid(3) does: in ns, where /proc has 10 ms
_ARMS = {'recommended': 'node', 'panda': 'node with seven joints'}
_NULL = 'null node'
_QUIET = 'controller, telemetry off'
_RECORDED = 'controller, telemetry on, recorder'
_WARM = 'controller, warm cache'
_COLD = 'controller, cold cache'
_NULL_NODE = [str(Path(__file__).with_name('null_node.py'))]
_CONTROLLER_NODE = ['-m', 'blf_dsc_controller.nodes.controller_node']
_RECORDER_NODE = ['-m', 'blf_dsc_controller.nodes.recorder_node', '--ros-args', '-p']


class ContestantError(BlfDscError):
    """A contestant has exited early, or does not respond."""


class Contestant(subprocess.Popen[bytes]):
    """A process of this Python interpreter: a script or `-m module`, and its arguments."""

    def __init__(
        self, name: str, arguments: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        self.name, command = name, [sys.executable, *arguments]
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        own = {**os.environ, **(environment or {})}
        super().__init__(command, env=own, stdout=subprocess.DEVNULL, stderr=self._errors)

    def cpu_time(self) -> float:
        """Return the user and system time of the process so far [s]."""
        return time.clock_gettime(~self.pid << 3 | _CPUCLOCK_SCHED)

    def check(self) -> None:
        """Raise ContestantError, with the end of its stderr, if the process has ended."""
        code = self.poll()
        if code is not None:
            self._errors.seek(0)
            errors = self._errors.read().decode(errors='replace')[-_TAIL:].strip()
            raise ContestantError(f'{self.name} ended with exit code {code}:\n{errors}')

    def end(self) -> None:
        """End the process as Ctrl-C does, or kill it if that is not enough."""
        self.send_signal(signal.SIGINT)
        try:
            self.wait(_ENDING)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()
        self._errors.close()


def wait_for(
    condition: Callable[[], bool],
    what: str,
    contestants: Sequence[Contestant] = (),
    pause: Callable[[], object] = lambda: time.sleep(0.02),
    timeout: float = _START_UP,
) -> None:
    """Wait until the condition holds; ContestantError after `timeout` [s] or if one has ended."""
    begin = time.perf_counter()
    while not condition():
        for contestant in contestants:
            contestant.check()
        if time.perf_counter() - begin > timeout:
            raise ContestantError(f'timed out after {timeout:g} s waiting for {what}')
        pause()


@contextmanager
def own_graph() -> Iterator[None]:
    """Isolate the ROS nodes of this process and of its contestants from all others."""
    with own_domain() as domain:
        os.environ.update({'ROS_DOMAIN_ID': str(domain), **localhost_environment()})
        yield


class StandIn:
    """Stand-in for the plant that publishes recorded states and waits for torques."""

    def __init__(self) -> None:
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

    def _take(self, _torque: bytes) -> None:
        self.has_torque = True

    def greet(self, contestants: Sequence[Contestant], state: bytes) -> None:
        """Send a state until its torque arrives: a half-matched reader loses messages.

        The last of the contestants is the measured node; the others run beside it.
        """
        name, takers = contestants[-1].name, len(contestants)  # a recorder takes states, too
        self._wait_for_others(takers, 1, f'{name} to appear', contestants)
        self._spin_for(_SETTLING)
        self.has_torque = False

        def send() -> None:
            self.publisher.publish(state)
            self._spin_for(_SETTLING)

        wait_for(lambda: self.has_torque, f'the first torque of {name}', contestants, send)

    def left_alone(self) -> None:
        """Wait until the last contestant has disappeared."""
        self._wait_for_others(0, 0, 'a contestant to disappear')

    def _wait_for_others(
        self, takers: int, givers: int, what: str, contestants: Sequence[Contestant] = ()
    ) -> None:
        def met() -> bool:
            given = self.node.count_publishers(self.commands)
            return bool(self.publisher.get_subscription_count() == takers and given == givers)

        wait_for(met, what, contestants, lambda: self.executor.spin_once(timeout_sec=0.05))

    def play(self, node: Contestant, states: Iterator[bytes]) -> tuple[float, float]:
        """Publish states, one per millisecond.

        Returns the median latency [s], from state published to torque received, and the CPU [s] of
        the node's process.
        """
        latency = np.zeros(_WARM_UP + _STEPS)
        due, busy = time.perf_counter(), 0.0
        for k in range(latency.size):
            if k == _WARM_UP:
                due, busy = time.perf_counter(), node.cpu_time()
            while (left := due - time.perf_counter()) > 0.0:
                self.executor.spin_once(timeout_sec=left)
            due += _PERIOD
            self.has_torque = False
            sent = time.perf_counter()
            self.publisher.publish(next(states))
            while not self.has_torque:
                self.executor.spin_once(timeout_sec=_PATIENCE)
                if time.perf_counter() - sent > _PATIENCE:
                    node.check()
                    raise ContestantError(f'{node.name}: no torque for state {k}')
            latency[k] = time.perf_counter() - sent
        return float(np.median(latency[_WARM_UP:])), node.cpu_time() - busy

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


def measure() -> Iterator[Ratio]:
    """Measure latency and CPU of the controller relative to the null node."""
    for preset, group in _ARMS.items():
        loop = load_loop(preset)
        states = _recorded_states(loop)
        found: dict[str, list[tuple[float, float]]] = {_NULL: [], _QUIET: [], _RECORDED: []}
        with own_graph(), tempfile.TemporaryDirectory() as folder, closing(StandIn()) as arm:
            for k, (name, figures) in itertools.product(range(_ROUNDS), found.items()):
                unsent = iter(states)
                path = Path(folder, f'{k}-{name}'.replace(' ', '_'))
                with _started(name, loop.controller, path) as contestants:
                    arm.greet(contestants, next(unsent))
                    figures.append(arm.play(contestants[-1], unsent))
                    for contestant in contestants:
                        contestant.check()
                arm.left_alone()
        for column, what in enumerate(('median latency', 'CPU')):
            values = {name: np.array(figures)[:, column] for name, figures in found.items()}
            for name in (_QUIET, _RECORDED):
                title = f'{group}, real time at 1 kHz'
                yield ratio(title, f'{name}: {what}', _NULL, values[name], values[_NULL])


@contextmanager
def _started(name: str, config: ControllerConfig, path: Path) -> Iterator[list[Contestant]]:
    """Start a contestant's processes: its recorder, if it has one, then its node."""
    is_recorded = name == _RECORDED
    commands = [_NULL_NODE]
    if name != _NULL:
        params = path.with_suffix('.yaml')
        law = replace(
            config, telemetry=Telemetry(enabled=is_recorded), wait_for_subscribers=int(is_recorded)
        )
        dump(params, {CONTROLLER: law})
        commands = [[*_CONTROLLER_NODE, '--ros-args', '--params-file', str(params)]]
    if is_recorded:
        commands.insert(0, [*_RECORDER_NODE, f'output:={path}'])
    contestants: list[Contestant] = []
    try:
        contestants.extend(Contestant(name, command) for command in commands)
        yield contestants
    finally:
        for contestant in reversed(contestants):
            contestant.end()


def _recorded_states(loop: LoopConfig) -> list[bytes]:
    plant = replace(loop.plant, duration=(_STEPS + _WARM_UP + 1) * _PERIOD)
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
    command = _NULL_NODE if name == _NULL else _CONTROLLER_NODE
    with closing(StandIn()) as arm:

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
