# SPDX-License-Identifier: Apache-2.0
"""Requests to the operating system: refusals are logged and survived."""

from __future__ import annotations

import ctypes
import errno
import os

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from blf_dsc_controller.configuration.schema import Realtime
from blf_dsc_controller.nodes.process import request_realtime


class Log:
    """A logger that keeps what is logged."""

    def __init__(self):
        self.logged = []
        self.warned = []

    def info(self, text):
        self.logged.append(text)

    def warning(self, text):
        self.warned.append(text)


@pytest.fixture
def system(monkeypatch):
    """A system that records requests, and refuses those named in `refused`."""

    class System:
        def __init__(self):
            self.refused = ()
            self.scheduled = []
            self.locked = []

        def schedule(self, thread, policy, parameters):
            if 'schedule' in self.refused:
                raise PermissionError(errno.EPERM, 'Operation not permitted')
            self.scheduled.append((thread, policy, parameters.sched_priority))

        def mlockall(self, flags):
            if 'lock' in self.refused:
                ctypes.set_errno(errno.ENOMEM)
                return -1
            self.locked.append(flags)
            return 0

    fake = System()
    monkeypatch.setattr(os, 'sched_setscheduler', fake.schedule)
    monkeypatch.setattr(ctypes, 'CDLL', lambda *_, **__: fake)
    return fake


def log_of_request(**values):
    log = Log()
    request_realtime(Realtime(**values), log)
    return log


def test_nothing_is_requested_by_default(system):
    log = log_of_request()
    assert (system.scheduled, system.locked) == ([], [])
    assert (log.logged, log.warned) == ([], [])


def test_every_thread_gets_the_priority(system):
    log = log_of_request(priority=50)
    threads = {int(name) for name in os.listdir('/proc/self/task')}  # noqa: PTH208
    assert {thread for thread, *_ in system.scheduled} == threads
    assert {(policy, level) for _, policy, level in system.scheduled} == {(os.SCHED_FIFO, 50)}
    assert log.logged == ['running with SCHED_FIFO priority 50']


def test_present_and_future_memory_is_locked(system):
    log = log_of_request(lock_memory=True)
    assert system.locked == [1 | 2]  # MCL_CURRENT | MCL_FUTURE of Linux
    assert log.logged == ['memory locked']


def test_refusal_is_logged_with_its_remedy_and_survived(system):
    system.refused = ('schedule', 'lock')
    log = log_of_request(priority=50, lock_memory=True)
    assert log.logged == []
    schedule, lock = log.warned
    assert 'priority 50 refused (Operation not permitted)' in schedule
    assert 'rtprio' in schedule
    assert 'locking memory refused (Cannot allocate memory)' in lock
    assert 'memlock' in lock
