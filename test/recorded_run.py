# SPDX-License-Identifier: Apache-2.0
"""Bags of short offline runs, their messages, other readers, a small disk.

And a made-up run.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from collections import Counter, defaultdict
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader

from blf_dsc_controller import load_loop, simulate
from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
)
from blf_dsc_controller.simulation.loop import write_bag

LATCHED = {topics.ROBOT_DESCRIPTION.resolved: [topics.ROBOT_DESCRIPTION.offered]}

# Learns within a second: a window of 0.3 s, which is less excited.
QUICK = {
    'learning.window': 0.3,
    'two_link.excitation_threshold': 1e-7,
}


def loop_config(duration=1.0, **controller):
    """Return the recommended configuration, set to learn quickly."""
    overrides = {PLANT: {'duration': duration}, CONTROLLER: {**QUICK, **controller}}
    return load_loop('recommended', overrides)


def record(path, duration=1.0, compression='none', **controller):
    """Run offline and write the bag; return its folder."""
    config = loop_config(duration, **controller)
    run = simulate(config.controller, config.plant)
    write_bag(path, run, config.plant, compression=compression)
    return path


def messages(path):
    """Return every message as [topic, type, time, bytes]."""
    with open_bag(path) as bag:
        types = bag.held
        return [
            [m.topic, types[m.topic], m.received, m.raw] for m in bag.messages(types)
        ]


def write(path, entries, *, publishers=0):
    """Write messages into a new bag, numbered by so many publishers of each topic, in turn."""
    handles, numbers = {}, Counter()
    with BagWriter(path, flush_interval=None) as bag:
        for topic, type_name, at, raw in entries:
            if topic not in handles:
                handles[topic] = bag.add_topic(topic, type_name, LATCHED.get(topic, []))
            numbers[topic] += 1
            sequence = -(-numbers[topic] // publishers) if publishers else 0
            if raw is not None:  # else lost by the recorder
                bag.write(handles[topic], raw, at, sequence=sequence)
    return path


def of(entries, topic):
    """Return the entries of one topic."""
    return [entry for entry in entries if entry[0] == topic.resolved]


def compared(result):
    """Return the number of values that a verification compared, by last part of the topic."""
    return {each.topic.rsplit('/', 1)[-1]: each.values for each in result.comparisons}


# Bags as seen by readers that do not know this package.


def read(path):
    """Return all messages of a bag as (topic, time, bytes)."""
    with Reader(path) as reader:
        return [(c.topic, at, bytes(raw)) for c, at, raw in reader.messages()]


def messages_of(folder):
    """Return the serialised messages of each topic of a bag, as mcap reads them."""
    found = defaultdict(list)
    with next(folder.glob('*.mcap')).open('rb') as file:
        for _, channel, message in make_reader(file).iter_messages(
            log_time_order=False
        ):
            found[channel.topic].append(message.data)
    return found


def raw_records(data):
    """Yield the records of an intact MCAP file as bytes, with their offsets."""
    at = 8
    while at < len(data) - 8:
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], 'little')
        yield at, data[at:end]
        at = end


def messages_on_disk(path):
    """Return the number of messages in a file that was not closed."""
    count = 0
    # What follows the last whole record does not matter.
    with suppress(Exception), path.open('rb') as stream:
        for record in StreamReader(stream, record_size_limit=None).records:
            count += type(record).__name__ == 'Message'
    return count


@contextmanager
def small_disk(path, megabytes):
    """Mount a disk of this size at a new folder; skip the test where only root may."""
    path.mkdir()
    command = [
        'env',
        'mount',
        '-t',
        'tmpfs',
        '-o',
        f'size={megabytes}m',
        'tmpfs',
        str(path),
    ]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip('a small disk cannot be mounted here: root may')
    try:
        yield path
    finally:
        subprocess.run(['umount', '-l', str(path)], check=False)  # noqa: S607


@contextmanager
def limited_files(path, size):
    """Let no file grow beyond a size [bytes], as anybody may; return a new folder.

    Python would keep what it has written of the bytecode of a module that is imported meanwhile.
    """
    path.mkdir()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writing, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield path
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        sys.dont_write_bytecode = writing


# A made-up run, in which every number is known in advance.

START = 1_000_000_000  # ns
MILLISECOND = 1_000_000  # ns
JOINTS = ('shoulder', 'elbow')
PARAMETERS = ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')
TRUE = np.array([1.0, 0.32, 0.4])
BOUND_RAD = 0.002
LIMIT_NM = 20.0
LATCH_S = 1.5
TIME_CONSTANT_S = 1.0  # of the parameter error from the latch on


def relative_error(time):
    """Return the parameter error relative to the norm of the true parameters."""
    return 0.5 * np.exp(-np.maximum(time - LATCH_S, 0.0) / TIME_CONSTANT_S)


class Synthetic:
    """Signals of the run, as arrays over its samples (n = 2 joints)."""

    def __init__(self, samples):
        self.stamp = START + MILLISECOND * np.arange(samples)
        self.time = 1e-3 * np.arange(samples)
        wave = np.array(
            [np.sin(2 * np.pi * self.time), np.cos(2 * np.pi * self.time)]
        ).T
        self.reference = 1.5 + 0.3 * wave
        self.error = wave * [0.0008, -0.0005]
        self.position = self.reference + self.error
        self.torque = wave * [8.0, 3.0]
        self.estimate = TRUE * (1.0 - relative_error(self.time))[:, np.newaxis]
        self.latched = (self.time >= LATCH_S).astype(float)
        self.disturbance = 0.1 + 0.1 * wave

    def messages(self, *, with_timing=False):
        """Yield every message as (topic, stamp, bytes)."""
        columns = (*PARAMETERS, *(f'disturbance {joint}' for joint in JOINTS))
        # in a different joint order than elsewhere
        states = JointStateEncoder(JOINTS[::-1])
        commands = Float64MultiArrayEncoder(2)
        reference = JointStateEncoder(JOINTS, ('position', 'velocity'))
        tracking = JointStateEncoder(JOINTS)
        learning = JointStateEncoder(
            (*columns, 'bias elbow', 'lambda_min', 'latched', 'compute_time'),
            ('position',),
        )
        truth = JointStateEncoder((*columns, 'position elbow'), ('position',))
        timing = JointStateEncoder(('latency', 'lateness', 'late_steps'), ('position',))
        zero = np.zeros(2)
        bound = JointStateEncoder(JOINTS, ('position', 'effort'))
        yield (
            topics.BOUND,
            START,
            bound.encode(START, [BOUND_RAD] * 2, (), [LIMIT_NM] * 2),
        )
        for k, stamp in enumerate(self.stamp.tolist()):
            yield (
                topics.JOINT_STATES,
                stamp,
                states.encode(stamp, self.position[k, ::-1], zero, zero),
            )
            yield topics.COMMANDS, stamp, commands.encode(self.torque[k])
            yield (
                topics.REFERENCE,
                stamp,
                reference.encode(stamp, self.reference[k], zero),
            )
            yield (
                topics.TRACKING_ERROR,
                stamp,
                tracking.encode(stamp, self.error[k], zero, self.torque[k]),
            )
            vector = [*self.estimate[k], *(0.9 * self.disturbance[k]), 0.1, 0.004]
            yield (
                topics.MONITOR,
                stamp,
                learning.encode(stamp, [*vector, self.latched[k], 1e-9 * k]),
            )
            if k % 10 == 0:
                yield (
                    topics.TRUTH,
                    stamp,
                    truth.encode(stamp, [*TRUE, *self.disturbance[k], 1.0]),
                )
            if with_timing:
                yield (
                    topics.TIMING,
                    stamp,
                    timing.encode(stamp, [1e-6 * k, 0.0, k // 100]),
                )


def write_made(path, messages, rename=lambda topic: topic.resolved):
    """Write messages into a bag, with their stamps as times of receipt."""
    return write(
        path, [[rename(topic), topic.type, at, raw] for topic, at, raw in messages]
    )
