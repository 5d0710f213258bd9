# SPDX-License-Identifier: Apache-2.0
"""What the operating system is asked for, and what it says."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress
from pathlib import Path

from rclpy.impl.rcutils_logger import RcutilsLogger

from blf_dsc_controller.configuration.common import Realtime

_THREADS = Path('/proc/self/task')

_MCL_CURRENT = 1
_MCL_FUTURE = 2


def request(realtime: Realtime, logger: RcutilsLogger) -> None:
    """Ask for SCHED_FIFO and locked memory as configured; a refusal is logged, not fatal."""
    if realtime.priority > 0:
        try:
            _schedule(realtime.priority)
        except OSError as error:
            logger.warning(
                f'SCHED_FIFO priority {realtime.priority} refused ({error.strerror}): running with '
                'the default scheduling; allow it with a limit on rtprio for this user'
            )
        else:
            logger.info(f'running with SCHED_FIFO priority {realtime.priority}')
    if realtime.lock_memory:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
            reason = os.strerror(ctypes.get_errno())
            logger.warning(
                f'locking memory refused ({reason}): pages may be swapped out; allow it with a '
                'limit on memlock for this user'
            )
        else:
            logger.info('memory locked')


def _schedule(priority: int) -> None:
    """Schedule every thread alike: state and torque pass through the middleware's threads, too.

    One left behind, even at the next lower priority, makes the others wait for it [measured].
    """
    for thread in _THREADS.iterdir():
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
