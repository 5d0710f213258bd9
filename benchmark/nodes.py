# SPDX-License-Identifier: Apache-2.0
"""The controller's node against a null node, which answers without decoding messages.

This process stands in for the plant: it publishes the joint states of a simulated run,
one a millisecond. Every contestant is started in each round, as processes in a ROS
domain of their own.
"""

from __future__ import annotations

import gc
import itertools
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.experimental import EventsExecutor

from benchmark.harness import Ratio, ratio
from blf_dsc_controller.cli.domains import own_domain
from blf_dsc_controller.cli.isolation import environment, localhost_environment
from blf_dsc_controller.cli.node_process import NodeProcess
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.controller_groups import Telemetry
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    RECORDER,
    LoopConfig,
    dump,
    load_loop,
)
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.plant_telemetry import PlantTelemetry
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
_CPUCLOCK_SCHED = 2  # as clock_getcpuclockid(3) does: in ns, where /proc has 10 ms
_ARMS = {'recommended': 'node', 'panda': 'node with seven joints'}
_NULL = 'null node'
_NEVER = 1_000_000_000  # samples: no telemetry
_QUIET = 'controller, telemetry off'
_RECORDED = 'controller, telemetry on, recorder'
_NULL_NODE = 'benchmark.null_node'


class StandIn:
    """Stand-in for the plant of a contestant: it publishes states and waits for torques.

    The last of the contestant's `nodes` is measured; the others run beside it.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.nodes: list[NodeProcess] = []
        self.has_torque = False
        self.first_torque = 0.0  # s from the start of the processes
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node: Any = rclpy.create_node(
            'sim_plant',
            context=self._context,
            enable_rosout=False,  # one name, many contexts
        )
        self._executor: Any = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._states: Any = self._node.create_publisher(
            message_class(JOINT_STATES.type),
            JOINT_STATES.name,
            qos_profile(JOINT_STATES.offered),
        )
        taken = message_class(COMMANDS.type)
        requested = qos_profile(COMMANDS.requested)
        self._node.create_subscription(
            taken, COMMANDS.relative, self._take, requested, raw=True
        )

    def _take(self, _torque: bytes) -> None:
        self.has_torque = True

    def greet(self, state: bytes, begin: float) -> None:
        """Send a state until its torque arrives: a half-matched reader loses messages."""
        self.until(
            lambda: self.has_torque,
            'the first torque',
            lambda: self._states.publish(state),
        )
        self.first_torque = time.perf_counter() - begin
        takers = len(self.nodes)  # a recorder takes states, too
        self.until(
            lambda: self._states.get_subscription_count() == takers, 'its recorder'
        )
        self._spin(_SETTLING)

    def until(
        self,
        condition: Callable[[], bool],
        what: str,
        act: Callable[[], object] = lambda: None,
    ) -> None:
        """Act until the condition holds.

        BlfDscError if it takes too long or a node has failed.
        """
        begin = time.perf_counter()
        while not condition():
            self.check()
            if time.perf_counter() - begin > _PATIENCE:
                raise BlfDscError(
                    f'{self.name}: no sign of {what} after {_PATIENCE:g} s'
                )
            act()
            self._spin(_PACE)

    def check(self) -> None:
        """Raise BlfDscError, with the end of its log, if a node has failed."""
        for node in self.nodes:
            node.check()

    def play(self, states: Iterator[bytes]) -> tuple[float, float]:
        """Publish states, one per millisecond.

        Returns the median latency [s], from state published to torque received, and the
        CPU [s] of the node's process.
        """
        clock = ~self.nodes[-1].pid << 3 | _CPUCLOCK_SCHED
        latency = np.zeros(_WARM_UP + _STEPS)
        due, busy = time.perf_counter(), 0.0
        for k in range(latency.size):
            if k == _WARM_UP:
                due = time.perf_counter()
                busy = time.clock_gettime(clock)
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
                    raise BlfDscError(f'{self.name}: no torque for state {k}')
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
def _started(
    name: str, config: ControllerConfig, folder: Path, state: bytes, **variables: str
) -> Iterator[StandIn]:
    """Start a contestant: its recorder, if it has one, then its node.

    Wait for the first torque.
    """
    is_recorded = name == _RECORDED
    telemetry = config.telemetry if is_recorded else Telemetry(decimation=_NEVER)
    law = replace(config, telemetry=telemetry, wait_for_subscribers=int(is_recorded))
    folder.mkdir()
    dump(folder / 'config.yaml', {CONTROLLER: law})
    nodes: dict[str, tuple[str, ...]] = {
        _NULL_NODE if name == _NULL else CONTROLLER: ()
    }
    if is_recorded:
        nodes = {RECORDER: ('-p', f'output:={folder / "bag"}'), **nodes}
    with own_domain() as domain, ExitStack() as ending:
        values = {'ROS_DOMAIN_ID': f'{domain}', 'PYTHONPATH': os.pathsep.join(sys.path)}
        ending.enter_context(environment(localhost_environment() | values | variables))
        arm = ending.enter_context(closing(StandIn(name)))
        begin = time.perf_counter()
        for node, arguments in nodes.items():
            arm.nodes.append(
                NodeProcess(node, folder / 'config.yaml', folder, *arguments)
            )
            ending.callback(arm.nodes[-1].stop)
        arm.greet(state, begin)
        yield arm
        arm.check()


def measure() -> Iterator[Ratio]:
    """Measure latency, CPU and first torque of the controller relative to the null node."""
    for preset, group in _ARMS.items():
        found = _figures(load_loop(preset), (_NULL, _QUIET, _RECORDED), _ROUNDS)
        for column, what in enumerate(('median latency', 'CPU', 'first torque')):
            baseline = found[_NULL][:, column]
            for name in (_QUIET, _RECORDED):
                title = f'{group}, real time at 1 kHz'
                yield ratio(
                    title, f'{name}: {what}', _NULL, found[name][:, column], baseline
                )


def latencies(preset: str, rounds: int) -> np.ndarray:
    """Return the median latency [s] of the controller's node (rounds,), telemetry off."""
    return _figures(load_loop(preset), (_QUIET,), rounds)[_QUIET][:, 0]


