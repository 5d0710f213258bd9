# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes of their own, started and ended together."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError

_PATIENCE = 20.0  # s that a node may take to end before it is killed
_TAIL = 12  # lines of a failed node's log that are shown
_PR_SET_PDEATHSIG = 1


class NodeFailedError(BlfDscError):
    """A node ended with an error of its own; `remark` follows what is said of its end."""

    def __init__(self, name: str, code: int, log: Path, remark: str = '') -> None:
        self.name = name
        self.code = code
        self.log = log
        end = f'was ended by {_signal(-code)}' if code < 0 else f'ended with exit code {code}'
        lines = log.read_text(encoding='utf-8', errors='replace').splitlines()[-_TAIL:]
        tail = ''.join(f'\n  {line}' for line in lines)
        super().__init__(f'{name} {end}{remark}:{tail}\n(all that it said: {log})')


class NodeProcess:
    """One node in a process of its own, which does not outlive this one.

    Args:
        name: for messages and the log's name.
        module: module to run.
        params_file: ROS parameter file.
        log: file that takes what the node prints.
        environment: added to this process's.
    """

    def __init__(
        self, name: str, module: str, params_file: Path, log: Path, environment: dict[str, str]
    ) -> None:
        self.name = name
        self._log = log
        with log.open('wb') as output:
            # A session of its own: Ctrl-C reaches the parent alone, which ends the nodes in order.
            self._process = subprocess.Popen(
                [sys.executable, '-m', module, '--ros-args', '--params-file', str(params_file)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, 'PYTHONUNBUFFERED': '1', **environment},
                start_new_session=True,
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - no threads have been started yet
            )

    @property
    def is_running(self) -> bool:
        """Whether the process is there."""
        return self._process.poll() is None

    def check(self, remark: str = '') -> None:
        """Raise NodeFailedError, with this remark, if the node has ended with an error."""
        code = self._process.poll()
        if code:
            raise NodeFailedError(self.name, code, self._log, remark)

    def stop(self) -> None:
        """Ask the node to end and wait for it; past its time it is killed."""
        if self.is_running:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f'signal {number}'


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)
