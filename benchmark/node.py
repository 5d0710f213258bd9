# SPDX-License-Identifier: Apache-2.0
"""The controller node beside a node that echoes a torque at once.

This process plays the arm: it publishes the joint states of a recorded run and takes the torques.
Every contestant is a process of its own, started anew in each round.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from timing import Ratio, ratio

from blf_dsc_controller.bags import topics
from blf_dsc_controller.bags.telemetry import PlantTelemetry
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.dump import dump
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.core.two_link import PARAMETER_NAMES
from blf_dsc_controller.simulation import simulate
from sim_plant.configuration import PlantConfig

_DOMAIN = '93'
_ROUNDS = 5
_STEPS = 5000
_WARM_UP = 500
_START = 1_000_000_000
_SETTLING = 1.0  # s until both sides have found each other
_PATIENCE = 10.0  # s for one torque
_START_UP = 120.0  # s, kernels may have to be compiled
_NULL = 'null node'
_NULL_TYPED = 'null node, typed messages'
_QUIET = 'controller, telemetry off'
_TELLING = 'controller, telemetry on'
_RECORDED = 'controller, telemetry and recorder on'
_HERE = Path(__file__).parent


class Run(NamedTuple):
    """One contestant in one round."""

    latency: np.ndarray  # (_STEPS,) s, state published to torque received
    elapsed: float  # s
    cpu: float  # s of the node's process


class Arm:
    """Publishes recorded states and waits for torques, in lock-step or at 1 kHz."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.experimental import EventsExecutor

        from blf_dsc_controller.nodes.endpoints import message_class, profile

        rclpy.init()
        self.node = rclpy.create_node('sim_plant')
        self.executor = EventsExecutor()
        self.executor.add_node(self.node)
        states, commands = topics.JOINT_STATES, topics.COMMANDS
        self.commands = commands.relative
        self.publisher = self.node.create_publisher(
            message_class(states.type), states.name, profile(states.offered)
        )
        self.node.create_subscription(
            message_class(commands.type),
            commands.relative,
            self._take,
            profile(commands.requested),
            raw=True,
        )
        self.answered = False
        self.messages = _recorded_states()

    def _take(self, _torque: bytes) -> None:
        self.answered = True

    def play(self, pid: int, period: float) -> Run:
        """Play all states, each `period` [s] after the last; 0: each when the last is answered."""
        self._await(lambda: self.publisher.get_subscription_count() == 1)
        self._await(lambda: self.node.count_publishers(self.commands) == 1)
        time.sleep(_SETTLING)
        latency = np.zeros(len(self.messages))
        begin = time.perf_counter()
        busy = cpu_time(pid)
        for k, message in enumerate(self.messages):
            if k == _WARM_UP:
                begin = time.perf_counter()
                busy = cpu_time(pid)
            if period:
                due = begin + (k - _WARM_UP if k >= _WARM_UP else k) * period
                while (left := due - time.perf_counter()) > 0.0:
                    self.executor.spin_once(timeout_sec=left)
            self.answered = False
            sent = time.perf_counter()
            self.publisher.publish(message)
            while not self.answered:
                self.executor.spin_once(timeout_sec=_PATIENCE)
                if time.perf_counter() - sent > _PATIENCE:
                    raise TimeoutError(f'no torque for state {k} of {pid}')
            latency[k] = time.perf_counter() - sent
        elapsed = time.perf_counter() - begin
        return Run(latency[_WARM_UP:], elapsed, cpu_time(pid) - busy)

    def left_alone(self) -> None:
        """Wait until the last contestant has gone."""
        self._await(lambda: self.publisher.get_subscription_count() == 0)
        self._await(lambda: self.node.count_publishers(self.commands) == 0)

    def _await(self, condition: Callable[[], bool]) -> None:
        begin = time.perf_counter()
        while not condition():
            self.executor.spin_once(timeout_sec=0.05)
            if time.perf_counter() - begin > _START_UP:
                raise TimeoutError('a contestant did not start or did not end')


