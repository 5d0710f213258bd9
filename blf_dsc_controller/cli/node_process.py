# SPDX-License-Identifier: Apache-2.0
"""Processes of nodes, with their logs, which do not outlive this one."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import subprocess
from pathlib import Path

from blf_dsc_controller import child
from blf_dsc_controller.compiled.announcement import COMPILING
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, RECORDER, VIEW
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.controller_log import NOTHING_COMMANDED, WAITS_FOR_RESET

LOOP = 'loop'
"""Name of the process of controller and plant, in lock-step."""

# Stopped in the reverse of the order in which they start, so that the recorder gets every message.
# The page starts before them.
_MODULES = {
    RECORDER: 'blf_dsc_controller.nodes.recorder_node',
    CONTROLLER: 'blf_dsc_controller.nodes.controller_node',
    PLANT: 'blf_dsc_controller.nodes.plant_node',
    LOOP: 'blf_dsc_controller.nodes.lockstep_loop',  # both, in lock-step
    VIEW: 'blf_dsc_controller.view.node',  # only on request
}
_ENDING = 20.0  # s that a node may take to exit before it is killed
_TAIL = 12  # lines of a failed node's log that are shown
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)  # loaded before there are threads
_PAGE = 'open http'  # in the log of the node that serves it


class NodeProcess:
    """A process of nodes, which does not outlive this one.

    Attributes:
        log: file of what it says.
        patience: time [s] that it may take to exit before it is killed.
    """

    def __init__(
        self, name: str, params_file: Path, logs: Path, *arguments: str
    ) -> None:
        self.name = name
        self.patience = _ENDING
        self._noticed = 0
        self.log = logs / f'{name}.log'
        module = _MODULES.get(name, name)  # of the benchmark, for instance
        command = [*child.running_module(module), '--ros-args', '--params-file']
        with self.log.open('wb') as output:
            # In its own session: Ctrl-C reaches only the parent, which stops the nodes
            # in order.
            self._process = subprocess.Popen(
                [*command, str(params_file), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **child.places(), 'PYTHONUNBUFFERED': '1'},
                start_new_session=True,
                # it holds the claim of the domain, which ends with the last node
                close_fds=False,
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - takes no lock that a thread could hold
            )

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether the process is alive."""
        return self._process.poll() is None

    @property
    def serves(self) -> bool:
        """Whether the node has said where its page is."""
        return any(_PAGE in line for line in self._whole_lines())

    @property
    def waits_for_reset(self) -> bool:
        """Whether the node has said that it stopped before its first torque, and goes on."""
        return any(
            f'{NOTHING_COMMANDED}: ' in line and line.endswith(WAITS_FOR_RESET)
            for line in self._whole_lines()
        )

    def take_notices(self) -> list[str]:
        """Return what the node has reported of its kernels or its page since the last call."""
        found = (
            re.search(f'({COMPILING}|{_PAGE}).*', line) for line in self._whole_lines()
        )
        notices = [each[0] for each in found if each]
        new = notices[self._noticed :]
        self._noticed = len(notices)
        return [f'{self.name}: {notice}' for notice in new]

    def check(self) -> None:
        """Raise BlfDscError, with the end of the log, if the node failed."""
        code = self._process.poll()
        if not code:
            return
        end = f'exited with code {code}'
        if code < 0:
            end = f'was terminated by {signal.Signals(-code).name}'
        tail = ''.join(f'\n  {line}' for line in self._said().splitlines()[-_TAIL:])
        raise BlfDscError(f'{self.name} {end}:{tail}\n(full log: {self.log})')

    def _said(self) -> str:
        return self.log.read_text(encoding='utf-8', errors='replace')

    def _whole_lines(self) -> list[str]:
        """Return the lines of the log but for one that is being written."""
        return self._said().rpartition('\n')[0].splitlines()

    def stop(self) -> None:
        """Interrupt the node and wait until it exits; kill it if it takes too long."""
        if self.is_running:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(self.patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _die_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGINT)