def measure_start() -> Iterator[Ratio]:
    """Measure the time to the first torque without compiled kernels relative to the null node's."""
    found = _figures(load_loop('recommended'), (_NULL, _QUIET), _STARTS, cold=True)
    theirs, mine = (figures[:, 2] for figures in found.values())
    note = f'{np.median(mine):.1f} s here'
    yield ratio('first torque', 'controller, cold cache', _NULL, mine, theirs, note)


def _figures(
    loop: LoopConfig, names: Sequence[str], rounds: int, *, cold: bool = False
) -> dict[str, np.ndarray]:
    """Return median latency, CPU and first torque [s] (rounds, 3) of each contestant."""
    plant = replace(loop.plant, duration=(_STEPS + _WARM_UP + 1) * _PERIOD)
    record = simulate(loop.controller, plant)
    telemetry = PlantTelemetry(plant.joints, record.parameters)
    rows = zip(record.stamps.tolist(), record.measurements, strict=True)
    first, *states = [
        telemetry.joint_states(_START + stamp, row)[1] for stamp, row in rows
    ]
    found: dict[str, list[tuple[float, ...]]] = {name: [] for name in names}
    with tempfile.TemporaryDirectory() as folder:
        for k, (name, figures) in itertools.product(range(rounds), found.items()):
            path = Path(folder, f'{k}-{name}')
            variables = {'NUMBA_CACHE_DIR': f'{path}'} if cold else {}
            with _started(name, loop.controller, path, first, **variables) as arm:
                figures.append((*arm.play(iter(states)), arm.first_torque))
    return {name: np.array(figures) for name, figures in found.items()}
