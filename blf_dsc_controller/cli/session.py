# SPDX-License-Identifier: Apache-2.0
"""One run over ROS: plant and controller, in lock-step as one process, and the recorder."""

from __future__ import annotations

import ctypes
import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from math import inf
from pathlib import Path

from blf_dsc_controller.cli.isolation import environment, localhost_environment, own_domain
from blf_dsc_controller.cli.monitor import FIRST_SIGN, ProgressMonitor
from blf_dsc_controller.compiled.notice import COMPILING
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, RECORDER, VIEW, LoopConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.view.address import free_port, url_of

_LOOP = 'loop'
# Started in this order and stopped in reverse, so that the recorder gets every message.
_MODULES = {
    RECORDER: 'blf_dsc_controller.nodes.recorder_node',
    CONTROLLER: 'blf_dsc_controller.nodes.controller_node',
    PLANT: 'sim_plant.node',
    _LOOP: 'sim_plant.loop',  # both, in lock-step
    VIEW: 'blf_dsc_controller.view.node',  # only on request, once the loop runs
}
_ENDING = 20.0  # s that a node may take to exit before it is killed
_TAIL = 12  # lines of a failed node's log that are shown
_ROOM = 1_000_000  # bytes; with less free space the disk counts as full
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)  # loaded before there are threads
_VIEW_PORT = 8080  # or the next free one


def run_session(config: LoopConfig, out: Path, domain: int | None, view_host: str = '') -> bool:
    """Run recorder, controller and plant on `out/config.yaml` until the plant has ended.

    They run in a ROS domain of their own unless `domain` is given, and with a page at `view_host`
    unless that is empty. Returns False if SIGINT or SIGTERM ended the run; raises NodeFailedError
    if a node exited with an error.
    """
    logs = out / 'logs'
    logs.mkdir()
    with own_domain() if domain is None else nullcontext(domain) as chosen:
        values = {
            'ROS_DOMAIN_ID': str(chosen),
            'ROS_LOG_DIR': str(logs / 'ros'),
            **localhost_environment(),
        }
        try:
            with environment(values):
                return _run_nodes(config, out / 'config.yaml', logs, view_host)
        except NodeFailedError:
            if shutil.disk_usage(out).free < _ROOM:
                print(f'no space left on the disk of {out}', file=sys.stderr)
            if (out / 'bag' / 'metadata.yaml').exists():
                print(f'the recording up to then is in {out / "bag"}', file=sys.stderr)
            raise


class NodeFailedError(BlfDscError):
    """A node exited with an error."""


class NodeProcess:
    """A process of nodes, which does not outlive this one."""

    def __init__(self, name: str, params_file: Path, logs: Path, *arguments: str) -> None:
        self.name = name
        self._noticed = 0
        self._log = logs / f'{name}.log'
        command = [sys.executable, '-m', _MODULES[name], '--ros-args', '--params-file']
        with self._log.open('wb') as output:
            # In its own session: Ctrl-C reaches only the parent, which stops the nodes in order.
            self._process = subprocess.Popen(
                [*command, str(params_file), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, 'PYTHONUNBUFFERED': '1'},
                start_new_session=True,
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - takes no lock that a thread could hold
            )

    @property
    def is_running(self) -> bool:
        """Whether the process is alive."""
        return self._process.poll() is None

    def new_notices(self) -> list[str]:
        """Return what the node has newly reported about compiling its kernels."""
        lines = self._log.read_text(encoding='utf-8', errors='replace').splitlines()
        notices = [line[line.index(COMPILING) :] for line in lines if COMPILING in line]
        new, self._noticed = notices[self._noticed :], len(notices)
        return [f'{self.name}: {notice}' for notice in new]

    def check(self, remark: str = '') -> None:
        """Raise NodeFailedError, with the end of the log, if the node exited with an error."""
        code = self._process.poll()
        if not code:
            return
        names = {int(number): number.name for number in signal.Signals}
        end = f'exited with code {code}'
        if code < 0:
            end = f'was terminated by {names.get(-code, f"signal {-code}")}'
        lines = self._log.read_text(encoding='utf-8', errors='replace').splitlines()[-_TAIL:]
        tail = ''.join(f'\n  {line}' for line in lines)
        raise NodeFailedError(f'{self.name} {end}{remark}:{tail}\n(full log: {self._log})')

    def stop(self) -> None:
        """Interrupt the node and wait until it exits; kill it if it takes too long."""
        if self.is_running:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_ENDING)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _run_nodes(config: LoopConfig, params_file: Path, logs: Path, view_host: str) -> bool:
    nodes: list[NodeProcess] = []
    views: list[NodeProcess] = []
    interrupts: list[int] = []
    remark = ''
    handlers = {
        number: signal.signal(number, lambda number, _: interrupts.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        try:
            loop_of_nodes = [_LOOP] if config.plant.mode == 'lockstep' else [CONTROLLER, PLANT]
            for name in (RECORDER, *loop_of_nodes):
                nodes.append(NodeProcess(name, params_file, logs))  # noqa: PERF401 - those that started are stopped

            def show() -> str:
                port = free_port(view_host, _VIEW_PORT)
                given = ('-p', f'host:={view_host}', '-p', f'port:={port}')
                views.append(NodeProcess(VIEW, params_file, logs, *given))
                return url_of(view_host, port)

            remark = _monitor(config, nodes, interrupts, show if view_host else None)
        finally:
            for node in reversed(nodes + views):
                node.stop()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    recorder, *loop = nodes
    for node in loop:
        node.check()
    recorder.check(remark)
    return not interrupts


def _monitor(
    config: LoopConfig,
    nodes: list[NodeProcess],
    interrupts: list[int],
    show: Callable[[], str] | None,
) -> str:
    """Show the progress until the plant exits or a signal arrives; return a note on the recorder.

    A loop that has begun continues without its recorder; its first message may arrive a bit later.
    `show` starts the page and returns its address; it is called only after that message, since the
    nodes wait for a subscriber, which must be the recorder.
    """
    recorder, *loop = nodes
    ended, warned = inf, False
    with ProgressMonitor(config, interrupts) as monitor:
        while loop[-1].is_running and not interrupts:
            for node in loop:
                node.check()
            if not monitor.has_begun:
                for notice in itertools.chain(*(node.new_notices() for node in loop)):
                    monitor.progress.write(notice)
            if not recorder.is_running:
                ended = min(ended, time.monotonic())
                if monitor.has_begun and not warned:
                    warned = True
                    monitor.progress.write(
                        f'{recorder.name} has ended: the loop continues unrecorded'
                    )
                if not monitor.has_begun and time.monotonic() > ended + FIRST_SIGN:
                    recorder.check()
            if monitor.has_begun and show is not None:
                monitor.progress.write(f'the page: {show()}')
                show = None
            monitor.wait(0.1)
    return '' if recorder.is_running else ' while the loop continued without it'


def _die_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGINT)
