# SPDX-License-Identifier: Apache-2.0
"""Real-time scheduling and locked memory, and a loop that its own process does not delay."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from blf_dsc_controller.configuration.robot import Realtime

_THREADS = Path('/proc/self/task')
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_SWITCH_INTERVAL = 1e-4  # s, instead of the 5 ms of Python


def request_realtime(realtime: Realtime, warn: Callable[[str], object]) -> None:
    """Request SCHED_FIFO of a priority above 0, and locked memory.

    `warn` is called with a refusal.
    """
    if sys.platform != 'linux':
        if realtime.priority > 0:
            warn('realtime: left out, since only Linux has it')
        return
    if realtime.priority == 0:
        return
    try:
        _schedule(realtime.priority)
    except OSError as error:
        warn(
            f'SCHED_FIFO priority {realtime.priority} refused ({error.strerror}): running with '
            'the default scheduling; allow it with a limit on rtprio for this user'
        )
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        reason = os.strerror(ctypes.get_errno())
        warn(
            f'locking memory refused ({reason}): pages may be swapped out; allow it with a '
            'limit on memlock for this user'
        )


@contextmanager
def undisturbed_loop() -> Iterator[None]:
    """Keep the process itself from delaying its loop, until the block ends.

    The garbage collector leaves out what is loaded by now: scanning it would stall the
    loop for 0.1 s.  Other threads, such as the one that plans motions, yield to the loop
    within `_SWITCH_INTERVAL`.
    """
    interval = sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(_SWITCH_INTERVAL)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        gc.unfreeze()


def _schedule(priority: int) -> None:
    """Schedule all threads of the process alike.

    States and torques also pass through those of the middleware, and a single thread that is
    left behind delays the others, even at the next lower priority.
    """
    for thread in _THREADS.iterdir():
        with suppress(ProcessLookupError):  # it has ended in the meantime
            os.sched_setscheduler(
                int(thread.name), os.SCHED_FIFO, os.sched_param(priority)
            )
