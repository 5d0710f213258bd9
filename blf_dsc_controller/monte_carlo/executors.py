# SPDX-License-Identifier: Apache-2.0
"""Where the chunks are computed: any `concurrent.futures.Executor` will do.

    processes   processes of this machine (default)
    threads     threads of this process: the kernels do without the interpreter's lock
    dask        a dask.distributed cluster: one that runs already, by its address, or a local one
    mpi         the ranks of an MPI job (mpi4py.futures)

The results are the same with each of them.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from multiprocessing import connection

from blf_dsc_controller.errors import MissingExtraError

_PRELOADED = 'blf_dsc_controller.monte_carlo.chunk'


@dataclass(frozen=True)
class Engine:
    """How to come by workers.

    Attributes:
        open: starts them; a new executor each time, ended on leaving.
        workers: how many there are.
        lost: what is raised when workers are lost with all that they were doing.
    """

    open: Callable[[], AbstractContextManager[Executor]]
    workers: int
    lost: tuple[type[Exception], ...] = (BrokenExecutor,)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1


def processes(workers: int) -> Engine:
    """Processes of this machine, each of which ends with this one."""

    @contextmanager
    def start() -> Iterator[Executor]:
        method = 'forkserver'
        if method not in multiprocessing.get_all_start_methods():
            method = 'spawn'
        context = multiprocessing.get_context(method)
        if method == 'forkserver':
            context.set_forkserver_preload([_PRELOADED])  # imported once, for all workers
        with ProcessPoolExecutor(workers, context, _end_with_parent) as executor:
            yield executor

    return Engine(start, workers)


def threads(workers: int) -> Engine:
    """Threads of this process."""

    @contextmanager
    def start() -> Iterator[Executor]:
        with ThreadPoolExecutor(workers) as executor:
            yield executor

    return Engine(start, workers)


def dask(workers: int, address: str = '') -> Engine:
    """Make a dask.distributed cluster of this machine, or use the one whose scheduler is there.

    Dask itself computes anew what a lost worker was doing; only if that goes wrong again and again
    is it for us to begin anew.
    """
    try:
        import distributed
    except ImportError:
        raise MissingExtraError('dask.distributed', 'dask', 'the engine dask') from None

    @contextmanager
    def start() -> Iterator[Executor]:
        if address:
            with distributed.Client(address) as client:
                yield client.get_executor(pure=False)
            return
        with (
            distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=None
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client.get_executor(pure=False)

    if address:
        with distributed.Client(address) as client:
            workers = max(1, sum(client.nthreads().values()))
    return Engine(start, workers, (BrokenExecutor, distributed.KilledWorker))


def mpi(workers: int) -> Engine:
    """Use the ranks of an MPI job, `mpiexec -n 9 python -m mpi4py.futures -m ...`: all but one.

    Started as a single rank, it asks MPI for as many more as there are to be workers.
    """
    try:
        from mpi4py import MPI
        from mpi4py.futures import MPIPoolExecutor
    except ImportError:
        raise MissingExtraError('mpi4py', 'mpi', 'the engine mpi') from None

    @contextmanager
    def start() -> Iterator[Executor]:
        with MPIPoolExecutor(workers) as executor:
            yield executor

    workers = MPI.COMM_WORLD.Get_size() - 1 or workers
    return Engine(start, workers)


def _end_with_parent() -> None:
    """Leave an interrupt to the parent, and do not outlive it, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
