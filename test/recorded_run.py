# SPDX-License-Identifier: Apache-2.0
"""Bags of short offline runs of the real law, their messages, other readers, a small disk."""

from __future__ import annotations

import subprocess
from collections import Counter
from contextlib import contextmanager, suppress

import pytest
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader

from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, load_loop
from blf_dsc_controller.simulation.loop import simulate, write_bag

# Learns within a second: a window of half a second, which is less excited.
QUICK = {
    'learning.window': 0.5,
    'learning.settling_time': 0.1,
    'learning.excitation_threshold': 1e-7,
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
        return [[m.topic, types[m.topic], m.received, m.raw] for m in bag.messages(types)]


def write(path, entries, *, publishers=0):
    """Write messages into a new bag, numbered by so many publishers of each topic, in turn."""
    handles, numbers = {}, Counter()
    with BagWriter(path, flush_interval=None) as bag:
        for topic, type_name, at, raw in entries:
            if topic not in handles:
                handles[topic] = bag.add_topic(topic, type_name, [])
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
    command = ['env', 'mount', '-t', 'tmpfs', '-o', f'size={megabytes}m', 'tmpfs', str(path)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip('a small disk cannot be mounted here: root may')
    try:
        yield path
    finally:
        subprocess.run(['umount', '-l', str(path)], check=False)  # noqa: S607
