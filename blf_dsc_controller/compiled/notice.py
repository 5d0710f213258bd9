# SPDX-License-Identifier: Apache-2.0
"""A notice when kernels are compiled: a wait that would look like a hang."""

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
    """Say a notice, once, if anything is compiled in this context that is not in the cache.

    Only numba knows: kernels have a version for each type of arguments, and another install of the
    same sources has entries of its own in the same cache.
    """
    listener: AbstractContextManager[object] = event.install_listener(
        'numba:compile', _Listener(say)
    )
    return listener
