# SPDX-License-Identifier: Apache-2.0
"""Compilation of the numerical kernels: what is compiled, and how.

`kernel` is for functions that Python calls, `inner` and `called` for those that kernels
call, `compile_methods` for methods of named tuples.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import numba
from llvmlite.binding import get_host_cpu_features
from numba.core import config
from numba.core.types.containers import BaseNamedTuple
from numba.extending import overload, overload_method, register_jitable

from blf_dsc_controller.compiled.dependencies import add_module, depend_on
from blf_dsc_controller.compiled.kernel_cache import add_kernel

try:
    from blf_dsc_controller.compiled.linked import KernelCompiler, LinkedCompiler
except ImportError:  # it uses parts of numba that other releases may lack: see there
    _INNER_COMPILER: dict[str, Any] = {}
    _KERNEL_COMPILER: dict[str, Any] = {}
    SLOW = (
        f'numba {numba.__version__} lacks what this package uses to compile kernels as a whole: '
        'compilation takes more than twice as long, and each sample a little longer: numba before '
        '0.69 has it'
    )
else:
    _INNER_COMPILER = {'pipeline_class': LinkedCompiler}
    _KERNEL_COMPILER = {'pipeline_class': KernelCompiler}
    SLOW = ''

F = TypeVar('F', bound=Callable[..., object])

INLINED = {
    'error_model': 'numpy',
    'forceinline': True,
    'no_cfunc_wrapper': True,
    **_INNER_COMPILER,
}
"""Compiler options for functions that are compiled into kernels."""

_X86_64_V3 = ('avx2', 'bmi', 'bmi2', 'f16c', 'fma', 'lzcnt', 'movbe')
_chosen = config.CPU_NAME is not None or config.CPU_FEATURES is not None
if not _chosen and all(map(get_host_cpu_features().get, _X86_64_V3)):
    # The same code for all these processors, about as fast, so that kernels can be
    # shipped. Numba reads its environment again whenever it changes, and would forget
    # what is only in its configuration.
    os.environ |= {'NUMBA_CPU_NAME': 'x86-64-v3', 'NUMBA_CPU_FEATURES': ''}
    config.reload_config()


def inner(function: F) -> F:
    """Let kernels call `function`, which is compiled into them; in Python it is unchanged."""
    add_module(function.__module__)
    register_jitable(**INLINED)(function)
    return function


def inner_as(function: F, compiled: F) -> F:
    """Let kernels call `function`, for which `compiled` is compiled into them, as by `inner`."""
    add_module(function.__module__)

    def chosen(*_arguments: Any, **_named: Any) -> Any:
        return compiled

    overload(function, strict=False, jit_options=INLINED)(chosen)
    return function


def called(function: F) -> F:
    """Let kernels call `function` without inlining it: large functions compile faster this way."""
    add_module(function.__module__)
    register_jitable(**INLINED | {'forceinline': False})(function)
    return function


def compile_methods(interface: type, names: Sequence[str], *types: type) -> None:
    """Let kernels call these methods of named tuples; only those of the actual type are compiled.

    `interface` declares them, `types` implement them; a kernel depends on the files of
    all types.
    """
    depend_on(interface, *types)
    for name in names:
        _compile_method(name, inspect.signature(getattr(interface, name)))


def _compile_method(name: str, signature: inspect.Signature) -> None:
    def chosen(self: Any, *_arguments: Any) -> Any:
        return getattr(self.instance_class, name, None)

    chosen.__signature__ = signature  # type: ignore[attr-defined]
    overload_method(BaseNamedTuple, name, strict=False, jit_options=INLINED)(chosen)


def kernel(function: F, *types: type) -> F:
    """Compile `function` for calls from Python: IEEE arithmetic (no fast-math), cached.

    The machine code depends on the files of `types`, too: those of a law of a file.
    """
    return _kernel(function, types)


def uncallable(function: F, *types: type) -> F:
    """Compile `function` as `kernel` does, but for other kernels alone, by its `Entry`.

    Its arguments may be references, which Python has none of.
    """
    return _kernel(function, types, no_cpython_wrapper=True)


def _kernel(function: F, dependencies: Sequence[type], **options: object) -> F:
    compiled = numba.njit(
        function,
        error_model='numpy',
        nogil=True,
        no_cfunc_wrapper=True,
        **_KERNEL_COMPILER,
        **options,
    )
    add_kernel(compiled, *dependencies)
    return cast('F', compiled)


def direct(kernel: Callable[..., Any], *arguments: object) -> Callable[..., Any]:
    """Return a kernel that may only be called with arguments of the types of these.

    Kernels look at all types in every call, which takes longer than many a kernel.
    """
    if not hasattr(kernel, 'compile'):  # it is not compiled
        return kernel
    compiled: Callable[..., Any] = cast('Any', kernel).compile(
        tuple(map(numba.typeof, arguments))
    )
    return compiled
