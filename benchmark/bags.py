# SPDX-License-Identifier: Apache-2.0
"""The recorder against a raw subscriber, and replay against the mcap reader, which only reads."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from harness import Contestant, Ratio, interleaved, own_graph, ratio, wait_for
from mcap.reader import make_reader

from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import STREAM
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate

_ROUNDS = 5
_TOPICS = 5
_MESSAGES = 5000  # per topic, at 1 kHz
_SETTLING = 1.0  # s for discovery
_SUBSCRIBER = 'raw subscriber, nothing written'
_RECORDERS = {'recorder': 'none', 'recorder, zstd': 'zstd'}
_DURATION = 60.0  # s
_READER = 'mcap reader, messages as bytes'
_CONTENT = 'messages read and decoded'
_REPLAY = 'bag replayed through the law and compared'


def measure() -> Iterator[Ratio]:
    """Measure the CPU time per message relative to the raw subscriber."""
    with own_graph():
        times = _cpu_times()
    for name in _RECORDERS:
        note = f'{1e6 * np.median(times[name]) / (_TOPICS * _MESSAGES):.1f} us a message here'
        yield ratio('recording', f'{name}: CPU', _SUBSCRIBER, times[name], times[_SUBSCRIBER], note)


def _cpu_times() -> dict[str, np.ndarray]:
    """Return the CPU time (rounds,) [s] of each contestant."""
    import rclpy

    context = rclpy.Context()
    rclpy.init(context=context)
    node: Any = rclpy.create_node('source', context=context)
    cpu: dict[str, list[float]] = {name: [] for name in (_SUBSCRIBER, *_RECORDERS)}
    try:
        with tempfile.TemporaryDirectory() as folder:
            for k in range(_ROUNDS):
                for name, spent in cpu.items():
                    command = _command(name, Path(folder, f'{k}-{name}'.replace(', ', '-')))
                    spent.append(_play(node, Contestant(name, command)))
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)
    return {name: np.array(values) for name, values in cpu.items()}


def _command(name: str, bag: Path) -> list[str]:
    if name == _SUBSCRIBER:
        return [str(Path(__file__).with_name('null_node.py')), 'drop', str(_TOPICS)]
    parameters = (f'output:={bag}', f'compression:={_RECORDERS[name]}')
    arguments = [word for parameter in parameters for word in ('-p', parameter)]
    return ['-m', 'blf_dsc_controller.nodes.recorder_node', '--ros-args', *arguments]


def _play(node: Any, contestant: Contestant) -> float:
    """Return the CPU time [s] that a contestant spends on all messages."""
    from sensor_msgs.msg import JointState

    from blf_dsc_controller.nodes.endpoints import qos_profile

    publishers = [
        node.create_publisher(JointState, f'topic{i}', qos_profile(STREAM)) for i in range(_TOPICS)
    ]
    encoder = JointStateEncoder(('joint1', 'joint2'))
    try:
        wait_for(
            lambda: all(publisher.get_subscription_count() == 1 for publisher in publishers),
            f'the subscriptions of {contestant.name}',
            [contestant],
        )
        time.sleep(_SETTLING)
        before = contestant.cpu_time()
        begin = time.perf_counter()
        for k in range(_MESSAGES):
            message = encoder.encode(k * 1_000_000, (1.0, 2.0), (3.0, 4.0), (5.0, 6.0))
            for publisher in publishers:
                publisher.publish(message)
            time.sleep(max(0.0, begin + 1e-3 * (k + 1) - time.perf_counter()))
        time.sleep(0.5)
        contestant.check()
        return contestant.cpu_time() - before
    finally:
        contestant.end()
        for publisher in publishers:
            node.destroy_publisher(publisher)


def measure_replay() -> Iterator[Ratio]:
    """Measure messages per second relative to the reader alone, on a bag of all topics."""
    controller, plant = ControllerConfig(), PlantConfig(duration=_DURATION)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder, 'bag')
        write_bag(bag, simulate(controller, plant), controller, 'none', plant)
        messages = _iterated(bag)

        def replayed() -> int:
            found = verify(bag)
            if found.difference is not None:
                raise ValueError(f'{bag}: {found.difference}')
            return messages

        contestants = {
            _READER: lambda: _iterated(bag),
            _CONTENT: lambda: sum(read_content(bag).message_counts.values()),
            _REPLAY: replayed,
        }
        times = interleaved(contestants, _ROUNDS)
    for name in (_CONTENT, _REPLAY):
        note = f'{1e-3 / np.median(times[name]):.0f} thousand messages a second here'
        what = f'{name}: messages a second'
        yield ratio('replay', what, _READER, 1.0 / times[name], 1.0 / times[_READER], note)


def _iterated(bag: Path) -> int:
    """Iterate over the messages of a bag of one file and return their number."""
    (file,) = bag.glob('*.mcap')
    with file.open('rb') as stream:
        return sum(1 for _ in make_reader(stream).iter_messages(log_time_order=False))
