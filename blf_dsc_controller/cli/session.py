# SPDX-License-Identifier: Apache-2.0
"""One run over ROS, from the start of its processes to their end.

Plant and controller are one process in lock-step, and the recorder is another.
"""

from __future__ import annotations

import shutil
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from tqdm import tqdm

from blf_dsc_controller.cli.domains import own_domain
from blf_dsc_controller.cli.isolation import environment, localhost_environment
from blf_dsc_controller.cli.node_process import LOOP, NodeProcess
from blf_dsc_controller.cli.progress_monitor import ProgressMonitor
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    RECORDER,
    VIEW,
    LoopConfig,
)
from blf_dsc_controller.errors import BlfDscError

_UNHEARD = 1.0  # s that a node may take to exit while nobody records its messages
_MIN_FREE_SPACE = 1_000_000  # bytes; with less free space the disk counts as full
_ENDED = 'the run has ended: its page replays it until Ctrl-C, then the results follow'


def run_session(config: LoopConfig, out: Path, *, view: bool) -> bool:
    """Run recorder, controller and plant on `out/config.yaml` to the end.

    They run in a ROS domain of their own, and with a page if they should be viewed, which is
    served before they start.
    Returns False if a signal to this process, or to another node than the plant, ended
    the run; raises BlfDscError if a node exited with an error, or no page can be served,
    and KeyboardInterrupt, without a bag, if a signal came before the loop had begun.
    """
    logs = out / 'logs'
    logs.mkdir()
    try:
        return _run_alone(config, out / 'config.yaml', logs, view=view)
    except BlfDscError:
        if shutil.disk_usage(out).free < _MIN_FREE_SPACE:
            print(f'no space left on the disk of {out}', file=sys.stderr)
        bag = out / 'bag'
        if (bag / 'metadata.yaml').exists():
            print(f'the recording up to then is in {bag}', file=sys.stderr)
        elif bag.exists():
            print(f'blf_dsc recover {bag} saves what was recorded', file=sys.stderr)
        raise
    except KeyboardInterrupt:
        shutil.rmtree(out / 'bag', ignore_errors=True)  # empty, if it is there already
        raise


def _run_alone(
    config: LoopConfig, params_file: Path, logs: Path, *, view: bool
) -> bool:
    """Run the nodes in a domain in which nobody else is, also after it was entered."""
    left: list[int] = []
    while True:
        with own_domain(left) as domain:
            values = {'ROS_DOMAIN_ID': str(domain), 'ROS_LOG_DIR': str(logs / 'ros')}
            with (
                environment(values | localhost_environment()),
                closing(ProgressMonitor(config.plant.duration)) as monitor,
            ):
                if not monitor.others(domain):
                    return _run_nodes(config, monitor, params_file, logs, view=view)
            left.append(domain)


@contextmanager
def _kept_interrupts() -> Iterator[list[int]]:
    """Give the list of SIGINT and SIGTERM that come meanwhile; they end nothing."""
    interrupts: list[int] = []
    with ExitStack() as handlers:
        for number in (signal.SIGINT, signal.SIGTERM):
            before = signal.signal(number, lambda number, _: interrupts.append(number))
            handlers.callback(signal.signal, number, before)
        yield interrupts


def _run_nodes(
    config: LoopConfig,
    monitor: ProgressMonitor,
    params_file: Path,
    logs: Path,
    *,
    view: bool,
) -> bool:
    """Run the nodes until the plant has ended.

    A controller that stops before its first torque ends it, too. Return False if something
    else did; raise KeyboardInterrupt if the run had not begun.
    """
    # stops the nodes in reverse, then restores the handlers
    with ExitStack() as ending:
        interrupts = ending.enter_context(_kept_interrupts())

        def started(name: str) -> NodeProcess:
            node = NodeProcess(name, params_file, logs)
            ending.callback(node.stop)
            return node

        # First, so that it sees the whole run: that may be over before a page is served.
        pages = [started(VIEW)] if view else []
        _wait_for_pages(pages, monitor, interrupts)
        is_lockstep = config.plant.mode == 'lockstep'
        loop = [LOOP] if is_lockstep else [CONTROLLER, PLANT]
        nodes = [started(name) for name in (RECORDER, *loop)]

        def is_running() -> bool:
            return all(node.is_running for node in nodes) and not interrupts

        def has_stopped() -> bool:
            return monitor.start is None and any(n.waits_for_reset for n in nodes[1:])

        _wait_while(
            lambda: is_running() and monitor.start is None and not has_stopped(),
            monitor,
            nodes,
        )
        stopped = has_stopped()  # and nobody will reset it: the arm would wait for ever
        _wait_while(lambda: is_running() and not stopped, monitor, pages)
        if interrupts and monitor.start is None:
            _do_not_wait_for(nodes)  # they import, compile or wait for each other
            raise KeyboardInterrupt
        _hurry_without_recorder(*nodes)
        completed = not interrupts and (stopped or not nodes[-1].is_running)
        if completed and not stopped:
            monitor.show(config.plant.duration)
            _keep(pages, nodes[1:], monitor, interrupts)
    for node in nodes:
        node.check()
    return completed


def _wait_for_pages(
    pages: Sequence[NodeProcess], monitor: ProgressMonitor, interrupts: Sequence[int]
) -> None:
    """Wait until pages are served, and say where.

    Raises:
        BlfDscError: one cannot be.
        KeyboardInterrupt: a signal came before.
    """
    _wait_while(
        lambda: not interrupts and any(p.is_running and not p.serves for p in pages),
        monitor,
        pages,
    )
    if interrupts:
        raise KeyboardInterrupt
    for page in pages:
        page.check()


def _wait_while(
    condition: Callable[[], bool],
    monitor: ProgressMonitor,
    nodes: Sequence[NodeProcess],
) -> None:
    """Show progress while a condition holds; print what the nodes report above its bar."""
    while condition():
        monitor.wait(0.1)
        for node in nodes:
            for notice in node.take_notices():
                tqdm.write(notice, file=sys.stderr)


def _hurry_without_recorder(recorder: NodeProcess, *others: NodeProcess) -> None:
    """Do not wait long for the others if the recorder has ended.

    They notice its end late, and until then wait for it to take their last messages.
    """
    if recorder.is_running:
        return
    tqdm.write(f'{recorder.name} has ended: so does the run', file=sys.stderr)
    _do_not_wait_for(others)


def _do_not_wait_for(nodes: Iterable[NodeProcess]) -> None:
    for node in nodes:
        node.patience = _UNHEARD


def _keep(
    pages: Sequence[NodeProcess],
    loop: Sequence[NodeProcess],
    monitor: ProgressMonitor,
    interrupts: Sequence[int],
) -> None:
    """Keep the page of an ended loop until an interrupt, if there is a terminal."""
    if not (pages and sys.stderr.isatty()):
        return
    for node in reversed(loop):
        node.stop()  # so that the page says that they have finished
    tqdm.write(_ENDED, file=sys.stderr)
    _wait_while(lambda: pages[0].is_running and not interrupts, monitor, pages)
    if not interrupts:
        tqdm.write(f'the page has ended by itself: see {pages[0].log}', file=sys.stderr)
