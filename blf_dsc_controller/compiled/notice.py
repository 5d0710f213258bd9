# SPDX-License-Identifier: Apache-2.0
"""Notice that kernels are being compiled, since the wait would look like a hang."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

from numba.core import event

COMPILATION_NOTICE = 'compiling the kernels, once for this version: this takes 10 to 60 s'


class _Listener(event.Listener):  # type: ignore[misc]
    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._announced = False

    def on_start(self, _event: object) -> None:
        if not self._announced:
            self._announced = True
            self._say(COMPILATION_NOTICE)

    def on_end(self, _event: object) -> None:
        pass


def announced_compilation(say: Callable[[str], object]) -> AbstractContextManager[object]:
    """Call `say` once with a notice if anything not in the cache is compiled in this context.

    Only numba knows this: a kernel has a version for each type of arguments, and another install of
    the same sources has its own entries in the same cache.
    """
    listener: AbstractContextManager[object] = event.install_listener(
        'numba:compile', _Listener(say)
    )
    return listener
