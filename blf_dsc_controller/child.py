# SPDX-License-Identifier: Apache-2.0
"""Python processes that this one starts: they import what it does, and nothing else.

By itself, Python looks for modules in the current folder first. That may be a folder
that somebody sent, such as a bag's.
"""

from __future__ import annotations

import gc
import os
import sys
from importlib import import_module
from types import ModuleType

ONE_THREAD = dict.fromkeys(
    ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'), '1'
)
"""Environment variables by which linear algebra uses one thread, once it is loaded."""

_WITHOUT_CURRENT = 'import sys; sys.path[:] = filter(None, sys.path); '
_RUN = 'from {} import imported; sys.exit(imported({!r}).main())'


def running(code: str) -> list[str]:
    """Return the command of a process that runs this code."""
    return [sys.executable, '-c', _WITHOUT_CURRENT + code]


def running_module(name: str) -> list[str]:
    """Return the command of a process that calls `main` of a module; its arguments follow."""
    return running(_RUN.format(__name__, name))


def imported(name: str) -> ModuleType:
    """Import the module of a whole program; the garbage collector leaves out what is loaded by it.

    All of it stays, and to look through it again and again takes a tenth of a short program.
    """
    if name in sys.modules or not gc.isenabled():
        return import_module(name)
    gc.disable()
    try:
        return import_module(name)
    finally:
        gc.freeze()
        gc.enable()


def places() -> dict[str, str]:
    """Return the environment variable by which a process finds this one's modules."""
    return {'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
