# SPDX-License-Identifier: Apache-2.0
"""How kernels get a law: `blf_dsc` is compiled into them, the others are called.

`for_kernels(law, ...)` is the law that a kernel gets as its argument, and
`for_law(kernel, law)` the kernel for it.  Without numba's private parts there are no
addresses of kernels: then every law is compiled into kernels of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from numba.core import config

from blf_dsc_controller.compiled.jit import SLOW, kernel
from blf_dsc_controller.law.blf_dsc import BlfDsc
from blf_dsc_controller.law.called_law import CalledLaw, called, is_callable
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.mistakes import tell_mistakes
from blf_dsc_controller.law.state import Settings, Signals, State


def for_kernels(
    law: Law, settings: Settings, state: State, signals: Signals
) -> Law | CalledLaw:
    """Return a law as kernels get it, for a controller with these settings and vectors.

    Raises BlfDscError where the law of a file cannot be compiled.
    """
    is_compiled_in = isinstance(law, BlfDsc) or SLOW or config.DISABLE_JIT
    if is_compiled_in or not is_callable(law):
        return law
    return called(law, settings, state, signals)


def with_gains(kernel_law: Law | CalledLaw, law: Law) -> Law | CalledLaw:
    """Return what kernels get with the gains of a law of the same type."""
    return kernel_law.with_gains(law) if isinstance(kernel_law, CalledLaw) else law


def for_law(
    compiled: Callable[..., Any], kernel_law: Law | CalledLaw
) -> Callable[..., Any]:
    """Return a kernel for a law of `for_kernels`: the same, or compiled with that law.

    Raises (when it is compiled):
        BlfDscError: the law of a file cannot be compiled.
    """
    if isinstance(kernel_law, (BlfDsc, CalledLaw)):
        return compiled
    return _compiled_with(compiled, type(kernel_law))


@functools.cache
def _compiled_with(compiled: Callable[..., Any], law: type) -> Callable[..., Any]:
    """Return a kernel compiled with a law as the type of its first argument."""
    mine = kernel(getattr(compiled, 'py_func', compiled), law)
    tell_mistakes(mine, law)
    return mine