def cpu_time(pid: int) -> float:
    """User and system time of a process so far [s]."""
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(') ', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def measure() -> Iterator[Ratio]:
    """Latency, CPU and lock-step rate of the controller node relative to the null node."""
    os.environ['ROS_DOMAIN_ID'] = _DOMAIN
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    arm = Arm()
    contestants = (_NULL, _NULL_TYPED, _QUIET, _TELLING, _RECORDED)
    real: dict[str, list[Run]] = {name: [] for name in contestants}
    lockstep: dict[str, list[Run]] = {name: [] for name in contestants}
    with tempfile.TemporaryDirectory() as folder:
        for k in range(_ROUNDS):
            for name in contestants:
                for runs, period in ((real, 1e-3), (lockstep, 0.0)):
                    with _started(name, Path(folder), f'{k}-{name}-{period}') as pid:
                        runs[name].append(arm.play(pid, period))
                    arm.left_alone()
    yield from _real_time(real)
    yield from _rates(lockstep)


def _real_time(runs: dict[str, list[Run]]) -> Iterator[Ratio]:
    group = 'node, real time at 1 kHz'
    median = {name: np.array([np.median(r.latency) for r in each]) for name, each in runs.items()}
    tail = {
        name: np.array([np.percentile(r.latency, 99.9) for r in each])
        for name, each in runs.items()
    }
    cpu = {name: np.array([r.cpu for r in each]) for name, each in runs.items()}
    for name in runs:
        if name != _NULL:
            yield ratio(group, f'{name}: median latency', _NULL, median[name], median[_NULL])
            yield ratio(group, f'{name}: p99.9 latency', _NULL, tail[name], tail[_NULL])
            yield ratio(group, f'{name}: CPU', _NULL, cpu[name], cpu[_NULL])


def _rates(runs: dict[str, list[Run]]) -> Iterator[Ratio]:
    rate = {name: np.array([_STEPS / r.elapsed for r in each]) for name, each in runs.items()}
    for name in runs:
        if name != _NULL:
            note = f'{np.median(rate[name]):.0f} steps a second here'
            what = f'{name}: steps a second'
            yield ratio('node, lock-step', what, _NULL, rate[name], rate[_NULL], note)


@contextmanager
def _started(name: str, folder: Path, tag: str) -> Iterator[int]:
    """Process id of a contestant, with a recorder beside it if it is to have one."""
    processes = []
    if name == _RECORDED:
        bag = folder / tag.replace(' ', '_')
        module = 'blf_dsc_controller.nodes.recorder_node'
        processes.append(_spawn('-m', module, '-p', f'output:={bag}'))
    if name in (_NULL, _NULL_TYPED):
        kind = 'raw' if name == _NULL else 'typed'
        processes.append(_spawn(str(_HERE / 'null_node.py'), kind))
    else:
        config = ControllerConfig()
        telemetry = replace(config.telemetry, enabled=name != _QUIET)
        observers = int(name == _RECORDED)
        config = replace(config, telemetry=telemetry, wait_for_subscribers=observers)
        params = folder / f'{tag}.yaml'.replace(' ', '_')
        dump(params, {CONTROLLER: config})
        module = 'blf_dsc_controller.nodes.controller_node'
        processes.append(_spawn('-m', module, '--params-file', str(params)))
    try:
        yield processes[-1].pid
    finally:
        for process in reversed(processes):
            process.send_signal(signal.SIGINT)
            process.wait()


def _spawn(*command: str) -> subprocess.Popen[bytes]:
    split = next((k for k, word in enumerate(command) if word.startswith(('-p', '--p'))), None)
    program, ros = command[:split], command[split:] if split else ()
    arguments = ['--ros-args', *ros] if ros else []
    return subprocess.Popen(
        [sys.executable, *program, *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _recorded_states() -> list[bytes]:
    plant = PlantConfig(duration=(_STEPS + _WARM_UP) * 1e-3)
    record = simulate(ControllerConfig(), plant)
    telemetry = PlantTelemetry(plant.joints, PARAMETER_NAMES)
    rows = zip(record.stamps[:-1].tolist(), record.measurements, strict=False)
    return [telemetry.joint_states(_START + stamp, row)[1] for stamp, row in rows]


def main() -> None:
    """Print the ratios."""
    for row in measure():
        print(row)


if __name__ == '__main__':
    main()
