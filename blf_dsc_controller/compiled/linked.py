# SPDX-License-Identifier: Apache-2.0
"""Compilation of functions into kernels only, not on their own; the files of compiled kernels.

Numba optimises every function that a kernel calls and generates machine code for it before linking
it into its caller, which it optimises again: a function five calls deep is compiled six times.
Here such a function is only translated, and the kernel optimised as a whole, in 0.6 of the time.

Numba also counts the references to every array in every tuple argument, which makes up more than
half of the code, for LLVM to remove again. Here nothing is counted, which halves the time.
"""

from __future__ import annotations

import gc
from functools import partial
from pathlib import Path
from typing import Any

from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.environment import lookup_environment
from numba.core.errors import UnsupportedError
from numba.core.typed_passes import NativeLowering
from numba.core.types import NumPyRandomGeneratorType

_ENVIRONMENT = '_ZN08NumbaEnv'
_ALLOCATORS = ('NRT_Allocate', 'NRT_MemInfo_alloc')
_INTERNAL: dict[object, object] = {}  # numba's own functions, compiled this way


class _Linked(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code of a function for its callers; it has no machine code and no address."""

    def _optimize_final_module(self) -> None:
        """Do nothing: this is left to the kernel."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, _name: str) -> int:
        self._ensure_finalized()
        return 0

    @property
    def codegen(self) -> _Linked:
        return self

    def set_env(self, _name: str, _environment: object) -> None:
        """Do nothing: this is left to the kernel."""


def _without_reference_counts(state: Any) -> None:
    """Compile without counting the references to arrays.

    The caller of a kernel keeps its arrays alive; a kernel allocates none: nothing would free it.
    """
    state.targetctx = state.targetctx.subtarget(enable_nrt=False)
    state.targetctx.cached_internal_func = _INTERNAL


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerLinked(NativeLowering):  # type: ignore[misc]
    _name = 'lower_linked'

    def run_pass(self, state: Any) -> bool:
        _without_reference_counts(state)
        state.library = _Linked(state.targetctx.codegen(), state.func_id.func_qualname)
        return bool(super().run_pass(state))


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerKernel(NativeLowering):  # type: ignore[misc]
    _name = 'lower_kernel'

    def run_pass(self, state: Any) -> bool:
        """Lower a kernel, and set the environments of the functions in it."""
        counting = state.targetctx
        _without_reference_counts(state)
        if any(isinstance(argument, NumPyRandomGeneratorType) for argument in state.args):
            # It is allocated for the call, and freed by the wrapper that counts references.
            state.targetctx.create_cpython_wrapper = counting.create_cpython_wrapper
        changed = bool(super().run_pass(state))
        library = state.library
        module = library._final_module  # noqa: SLF001 - as numba's cache
        if any(function.name.startswith(_ALLOCATORS) for function in module.functions):
            raise UnsupportedError(f'the kernel {state.func_id.func_name} allocates an array')
        for variable in module.global_variables:
            if variable.name.startswith(_ENVIRONMENT):
                environment = lookup_environment(variable.name)
                if environment is not None:
                    library.codegen.set_env(variable.name, environment)
        return changed


class _Compiler(CompilerBase):  # type: ignore[misc]
    lowering: type

    def define_pipelines(self) -> list[Any]:
        pipeline = PassManager(self.lowering.__name__)
        for step, about in DefaultPassBuilder.define_nopython_pipeline(self.state).passes:
            pipeline.add_pass(self.lowering if step is NativeLowering else step, about)
        pipeline.finalize()
        return [pipeline]


class LinkedCompiler(_Compiler):
    """Compiler of a function that only kernels call."""

    lowering = _LowerLinked


class KernelCompiler(_Compiler):
    """Compiler of a kernel."""

    lowering = _LowerKernel

    def compile_extra(self, function: Any) -> Any:
        """Compile without garbage collection, which would take a tenth of the time."""
        enabled = gc.isenabled()
        gc.disable()
        try:
            return super().compile_extra(function)
        finally:
            if enabled:
                gc.enable()


class _Folder(_CacheLocator):  # type: ignore[misc]
    """A folder that holds machine code of one content of the sources."""

    def __init__(self, path: Path, function: Any) -> None:
        self._path, self._line = path, function.__code__.co_firstlineno

    def from_function(self, _function: Any, _file: str) -> _Folder:
        return self

    def get_cache_path(self) -> str:
        return str(self._path)

    def get_source_stamp(self) -> str:
        return self._path.name

    def get_disambiguator(self) -> str:
        return str(self._line)


class _CachedCode(CompileResultCacheImpl):  # type: ignore[misc]
    def __init__(self, path: Path, function: Any) -> None:
        self._locator_classes = [_Folder(path, function)]
        super().__init__(function)


class KernelCache(FunctionCache):  # type: ignore[misc]
    """Machine code of a kernel in a folder, or in another one, which is only read."""

    def __init__(self, function: Any, path: Path, read_only: Path | None = None) -> None:
        self._impl_class = partial(_CachedCode, path)
        super().__init__(function)
        self._shipped = KernelCache(function, read_only) if read_only else None

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the compiled kernel, or None."""
        shipped = self._shipped and self._shipped.load_overload(signature, context)
        return shipped or super().load_overload(signature, context)
