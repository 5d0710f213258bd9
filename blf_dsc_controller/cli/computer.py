# SPDX-License-Identifier: Apache-2.0
"""What a computer is like for a control loop: cores, clock, priorities, memory, disk."""

from __future__ import annotations

import os
import platform
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blf_dsc_controller.cli.finding import Finding, note, ok

_PERIOD = 0.001  # s: of the fastest drivers
_SAMPLES = 2000
_LATE = 0.5  # periods
_GOVERNOR = Path('/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor')
_REALTIME = Path('/sys/kernel/realtime')
_ENOUGH = 5.0  # GB: an hour of a 1 kHz bag of seven joints
_GIGA = 1e9


def examine() -> Iterator[Finding]:
    """Yield what was found; takes two seconds, for the clock."""
    yield _processor()
    yield _kernel()
    if sys.platform == 'linux':
        yield _priority()
        yield _memory()
    yield _governor()
    yield _clock()
    yield _disk(Path.cwd())


def _processor() -> Finding:
    if sys.platform != 'linux':
        return ok('computer', f'{platform.machine()}, {os.cpu_count()} cores')
    cores = len(os.sched_getaffinity(0))
    load = os.getloadavg()[0]
    text = f'{platform.machine()}, {cores} cores for this process, load {load:.1f}'
    if load > cores:
        return note(
            'computer', text, 'other processes want more than there is: end some'
        )
    return ok('computer', text)


def _kernel() -> Finding:
    text = f'{platform.system()} {platform.release()}'
    if _REALTIME.exists() or 'PREEMPT_RT' in platform.version():
        return ok('kernel', f'{text}, real-time')
    remedy = 'an arm that is commanded at 1 kHz wants a kernel with PREEMPT_RT'
    return note('kernel', f'{text}, not a real-time one', remedy)


def _priority() -> Finding:
    import resource  # Windows has none

    most, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if os.geteuid() == 0 or most == resource.RLIM_INFINITY or most > 0:
        return ok('priority', 'SCHED_FIFO is allowed (realtime.priority)')
    remedy = 'allow it with a limit on rtprio for this user in /etc/security/limits.d'
    return note('priority', 'SCHED_FIFO is not allowed for this user', remedy)


def _memory() -> Finding:
    import resource

    most, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if os.geteuid() == 0 or most == resource.RLIM_INFINITY or most > _GIGA:
        return ok('memory', 'may be locked (realtime.priority)')
    remedy = 'allow it with a limit on memlock for this user in /etc/security/limits.d'
    return note('memory', f'at most {most / 1e6:.0f} MB may be locked', remedy)


def _governor() -> Finding:
    try:
        governor = _GOVERNOR.read_text(encoding='ascii').strip()
    except OSError:
        return ok('governor', 'unknown, as in virtual machines')
    if governor == 'performance':
        return ok('governor', governor)
    remedy = 'sudo cpupower frequency-set -g performance'
    return note(
        'governor', f'{governor}: the processor slows down between samples', remedy
    )


def _clock() -> Finding:
    """Wake up at 1 kHz for two seconds, as a control loop does."""
    late = np.empty(_SAMPLES)
    due = time.monotonic()
    for sample in range(_SAMPLES):
        due = (
            max(due, time.monotonic() - _PERIOD) + _PERIOD
        )  # missed samples are not made up for
        time.sleep(max(0.0, due - time.monotonic()))
        late[sample] = time.monotonic() - due
    typical, most = np.quantile(late, [0.5, 0.99]) * 1e3
    text = (
        f'wakes up {typical:.2f} ms late at 1 kHz, 99 % within {most:.2f} ms, '
        f'at worst {late.max() * 1e3:.1f} ms'
    )
    if most < _LATE * _PERIOD * 1e3:
        return ok('clock', text)
    remedy = (
        'a loop at 1 kHz will miss samples here: real-time priority, fewer processes'
    )
    return note('clock', text, remedy)


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free / _GIGA
    text = f'{free:.0f} GB free in this folder'
    if not os.access(folder, os.W_OK):
        remedy = 'go to another folder, or give --out'
        return note('disk', 'this folder cannot be written', remedy)
    if free < _ENOUGH:
        remedy = 'an hour of seven joints at 1 kHz takes 5 GB'
        return note('disk', text, remedy)
    return ok('disk', text)


def python() -> str:
    """Return the release of Python, for a report."""
    return f'{platform.python_implementation()} {sys.version.partition(" ")[0]}'
