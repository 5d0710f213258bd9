# SPDX-License-Identifier: Apache-2.0
"""kill -9 of the recorder at random times: everything but the last 0.1 s is recovered.

`make test-nightly` kills ten times within a minute of recording, and prints each loss.
"""

from __future__ import annotations

import os
import random
import signal
import struct
import tempfile
import time
from bisect import bisect_right
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from foreign_readers import read
from mcap.reader import make_reader
from rclpy.qos import QoSProfile
from recorder_rig import Rig

from blf_dsc_controller.bags.recover import recover

LONG = bool(os.environ.get('NIGHTLY'))
KILLS = 10 if LONG else 3
LONGEST = 12.0 if LONG else 1.0  # s of recording before a kill: ten take a minute on average
PERIOD = 1_000_000  # ns between two messages of a topic
PROMISE = 100_000_000  # ns, the most that a kill may lose
TOPICS = ('a', 'b', 'c', 'd', 'e')


class Waiting:
    """Time that the threads of a process spent waiting for a processor, excused in the test."""

    def __init__(self, pid):
        self._pid = pid
        self._times = []  # ns
        self._waited = []  # ns of each thread, at these times

    def look(self):
        """Record the waiting times."""
        self._times.append(time.time_ns())
        self._waited.append(self._of_threads())

    def since(self, start):
        """Sum over the threads [ns] from a time [ns] to the last look."""
        first = self._waited[max(0, bisect_right(self._times, start) - 1)]
        last = self._waited[-1]
        return sum(waited - first.get(thread, 0) for thread, waited in last.items())

    def _of_threads(self):
        found = dict(self._waited[-1]) if self._waited else {}  # keeps threads that have ended
        for path in Path(f'/proc/{self._pid}/task').glob('*/schedstat'):
            try:
                found[path.parent.name] = int(path.read_text().split()[1])
            except (OSError, ValueError, IndexError):  # thread ended; or not supported
                continue
        return found


class Stream:
    """Numbered messages, one per topic and millisecond."""

    def __init__(self, rig):
        self._rig = rig
        self._begin = time.time_ns()
        self.sent = []  # ns, time at which publishing of each number began

    def go_on_until(self, condition, each):
        """Publish until a condition holds; check it and call `each` every 10 ms."""
        while not condition():
            each()
            for _ in range(10):
                number = len(self.sent)
                ahead = self._begin + number * PERIOD - time.time_ns()
                time.sleep(max(0.0, ahead * 1e-9))
                self.sent.append(time.time_ns())
                self._rig.publish(number)

    def go_on_for(self, seconds, each):
        """Publish for a while."""
        end = time.monotonic() + seconds
        self.go_on_until(lambda: time.monotonic() >= end, each)


@pytest.fixture
def memory():
    """A folder in memory, so that a busy disk does not delay the recorder."""
    with tempfile.TemporaryDirectory(dir='/dev/shm') as folder:
        yield Path(folder)


def size(bag):
    try:
        return (bag / f'{bag.name}_0.mcap').stat().st_size
    except FileNotFoundError:
        return 0


def recovered(bag, out):
    """Numbers of the recovered messages by topic; both independent readers agree on them."""
    recovery = recover(bag, out)
    *cut, last = recovery.losses
    assert 'the recording was not closed' in last
    assert all('(cut off)' in loss for loss in cut)
    (file,) = out.glob('*.mcap')
    found = read(out)
    with file.open('rb') as stream:
        messages = list(make_reader(stream).iter_messages())
    assert [message.data for _, _, message in messages] == [raw for _, _, raw in found]
    numbers = {topic: [] for topic in TOPICS}
    for topic, _, raw in found:
        seconds, nanoseconds = struct.unpack_from('<iI', raw, 4)
        numbers[topic[1:]].append(seconds * 10**9 + nanoseconds)
    return numbers


@pytest.mark.parametrize('k', range(KILLS))
def test_kill_loses_at_most_the_last_tenth_of_a_second(k, memory, tmp_path):
    # Each kill has its own publishers: those that knew a killed reader delay others.
    rig = Rig(TOPICS, QoSProfile(depth=5000))
    try:
        process = rig.start(memory / 'bag')
        waiting, own = Waiting(process.pid), Waiting(os.getpid())

        def look():
            waiting.look()
            own.look()

        stream = Stream(rig)
        stream.go_on_until(lambda: size(memory / 'bag') > 50_000, look)  # it is recording
        stream.go_on_for(random.Random(k).uniform(0.0, LONGEST), look)  # noqa: S311
        killed = time.time_ns()
        process.send_signal(signal.SIGKILL)
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # /proc then has its last wait
        look()
    finally:
        rig.close()
    for topic, numbers in recovered(memory / 'bag', tmp_path / 'clean').items():
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
        rest = stream.sent[numbers[-1] + 1 :]
        lost = killed - rest[0] if rest else 0  # ns
        excused = waiting.since(killed - lost) + own.since(killed - lost)
        print(  # noqa: T201 - shown by make test-nightly
            f'killed after {len(numbers):5} of /{topic}: without the last {lost * 1e-6:5.1f} ms; '
            f'it and the publisher waited for a processor {excused * 1e-6:.1f} ms of these'
        )
        # Lost messages had been sent, perhaps even received, no longer ago than this.
        assert lost <= PROMISE + excused
