# SPDX-License-Identifier: Apache-2.0
"""The controller's node against a null node, which answers without decoding messages.

This process stands in for the plant: it publishes the joint states of a simulated run, one a
millisecond. Every contestant is started in each round, as processes in a ROS domain of their own.
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
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import rclpy
from harness import Ratio, ratio
from rclpy.experimental import EventsExecutor

from blf_dsc_controller.cli.session import localhost_environment, own_domain
from blf_dsc_controller.configuration.controller import ControllerConfig, Telemetry
from blf_dsc_controller.configuration.nodes import CONTROLLER, LoopConfig, dump, load_loop
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.telemetry import PlantTelemetry
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATES
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile
from blf_dsc_controller.simulation.loop import simulate

_ROUNDS = 7
_STARTS = 2
_STEPS = 2000
_WARM_UP = 500
_START = 1_000_000_000
_PERIOD = 1e-3  # s
_PACE = 0.01  # s between two states before the first torque
_SETTLING = 0.5  # s for messages under way to arrive
_PATIENCE = 120.0  # s for a torque, including compilation of kernels
_ENDING = 20.0  # s from SIGINT to the end
_TAIL = 2000  # characters of stderr quoted in an error
_CPUCLOCK_SCHED = 2  # as clock_getcpuclockid(3) does: in ns, where /proc has 10 ms
_ARMS = {'recommended': 'node', 'panda': 'node with seven joints'}
_NULL = 'null node'
_QUIET = 'controller, telemetry off'
_RECORDED = 'controller, telemetry on, recorder'
_COLD = 'controller, cold cache'
_NULL_NODE = [str(Path(__file__).with_name('null_node.py'))]
_CONTROLLER_NODE = ['-m', 'blf_dsc_controller.nodes.controller_node']
_RECORDER_NODE = ['-m', 'blf_dsc_controller.nodes.recorder_node', '--ros-args', '-p']

Process = tuple['subprocess.Popen[bytes]', IO[bytes]]
"""A process, and the file of its stderr."""


class ContestantError(BlfDscError):
    """A contestant has exited early, or does not respond."""


class StandIn:
    """Stand-in for the plant of a contestant: it publishes states and waits for torques.

    The last of the contestant's `processes` is the measured node; the others run beside it.
    """

    def __init__(self, name: str, domain: int) -> None:
        self.name = name
        self.processes: list[Process] = []
        self.has_torque = False
        self.first_torque = 0.0  # s from the start of the processes
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node: Any = rclpy.create_node(
            'sim_plant',
            context=self._context,
            enable_rosout=False,  # one name, many contexts
        )
        self._executor: Any = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._states: Any = self._node.create_publisher(
            message_class(JOINT_STATES.type), JOINT_STATES.name, qos_profile(JOINT_STATES.offered)
        )
        taken, requested = message_class(COMMANDS.type), qos_profile(COMMANDS.requested)
        self._node.create_subscription(taken, COMMANDS.relative, self._take, requested, raw=True)

    def _take(self, _torque: bytes) -> None:
        self.has_torque = True

    def greet(self, state: bytes, begin: float) -> None:
        """Send a state until its torque arrives: a half-matched reader loses messages."""
        self.until(lambda: self.has_torque, 'the first torque', lambda: self._states.publish(state))
        self.first_torque = time.perf_counter() - begin
        takers = len(self.processes)  # a recorder takes states, too
        self.until(lambda: self._states.get_subscription_count() == takers, 'its recorder')
        self._spin(_SETTLING)

    def until(
        self,
        condition: Callable[[], bool],
        what: str,
        act: Callable[[], object] = lambda: None,
        patience: float = _PATIENCE,
    ) -> None:
        """Act until the condition holds; ContestantError if it takes too long, or at an end."""
        begin = time.perf_counter()
        while not condition():
            self.check()
            if time.perf_counter() - begin > patience:
                raise ContestantError(f'{self.name}: no sign of {what} after {patience:g} s')
            act()
            self._spin(_PACE)

    def check(self) -> None:
        """Raise ContestantError, with the end of its stderr, if a process has ended."""
        for process, file in self.processes:
            if process.poll() is not None:
                file.seek(0)
                errors = file.read().decode(errors='replace')[-_TAIL:].strip()
                raise ContestantError(
                    f'{self.name} ended with exit code {process.returncode}:\n{errors}'
                )

    def play(self, states: Iterator[bytes]) -> tuple[float, float]:
        """Publish states, one per millisecond.

        Returns the median latency [s], from state published to torque received, and the CPU [s] of
        the node's process.
        """
        clock = ~self.processes[-1][0].pid << 3 | _CPUCLOCK_SCHED
        latency = np.zeros(_WARM_UP + _STEPS)
        due, busy = time.perf_counter(), 0.0
        for k in range(latency.size):
            if k == _WARM_UP:
                due, busy = time.perf_counter(), time.clock_gettime(clock)
            while (left := due - time.perf_counter()) > 0.0:
                self._executor.spin_once(timeout_sec=left)
            due += _PERIOD
            self.has_torque = False
            sent = time.perf_counter()
            self._states.publish(next(states))
            while not self.has_torque:
                self._executor.spin_once(timeout_sec=_PATIENCE)
                if time.perf_counter() - sent > _PATIENCE:
                    self.check()
                    raise ContestantError(f'{self.name}: no torque for state {k}')
            latency[k] = time.perf_counter() - sent
        return float(np.median(latency[_WARM_UP:])), time.clock_gettime(clock) - busy

    def _spin(self, seconds: float) -> None:
        end = time.perf_counter() + seconds
        while (left := end - time.perf_counter()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def close(self) -> None:
        """Destroy the node, so that no participant is left in a later round."""
        self._executor.remove_node(self._node)
        self._node.destroy_node()
        self._context.try_shutdown()
        self._node = self._states = self._executor = None
        gc.collect()


@contextmanager
def _running(command: list[str], environment: dict[str, str]) -> Iterator[Process]:
    """Run this Python with arguments, and end it as Ctrl-C does, or by force if that fails."""
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, *command], env=environment, stdout=subprocess.DEVNULL, stderr=errors
        )
        try:
            yield process, errors
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(_ENDING)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def _started(
    name: str, config: ControllerConfig, path: Path, state: bytes, cache: str = ''
) -> Iterator[StandIn]:
    """Start a contestant: its recorder, if it has one, then its node; wait for the first torque."""
    commands, is_recorded = [_NULL_NODE], name == _RECORDED
    if name != _NULL:
        file, telemetry = path.with_suffix('.yaml'), Telemetry(enabled=is_recorded)
        law = replace(config, telemetry=telemetry, wait_for_subscribers=int(is_recorded))
        dump(file, {CONTROLLER: law})
        commands = [[*_CONTROLLER_NODE, '--ros-args', '--params-file', str(file)]]
    if is_recorded:
        commands.insert(0, [*_RECORDER_NODE, f'output:={path}'])
    os.environ.update(localhost_environment())
    with own_domain() as domain, closing(StandIn(name, domain)) as arm, ExitStack() as processes:
        own = {**os.environ, 'ROS_DOMAIN_ID': f'{domain}'}
        own |= {'NUMBA_CACHE_DIR': cache} if cache else {}
        begin = time.perf_counter()
        for command in commands:
            arm.processes.append(processes.enter_context(_running(command, own)))
        arm.greet(state, begin)
        yield arm
        arm.check()


def measure() -> Iterator[Ratio]:
    """Measure first torque, latency and CPU of the controller relative to the null node."""
    for preset, group in _ARMS.items():
        loop = load_loop(preset)
        first, *states = _recorded_states(loop)
        found: dict[str, list[tuple[float, ...]]] = {_NULL: [], _QUIET: [], _RECORDED: []}
        with tempfile.TemporaryDirectory() as folder:
            for k, (name, figures) in itertools.product(range(_ROUNDS), found.items()):
                path = Path(folder, f'{k}-{name}'.replace(' ', '_'))
                with _started(name, loop.controller, path, first) as arm:
                    figures.append((*arm.play(iter(states)), arm.first_torque))
        for column, what in enumerate(('median latency', 'CPU', 'first torque')):
            values = {name: np.array(figures)[:, column] for name, figures in found.items()}
            for name in (_QUIET, _RECORDED):
                title = f'{group}, real time at 1 kHz'
                yield ratio(title, f'{name}: {what}', _NULL, values[name], values[_NULL])


def _recorded_states(loop: LoopConfig) -> list[bytes]:
    plant = replace(loop.plant, duration=(_STEPS + _WARM_UP + 1) * _PERIOD)
    record = simulate(loop.controller, plant)
    telemetry = PlantTelemetry(plant.joints, record.parameters)
    rows = zip(record.stamps.tolist(), record.measurements, strict=True)
    return [telemetry.joint_states(_START + stamp, row)[1] for stamp, row in rows]


def measure_start() -> Iterator[Ratio]:
    """Measure the time to the first torque without compiled kernels relative to the null node's."""
    loop, seconds = load_loop('recommended'), {_NULL: np.zeros(_STARTS), _COLD: np.zeros(_STARTS)}
    state = _recorded_states(loop)[0]
    with tempfile.TemporaryDirectory() as folder:
        for k, (name, values) in itertools.product(range(_STARTS), seconds.items()):
            path = Path(folder, f'{k}')
            with _started(name, loop.controller, path, state, cache=str(path)) as arm:
                values[k] = arm.first_torque
    note = f'{np.median(seconds[_COLD]):.1f} s here'
    yield ratio('first torque', _COLD, _NULL, seconds[_COLD], seconds[_NULL], note)
