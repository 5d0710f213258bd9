# SPDX-License-Identifier: Apache-2.0
"""Compilation is announced, since the wait would look like a hang."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event

from blf_dsc_controller.compiled.jit import SLOW
from blf_dsc_controller.compiled.kernel_cache import KERNELS

COMPILING = 'compiling kernel '
"""How a notice begins."""


_contexts: list[object] = []  # in which compilation is announced


@contextmanager
def announced_compilation(say: Callable[[str], object]) -> Iterator[None]:
    """Call `say` with a notice for each kernel not in the cache that is compiled in this context.

    Only numba knows this: a kernel has a version for each type of arguments. Of those
    that are loaded, some may not be called.
    """
    _contexts.append(say)
    try:
        with event.install_listener('numba:compile', _Listener(say)):
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
        self._count = 0

    def on_start(self, started: Any) -> None:
        kernel = started.data['dispatcher']
        if not any(kernel is other for other in KERNELS):
            return
        if SLOW and self._count == 0:
            self._say(SLOW)
        self._count += 1
        total = max(self._count, len(KERNELS))
        self._say(
            f'{COMPILING}{self._count} of at most {total}, once for this version and kind of arm: '
            f'{kernel.py_func.__name__.strip("_").replace("_", " ")}'
        )

    def on_end(self, _event: object) -> None:
        pass
