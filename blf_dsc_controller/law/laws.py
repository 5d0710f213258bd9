# SPDX-License-Identifier: Apache-2.0
"""The laws that kernels are compiled with: those of the package, and one of a user's file.

`for_law(kernel, law)` is how a loop gets its kernel: the laws of the package are
compiled into one and the same, whose cache depends on their files; a law of a file has
kernels of its own, whose cache depends on that file, too.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from blf_dsc_controller.compiled.jit import compile_methods, kernel
from blf_dsc_controller.law.backstepping import Backstepping
from blf_dsc_controller.law.blf_dsc import BlfDsc
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.mistakes import tell_mistakes

PACKAGED = (BlfDsc, Backstepping)
"""Types of the package's laws."""

compile_methods(Law, ('compute_demand', 'finish'), *PACKAGED)


def for_law(compiled: Callable[..., Any], law: Law) -> Callable[..., Any]:
    """Return a kernel for a law: the given one, or the same compiled with the law of a file.

    Its compilation raises BlfDscError where the law of a file cannot be compiled.
    """
    if isinstance(law, PACKAGED):
        return compiled
    return _compiled_with(compiled, type(law))


@functools.cache
def _compiled_with(compiled: Callable[..., Any], law: type) -> Callable[..., Any]:
    mine = kernel(getattr(compiled, 'py_func', compiled), law)
    tell_mistakes(mine, law)
    return mine
