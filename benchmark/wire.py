# SPDX-License-Identifier: Apache-2.0
"""From state to torque over libfranka's protocol: in process, and beside it over DDS.

The robot is franky-sim's, in real time at half its speed, as a process.  The null loop
answers each state with the last torque, over the same bindings (pylibfranka).  The node
has its states from a stand-in for the plant (`nodes.py`), of the same configuration;
its latency contains DDS both ways, but no driver.  Where the system permits it,
libfranka gives this process SCHED_FIFO 99, which all that it starts inherit.
"""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter

import numpy as np
import pylibfranka

from benchmark import nodes
from benchmark.harness import Ratio, ratio
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.drive.franka import FrankaDriver
from blf_dsc_controller.drive.latency import Latency
from blf_dsc_controller.drive.loop import DriveLoop
from blf_dsc_controller.drive.ros_topics import RosTopics

_ROUNDS = 5
_SECONDS = 3.0  # of the robot
_PACE = 2.0  # s of this computer's clock for one of the robot
_SHARES = {'median': 0.5, '99 %': 0.99}
_NULL = 'null loop over pylibfranka'
_SIMULATOR = """
import sys
from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import MujocoSimulator

with MujocoSimulator() as sim:
    sim.add_robot()
    with SimulationServer(sim, hostname_candidates=[sys.argv[1]]) as server:
        print('ready', flush=True)
        server.run_forever(realtime=float(sys.argv[2]))
"""


@contextmanager
def _robot(address: str) -> Iterator[None]:
    """Run a simulated robot at an address."""
    process = subprocess.Popen(
        [sys.executable, '-c', _SIMULATOR, address, f'{_PACE:g}'],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None  # noqa: S101 - for mypy
        process.stdout.readline()
        yield
    finally:
        process.kill()
        process.wait()


def null_loop(address: str) -> Latency:
    """Answer states with the torque of the last one."""
    latency = Latency()
    robot = pylibfranka.Robot(address, pylibfranka.RealtimeConfig.kIgnore)
    robot.read_once()
    control = robot.start_torque_control()
    torques = pylibfranka.Torques([0.0] * 7)
    gc.collect()
    for _ in range(round(1e3 * _SECONDS)):
        control.readOnce()
        received = perf_counter()
        control.writeOnce(torques)
        latency.add(perf_counter() - received)
    torques.motion_finished = True
    control.writeOnce(torques)
    return latency


def law_in_process(address: str, *, ros: bool = False) -> Latency:
    """Run the law as `blf_dsc drive` does, with topics beside it or without."""
    config = load_loop('fr3_direct').controller
    driver = FrankaDriver(address, config, DriveConfig())
    with ArmController(config) as controller:
        topics = RosTopics(controller) if ros else None
        try:
            driver.connect()
            loop = DriveLoop(driver, controller, duration=_SECONDS, beside=topics)
            loop.run()
        finally:
            if topics is not None:
                topics.close()
    return loop.latency


def measure() -> Iterator[Ratio]:
    """Measure times from state to torque relative to those of the null loop."""
    contestants: dict[str, Callable[[str], Latency]] = {
        _NULL: null_loop,
        'law in process': law_in_process,
        'law in process, topics beside it': lambda at: law_in_process(at, ros=True),
    }
    found: dict[str, list[list[float]]] = {name: [] for name in contestants}
    for number in range(_ROUNDS):
        for place, (name, run) in enumerate(contestants.items()):
            address = f'127.0.2.{1 + number * len(contestants) + place}'
            with _robot(address):
                latency = run(address)
            found[name].append([latency.quantile(share) for share in _SHARES.values()])
    over_dds = nodes.latencies('fr3_direct', _ROUNDS)
    figures = {name: np.array(rows) for name, rows in found.items()}
    for column, what in enumerate(_SHARES):
        theirs = figures[_NULL][:, column]
        mine = {
            name: each[:, column] for name, each in figures.items() if name != _NULL
        }
        if what == 'median':
            mine['node over DDS'] = over_dds
        for name, times in mine.items():
            note = f'{1e6 * np.median(times):.0f} us here'
            yield ratio(
                'from state to torque', f'{name}: {what}', _NULL, times, theirs, note
            )
