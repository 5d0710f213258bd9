# SPDX-License-Identifier: Apache-2.0
"""The runs of a study, computed by any `concurrent.futures.Executor`.

    processes   processes of this machine (default)
    threads     threads of this process: the kernels release the GIL
    dask        a dask.distributed cluster: a running one, by its address, or a local one

All of them give the same results.  Chunks of runs are submitted one after the other, a few ahead of
the workers, so the memory needed does not grow with the number of runs.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import connection
from typing import Any, NamedTuple

from blf_dsc_controller.errors import BlfDscError, MissingExtraError
from blf_dsc_controller.monte_carlo.runs import Columns, run_chunk
from blf_dsc_controller.monte_carlo.store import Span
from blf_dsc_controller.monte_carlo.study import Study

RETRIES = 3
"""Consecutive losses of all workers that are tolerated before any has finished a chunk."""

_AHEAD = 3  # chunks submitted for each worker


class Engine(NamedTuple):
    """Workers: `open` starts a new executor, which raises BrokenExecutor if they are lost."""

    open: Callable[[], AbstractContextManager[Executor]]
    workers: int


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1


def processes(workers: int) -> Engine:
    """Use processes of this machine, each of which ends with this one."""
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload([run_chunk.__module__])  # imported once, for all workers
    return Engine(lambda: ProcessPoolExecutor(workers, context, _end_with_parent), workers)


def threads(workers: int) -> Engine:
    """Use threads of this process."""
    return Engine(lambda: ThreadPoolExecutor(workers), workers)


def dask(workers: int, address: str = '') -> Engine:
    """Start a dask.distributed cluster on this machine, or use the one at a scheduler's address.

    Dask itself repeats the work of a lost worker, unless it fails repeatedly.
    """
    try:
        import distributed
    except ImportError:
        raise MissingExtraError('dask.distributed', 'dask', 'the engine dask') from None

    def client() -> Any:
        if address:
            return distributed.Client(address)
        return distributed.Client(n_workers=workers, threads_per_worker=1, dashboard_address=None)

    @contextmanager
    def start() -> Iterator[Executor]:
        with client() as connected:
            try:
                yield connected.get_executor(pure=False)
            except distributed.KilledWorker as error:
                raise BrokenExecutor(str(error)) from error

    if address:
        with client() as connected:
            workers = max(1, sum(connected.nthreads().values()))
    return Engine(start, workers)


def chunk_size(runs: int, workers: int) -> int:
    """Return the runs per chunk: few files, yet enough chunks for workers to finish together."""
    largest = min(1000, max(100, runs // 1000))
    return max(1, min(largest, runs // (20 * workers)))


def compute(
    study: Study,
    spans: Iterable[Span],
    engine: Engine,
    keep: Callable[[Span, Columns], None],
    warn: Callable[[str], None],
) -> None:
    """Compute all `spans` and pass each with its results to `keep` as soon as it is done.

    The chunk of a lost worker is repeated, after a warning; raises BlfDscError if workers are lost
    repeatedly.
    """
    waiting = deque(spans)
    in_a_row = 0
    while waiting:
        before = len(waiting)
        try:
            with engine.open() as executor:
                _hand_out(study, waiting, executor, engine.workers * _AHEAD, keep)
        except BrokenExecutor as error:
            in_a_row = in_a_row + 1 if len(waiting) == before else 1
            if in_a_row > RETRIES:
                raise BlfDscError(
                    f'{in_a_row} times in a row all workers were lost before any finished a chunk '
                    f'({error}); {len(waiting)} chunks are left. Is there enough memory? Start the '
                    'same command again to resume: finished runs are kept'
                ) from error
            warn(f'a worker was lost: the {len(waiting)} chunks left go to new workers')


def _hand_out(
    study: Study,
    waiting: deque[Span],
    executor: Executor,
    most: int,
    keep: Callable[[Span, Columns], None],
) -> None:
    """Submit all of `waiting`; on an error, put back the spans that were not kept."""
    handed: dict[Future[Columns], Span] = {}
    try:
        while waiting or handed:
            while waiting and len(handed) < most:
                span = waiting[0]
                handed[executor.submit(run_chunk, study, *span)] = span
                waiting.popleft()
            for future in wait(handed, return_when=FIRST_COMPLETED).done:
                keep(handed[future], future.result())
                del handed[future]
    finally:
        for future in handed:
            future.cancel()
        waiting.extendleft(sorted(handed.values(), reverse=True))


def _end_with_parent() -> None:
    """Leave interrupts to the parent, and exit with it, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
