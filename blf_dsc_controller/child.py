# SPDX-License-Identifier: Apache-2.0
"""Python processes that this one starts: they import what it does, and nothing else.

By itself, Python looks for modules in the current folder first. That may be a folder
that somebody sent, such as a bag's.
"""

from __future__ import annotations

import os
import sys

ONE_THREAD = dict.fromkeys(
    ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'), '1'
)
"""Environment variables by which linear algebra uses one thread, once it is loaded."""

_WITHOUT_CURRENT = 'import sys; sys.path[:] = filter(None, sys.path); '
_RUN = 'from runpy import run_module; run_module({!r}, run_name="__main__", alter_sys=True)'


def running(code: str) -> list[str]:
    """Return the command of a process that runs this code."""
    return [sys.executable, '-c', _WITHOUT_CURRENT + code]


def running_module(name: str) -> list[str]:
    """Return the command of a process that runs a module; its arguments follow."""
    return running(_RUN.format(name))


def places() -> dict[str, str]:
    """Return the environment variable by which a process finds this one's modules."""
    return {'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
