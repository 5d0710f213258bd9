# SPDX-License-Identifier: Apache-2.0
"""Contestants that are processes: started, watched while they are waited for, and ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Protocol

from blf_dsc_controller.cli.session import own_domain
from blf_dsc_controller.errors import BlfDscError

_START_UP = 120.0  # s, kernels may have to be compiled
_ENDING = 20.0  # s from SIGINT to the end
_LAST_WORDS = 2000  # characters of stderr that an error repeats
_CPUCLOCK_SCHED = 2  # as clock_getcpuclockid(3) does it: nanoseconds, where /proc has hundredths


class Watched(Protocol):
    """What is waited for: a process, or a node in this one."""

    name: str

    def check(self) -> None:
        """Raise ContestantError if it cannot go on."""

    def cpu_time(self) -> float:
        """CPU time so far [s]."""


class ContestantError(BlfDscError):
    """A contestant has ended before its time, or is not heard of."""


class Contestant:
    """A process of this Python.

    Args:
        name: for messages.
        arguments: of Python: a script or `-m module`, and what they are told.
        environment: added to that of this process.
    """

    def __init__(
        self, name: str, arguments: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        self.name = name
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        self._process = subprocess.Popen(
            [sys.executable, *arguments],
            env={**os.environ, **(environment or {})},
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
        )
        self.pid = self._process.pid

    def cpu_time(self) -> float:
        """User and system time of the process so far [s]."""
        return time.clock_gettime(~self.pid << 3 | _CPUCLOCK_SCHED)

    def check(self) -> None:
        """Raise ContestantError, with what it said, if the process has ended."""
        code = self._process.poll()
        if code is not None:
            raise ContestantError(f'{self.name} ended with exit code {code}:\n{self._said()}')

    def end(self) -> None:
        """End the process as Ctrl-C does, and by force where that is not enough."""
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_ENDING)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()

    def _said(self) -> str:
        self._errors.seek(0)
        return self._errors.read().decode(errors='replace')[-_LAST_WORDS:].strip() or 'no word'


def wait_for(
    condition: Callable[[], bool],
    what: str,
    contestants: Sequence[Watched] = (),
    pause: Callable[[], object] = lambda: time.sleep(0.02),
    patience: float = _START_UP,
) -> None:
    """Wait until the condition holds.

    Args:
        condition: asked again and again.
        what: is waited for, for the message.
        contestants: that must live meanwhile.
        pause: between two questions.
        patience: longest time [s].

    Raises:
        ContestantError: a contestant has ended, or it takes longer.
    """
    begin = time.perf_counter()
    while not condition():
        for contestant in contestants:
            contestant.check()
        if time.perf_counter() - begin > patience:
            raise ContestantError(f'waited {patience:g} s for {what} in vain')
        pause()


@contextmanager
def own_graph() -> Iterator[None]:
    """Let the ROS nodes of this process and of its contestants hear nobody else."""
    with own_domain() as domain:
        os.environ['ROS_DOMAIN_ID'] = str(domain)
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        yield
