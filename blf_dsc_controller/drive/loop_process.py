# SPDX-License-Identifier: Apache-2.0
"""The process that controls the arm of a script, as the script sees it.

A thread listens to what `script_process` tells: states, results of requests, and why it ended.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from blf_dsc_controller import child
from blf_dsc_controller.drive.arguments import checked_timeout
from blf_dsc_controller.errors import (
    DriveError,
    LoopEndedError,
    NotInTimeError,
)
from blf_dsc_controller.messages import script_link, topic_link
from blf_dsc_controller.messages.link import LinkedProcess
from blf_dsc_controller.messages.script_link import ArmState

_MODULE = 'blf_dsc_controller.drive.script_process'
_POLL = 0.1  # s
_SILENCE = 10.0  # s without a word of a loop that runs
_CLOSING = 60.0  # s likewise of one that ends, and may write a bag
_END = 5.0  # s, for a process that was told to end at once
_LOG = logging.getLogger('blf_dsc_controller')


class LoopProcess:
    """A process that controls an arm, and what it has told.

    Attributes:
        joints: names of the joints, once the arm is in command.
        ended: why the loop has ended; empty while it runs.
    """

    def __init__(self, wanted: Mapping[str, Any]) -> None:
        """Start it, and wait until the arm is held: `wanted` is the content of START.

        Raises:
            LoopEndedError: it cannot control this arm, and says why.
        """
        if os.name != 'posix':
            raise DriveError(
                'the loop of a Drive has a process of its own, which needs Linux or macOS: use '
                'ArmController in a loop of yours'
            )
        self.joints: tuple[str, ...] = ()
        self._owner = os.getpid()
        self._news = threading.Condition()
        self._closed = False
        self._count = 0  # of requests
        self._forget()
        self._link = LinkedProcess(
            _MODULE,
            variables=child.ONE_THREAD,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the script, which brakes
        )
        self._process = self._link.process
        self._send(script_link.START, topic_link.encode(wanted))
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        try:
            self._await_running()
        except BaseException:
            if self._process.poll() is None:
                self._process.send_signal(signal.SIGTERM)
            self.end()
            raise

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    @property
    def state(self) -> ArmState:
        """The last state that it told.

        Raises:
            LoopEndedError: it has ended.
        """
        self.check()
        assert self._state is not None  # noqa: S101 - since it runs
        return self._state

    @property
    def can_recover(self) -> bool:
        """Whether the loop has ended, and its process can begin another one."""
        return self._waits and self._process.poll() is None

    def put(self, kind: int, content: bytes) -> None:
        """Send a message of `script_link`.

        Raises:
            LoopEndedError: it has ended.
        """
        self.check()
        self._send(kind, content)

    def brake(self) -> None:
        """Let the arm brake within the limits, if the loop runs, and return at once."""
        with contextlib.suppress(DriveError):
            self.request(script_link.BRAKE, None)

    def request(self, kind: int, wanted: Any) -> Future[str]:
        """Send a request; its result says why it failed, or is empty once it is done.

        Raises:
            LoopEndedError: it has ended.
        """
        self.check()
        result: Future[str] = Future()
        with self._news:
            self._count += 1
            number = self._count
            self._results[number] = result
        self._send(kind, script_link.request(number, wanted))
        return result

    def await_result(self, result: Future[str], timeout: float | None) -> str:
        """Wait for the end of a request, and return its result.

        Raises:
            NotInTimeError: after the timeout [s].
            LoopEndedError: it ends before.
        """
        self._until(result.done, timeout)
        return result.result()

    def recover(self) -> None:
        """Begin another loop in the same process, and wait until the arm is held."""
        self._forget()
        self._send(script_link.RECOVER, b'{}')
        self._await_running()

    def close(self) -> None:
        """Bring the arm to rest, and end the process; a second Ctrl-C ends it at once."""
        if os.getpid() != self._owner:
            return  # a fork of the script ends, and not the script
        self._closed = True
        try:
            self._close_softly()
        except KeyboardInterrupt:
            self._send(script_link.CLOSE, b'null')
            self.end()
            raise
        self.end()

    def end(self) -> None:
        """Wait for a process that is about to end, or kill it."""
        self._link.await_end(_END)
        self._listener.join()
        self._link.close()

    def check(self) -> None:
        """Raise an error if nothing can be asked of it.

        Raises:
            DriveError: in a fork of the script, which hears nothing of the loop.
            LoopEndedError: it has ended, or says nothing any more.
        """
        if os.getpid() != self._owner:
            raise DriveError(
                f'this Drive is of process {self._owner}, and this is a fork of it: command the '
                'arm there'
            )
        if self.ended and self._closed:
            raise LoopEndedError(
                'this Drive was closed, as at the end of its block: make another one, or '
                'recover() starts it again'
            )
        if self.ended:
            again = 'takes command again' if self._waits else 'starts another loop'
            remedy = f'; recover() {again}' if self._runs else ''
            raise LoopEndedError(f'{self.ended}{remedy}')
        silent = time.monotonic() - self._heard
        if self._runs and silent > _SILENCE:
            raise LoopEndedError(
                f'the loop has said nothing for {silent:.0f} s: look at the arm, then close()'
            )

    def _forget(self) -> None:
        """Forget what an earlier loop told."""
        self.ended = ''
        self._state: ArmState | None = None
        self._waits = self._runs = False
        self._results: dict[int, Future[str]] = {}  # of requests that are not over
        self._heard = time.monotonic()

    def _send(self, kind: int, content: bytes) -> None:
        self._link.put(kind, content)
        self._link.flush()

    def _await_running(self) -> None:
        self._until(lambda: self._runs and self._state is not None, None)

    def _until(self, condition: Callable[[], bool], timeout: float | None) -> None:
        """Wait until a condition holds; the link is flushed meanwhile."""
        end = time.monotonic() + checked_timeout(timeout)
        with self._news:
            while not condition():
                self.check()
                if time.monotonic() > end:
                    raise NotInTimeError(f'not over after {timeout} s')
                self._link.flush()
                self._news.wait(_POLL)

    def _close_softly(self) -> None:
        """Tell the loop to end, and wait as long as it says something."""
        if self._process.poll() is not None:
            return
        self._send(script_link.CLOSE, b'null')
        self._heard = time.monotonic()
        while self._process.poll() is None:
            if time.monotonic() - self._heard > _CLOSING:
                _LOG.error(f'the loop does not end: silent for {_CLOSING:g} s, killed')
                return
            with self._news:
                self._news.wait(_POLL)

    # What the process tells, in a thread.

    def _listen(self) -> None:
        for kind, content in self._link.all_messages():
            with self._news:
                self._take(kind, content)
                self._news.notify_all()
        code = self._process.wait()
        with self._news:
            if not self.ended:
                self._waits = False
                self.ended = _death(code)
            self._news.notify_all()

    def _take(self, kind: int, content: bytes) -> None:
        self._heard = time.monotonic()
        if kind == script_link.SAMPLE:
            self._state = script_link.decode_sample(content, len(self.joints))
            return
        told = topic_link.decode(content)
        if kind == script_link.RUNNING:
            self.joints = tuple(told)
            self._runs = True
        elif kind == script_link.DONE:
            if result := self._results.pop(told['number'], None):
                result.set_result(told['problem'])
        elif kind == script_link.ENDED:
            reason = f': {told["text"]}' if told['text'] else ''
            self._waits = told['waits']
            self.ended = f'{told["end"]}{reason}'
        elif kind == script_link.FAILED:
            self._waits = False
            self.ended = told
        elif kind == topic_link.LOG:
            _LOG.log(logging.getLevelName(told['level'].upper()), told['text'])


def _death(code: int) -> str:
    """Return what is known of a process that ended without a word."""
    how = f'by signal {-code}' if code < 0 else f'with exit code {code}'
    return (
        f'the process of the loop ended {how}, without bringing the arm to rest: look at the '
        'robot; stderr may say why'
    )
