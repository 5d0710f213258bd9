# SPDX-License-Identifier: Apache-2.0
"""A run in real time reports its timing, and the recorder beside it loses no message.

Sequence numbers of the publishers reveal losses. `make test-nightly` records a minute.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import PATIENT, closed_loop
from mcap.reader import make_reader

from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.messages import topics

DURATION = 60 if os.environ.get('NIGHTLY') else 3  # s
SAMPLES = DURATION * 1000 + 1
EACH_SAMPLE = (
    topics.JOINT_STATES,
    topics.TIMING,
    topics.COMMANDS,
    topics.REFERENCE,
    topics.TRACKING_ERROR,
    topics.LEARNING,
)


def sequence_numbers(bag):
    """Sequence numbers that the publisher gave its messages, by topic."""
    found = defaultdict(list)
    with (bag / 'bag_0.mcap').open('rb') as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            found[channel.topic].append(message.sequence)
    return found


@pytest.fixture(scope='module')
def out(tmp_path_factory):
    """Results of a run in real time."""
    folder = tmp_path_factory.mktemp('run')
    config = folder / 'fifo.yaml'
    # Only one node, which cannot keep the others from both processors.
    fifo = 'sim_plant:\n  ros__parameters:\n    realtime: {priority: 10, lock_memory: true}\n'
    config.write_text(fifo + PATIENT)
    arguments = ('--config', config, '--mode', 'realtime', '--duration', DURATION)
    run = closed_loop(*arguments, '--out', folder / 'out')
    assert run.returncode == 0, run.stderr
    (folder / 'out' / 'output.txt').write_text(run.stdout)
    return folder / 'out'


def test_timing_and_permissions_are_reported(out):
    timing = json.loads((out / 'summary.json').read_text())['timing']
    assert set(timing) == {'rate_hz', 'latency_us', 'late_steps'}
    assert timing['rate_hz'] > 0.0
    assert list(timing['latency_us']) == ['p50', 'p99', 'p99.9', 'max']
    assert timing['late_steps'] >= 0
    output = (out / 'output.txt').read_text()
    assert 'real time' in output
    assert 'late steps' in output
    log = (out / 'logs' / f'{topics.PLANT}.log').read_text()
    # Granted or denied, as this machine permits, but always logged.
    assert 'SCHED_FIFO priority 10' in log
    assert 'memory' in log


def test_every_message_of_a_real_time_loop_is_in_the_bag(out):
    recorded = sequence_numbers(out / 'bag')
    facts = read_content(out / 'bag').facts
    for topic in EACH_SAMPLE:
        count = len(recorded[topic.resolved])
        assert recorded[topic.resolved] == list(range(1, count + 1))
        assert facts[f'messages {topic.resolved}'] == f'{count} written, 0 missed'
    logs = [
        (out / 'logs' / f'{node}.log').read_text() for node in (topics.PLANT, topics.CONTROLLER)
    ]
    # On a busy machine the first torque may take seconds, and the plant sends its state again.
    again = logs[0].count('sending the state again')
    assert len(recorded[topics.JOINT_STATES.resolved]) == SAMPLES + again
    assert len(recorded[topics.TIMING.resolved]) == SAMPLES - 1  # one for each step between them
    # On a busy machine the controller may skip a state; it then publishes nothing for it.
    answered = (topics.REFERENCE, topics.TRACKING_ERROR, topics.LEARNING)
    assert len({len(recorded[topic.resolved]) for topic in answered}) == 1
    # Nor were the last ones lost, which no later sequence number would reveal.
    assert not any('not reach every' in log for log in logs)
