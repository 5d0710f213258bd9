# SPDX-License-Identifier: Apache-2.0
"""Recording beside a real-time loop, on the same processors, loses no message.

Sequence numbers of the publishers reveal losses. `make test-long` records and prints a minute.
"""

from __future__ import annotations

import os
from collections import defaultdict

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import closed_loop
from mcap.reader import make_reader

from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.cli.run import STOPPED
from blf_dsc_controller.messages import topics

DURATION = 60 if os.environ.get('LONG_TESTS') else 3  # s
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


def test_every_message_of_a_real_time_loop_is_in_the_bag(tmp_path):
    run = closed_loop('--mode', 'realtime', '--duration', DURATION, '--out', tmp_path / 'out')
    # On a busy machine the controller may stop: everything is still recorded.
    assert run.returncode in (0, STOPPED), run.stderr
    recorded = sequence_numbers(tmp_path / 'out' / 'bag')
    facts = read_context(tmp_path / 'out' / 'bag').facts
    for topic in EACH_SAMPLE:
        counts = facts[f'messages {topic.resolved}']
        print(f'{topic.resolved}: {counts}')  # noqa: T201 - shown by make test-long
        count = len(recorded[topic.resolved])
        assert recorded[topic.resolved] == list(range(1, count + 1))
        assert counts == f'{count} written, 0 missed'
    logs = tmp_path / 'out' / 'logs'
    # On a busy machine the first torque may take seconds, and the plant sends its state again.
    again = (logs / f'{topics.PLANT}.log').read_text().count('sending the state again')
    assert len(recorded[topics.JOINT_STATES.resolved]) == SAMPLES + again
    assert len(recorded[topics.TIMING.resolved]) == SAMPLES - 1  # one for each step between them
    # On a busy machine the controller may skip a state; it then publishes nothing for it.
    answered = (topics.REFERENCE, topics.TRACKING_ERROR, topics.LEARNING)
    assert len({len(recorded[topic.resolved]) for topic in answered}) == 1
    # Nor were the last ones lost, which no later sequence number would reveal.
    for node in (topics.PLANT, topics.CONTROLLER):
        assert 'not reach every' not in (logs / f'{node}.log').read_text()
