# SPDX-License-Identifier: Apache-2.0
"""Compilation is announced, since the wait would look like a hang."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event

from blf_dsc_controller.compiled.file_lock import WAITS
from blf_dsc_controller.compiled.jit import SLOW
from blf_dsc_controller.compiled.kernel_cache import KERNELS

COMPILING = 'compiling kernel '
"""How a notice begins."""


_contexts: list[object] = []  # in which compilation is announced


@contextmanager
def announced_compilation(say: Callable[[str], object]) -> Iterator[None]:
    """Call `say` with a notice for each kernel not in the cache that is compiled in this context.

    Only numba knows this: a kernel has a version for each type of arguments.  Those that
    another process compiles are announced, too, since this one waits.
    """
    _contexts.append(say)
    try:
        with (
            event.install_listener('numba:compile', _Compiles(say)),
            event.install_listener(WAITS, _Waits(say)),
        ):
            yield
    finally:
        _contexts.remove(say)


@contextmanager
def logged_compilation() -> Iterator[None]:
    """Log the notices, for who calls the package from Python, unless they are announced."""
    if _contexts:
        yield
        return
    with announced_compilation(logging.getLogger('blf_dsc_controller').warning):
        yield


class _Listener(event.Listener):  # type: ignore[misc]
    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say

    def on_end(self, _event: object) -> None:
        pass


class _Compiles(_Listener):
    def __init__(self, say: Callable[[str], object]) -> None:
        super().__init__(say)
        self._warning = SLOW

    def on_start(self, started: Any) -> None:
        kernel = started.data['dispatcher']
        if not any(kernel is other for other in KERNELS):
            return
        if self._warning:
            self._say(self._warning)
            self._warning = ''
        name = _words(kernel.py_func.__name__)
        self._say(f'{COMPILING}{name}, once for this version and kind of arm')


class _Waits(_Listener):
    def on_start(self, started: Any) -> None:
        name = _words(started.data)
        self._say(f'{COMPILING}{name} in another process: waiting for it')


def _words(name: str) -> str:
    """Return the name of a kernel in words."""
    return name.strip('_').replace('_', ' ')
