# SPDX-License-Identifier: Apache-2.0
"""Everything that rests on parts of numba that are not public: it is optional.

It is tested with the releases `FIRST` to before `AFTER` of numba; with others,
importing this module raises ImportError, and kernels are compiled in numba's ordinary
way (`jit`, `views`).

Numba optimises every function that a kernel calls and generates machine code for it
before linking it into its caller, which it optimises again: a function five calls deep
is compiled six times. Here such a function is only translated, and the kernel optimised
as a whole, in 0.6 of the time.

Numba also counts the references to every array in every tuple argument, which makes up
more than half of the code, for LLVM to remove again. Here nothing is counted, which
halves the time.

Numba numbers the functions that a process compiles, from 1 on, and their symbols contain
the number.  Of two kernels with the same name and names of types, each compiled by
another process, one would be called for the other where both are loaded from the cache
and an address is asked for again, as `address_of` does: the methods of two laws are such
kernels.  Here each process begins at a random number.  In numba's ordinary way a kernel
keeps the address that it had when it was loaded, which is its own.
"""

from __future__ import annotations

import gc
import secrets
from functools import partial
from itertools import count
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numba
from llvmlite import ir
from llvmlite.binding import parse_assembly, parse_bitcode
from numba.core import cgutils, event
from numba.core.bytecode import FunctionIdentity
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.environment import lookup_environment
from numba.core.errors import UnsupportedError
from numba.core.runtime import rtsys
from numba.core.typed_passes import NativeLowering

from blf_dsc_controller.compiled.dependencies import CHECKED
from blf_dsc_controller.compiled.file_lock import WAITS, FileLock
from blf_dsc_controller.compiled.own_folder import is_own, make_own

FIRST = (0, 58)
AFTER = (0, 69)
if not FIRST <= numba.version_info.short < AFTER:
    raise ImportError(
        f'numba {numba.__version__}: its private parts are not known here'
    )

FunctionIdentity._unique_ids = count(secrets.randbits(48))  # noqa: SLF001

_ENVIRONMENT = '_ZN08NumbaEnv'
_ALLOCATORS = ('NRT_Allocate', 'NRT_MemInfo_alloc')
_REQUIRE = 3  # behaviour of a flag of LLVM's modules
_NOT_LINKED = 'a kernel that is loaded from the cache is called by its Entry alone'
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


def _choose_checks(state: Any) -> None:
    """Compile without counting the references to arrays; check the indices of laws of files.

    The caller of a kernel keeps its arrays alive; a kernel allocates none: nothing
    would free it. A law of a file would write past an array into whatever is there.
    """
    is_checked = state.func_id.modname.startswith(CHECKED)
    state.targetctx = state.targetctx.subtarget(
        enable_nrt=False, enable_boundscheck=is_checked
    )
    state.targetctx.cached_internal_func = _INTERNAL


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerLinked(NativeLowering):  # type: ignore[misc]
    _name = 'lower_linked'

    def run_pass(self, state: Any) -> bool:
        _choose_checks(state)
        state.library = _Linked(state.targetctx.codegen(), state.func_id.func_qualname)
        return bool(super().run_pass(state))


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerKernel(NativeLowering):  # type: ignore[misc]
    _name = 'lower_kernel'

    def run_pass(self, state: Any) -> bool:
        """Lower a kernel, and set the environments of the functions in it."""
        _choose_checks(state)
        changed = bool(super().run_pass(state))
        library = state.library
        module = library._final_module  # noqa: SLF001 - as numba's cache
        if any(function.name.startswith(_ALLOCATORS) for function in module.functions):
            raise UnsupportedError(
                f'the kernel {state.func_id.func_name} allocates an array'
            )
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
        for step, about in DefaultPassBuilder.define_nopython_pipeline(
            self.state
        ).passes:
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
        self._path = path
        self._line = function.__code__.co_firstlineno

    def from_function(self, _function: Any, _file: str) -> _Folder:
        return self

    def get_cache_path(self) -> str:
        return str(self._path)

    def get_source_stamp(self) -> str:
        return self._path.name

    def get_disambiguator(self) -> str:
        return str(self._line)


class _CachedCode(CompileResultCacheImpl):  # type: ignore[misc]
    """What is stored of a kernel: its machine code, and for its bitcode that of its symbols alone.

    Of the bitcode numba would parse all whenever it loads a kernel: for its symbols, and to
    compile it into others, which call it by its address instead.
    """

    def __init__(self, path: Path, function: Any) -> None:
        self._locator_classes = [_Folder(path, function)]
        super().__init__(function)

    def reduce(self, compiled: Any) -> tuple[Any, ...]:
        (name, kind, (code, bitcode)), *others = super().reduce(compiled)
        return (name, kind, (code, _symbols(bitcode))), *others


def _symbols(bitcode: bytes) -> bytes:
    """Return the bitcode of a module that defines the same symbols, and must not be linked."""
    module = parse_bitcode(bitcode)
    symbols = ir.Module()
    for each in (*module.functions, *module.global_variables):
        if not each.is_declaration:
            byte = ir.GlobalVariable(symbols, ir.IntType(8), each.name)
            byte.initializer = ir.Constant(byte.value_type, 0)
    # a flag that requires another, which no module has: the verifier says its name
    i32 = ir.IntType(32)
    missing = symbols.add_metadata([_NOT_LINKED, i32(1)])
    symbols.add_named_metadata('llvm.module.flags', [i32(_REQUIRE), 'kernel', missing])
    return bytes(parse_assembly(str(symbols)).as_bitcode())


class _Stored(FunctionCache):  # type: ignore[misc]
    """Machine code of a kernel in a folder."""

    def __init__(self, function: Any, path: Path) -> None:
        self._impl_class = partial(_CachedCode, path)
        super().__init__(function)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the compiled kernel, or None.

        numba's own would first load all that a compilation may need, for a third of a
        second.
        """
        rtsys.initialize(context)  # counts the references of a kernel's arguments
        return self._load_overload(signature, context)

    def object_file(self, signature: Any, context: Any) -> bytes | None:
        """Return the object file of the compiled kernel, or None."""
        key = self._index_key(signature, context.codegen())
        found = self._cache_file.load(key)
        if found is None:
            return None
        (_name, _kind, (code, _symbols)), *_others = found
        return bytes(code)


class KernelCache(_Stored):
    """Machine code of a kernel in a folder, or in that of the shipped kernels.

    Of several processes that need a kernel at once, one compiles it; the others wait,
    and load it.
    """

    def __init__(self, function: Any, path: Path, shipped: Path) -> None:
        super().__init__(function, path)
        self._folder = path
        self._shipped = _Stored(function, shipped)
        self._name = function.__name__
        self._lock = FileLock(path / f'{self._name}.lock')

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the compiled kernel, or None: then the caller compiles and saves it."""
        found = self._shipped.load_overload(signature, context)
        found = found or self._load_own(signature, context)
        if found is not None or not make_own(self._folder):
            return found
        self._lock.acquire(partial(event.start_event, WAITS, self._name))
        found = self._load_own(signature, context)
        if found is not None:
            self._lock.release()
        return found

    def _load_own(self, signature: Any, context: Any) -> Any:
        """Return the compiled kernel, or None; what others can write is not read.

        An index that cannot be read is emptied: its types may be of another release of
        this package, whose kernel had the same sources, or the disk was full.
        """
        if not is_own(self._folder):
            return None
        try:
            return super().load_overload(signature, context)
        except (AttributeError, ImportError, EOFError, UnpicklingError):
            self.flush()
            return None

    def save_overload(self, signature: Any, data: Any) -> None:
        """Write a compiled kernel, for the processes that wait for it, too."""
        try:
            if is_own(self._folder):
                super().save_overload(signature, data)
        finally:
            self._lock.release()

    def object_file(self, signature: Any, context: Any) -> bytes | None:
        """Return the object file of the compiled kernel, or None; others must not write it."""
        found = self._shipped.object_file(signature, context)
        if found is None and is_own(self._folder):
            found = super().object_file(signature, context)
        return found


def object_file_of(kernel: Any, *arguments: object) -> tuple[str, bytes | None]:
    """Return the symbol of a kernel for arguments of these types, and the object file that has it.

    None: it could not be written to the cache.
    """
    given = tuple(map(numba.typeof, arguments))
    kernel.compile(given)
    symbol = kernel.overloads[given].fndesc.llvm_func_name
    return symbol, kernel._cache.object_file(given, kernel.targetctx)  # noqa: SLF001


def address_of(compiled: Any) -> int:
    """Return the address of a compiled kernel, for `call_at`."""
    address: int = compiled.library.get_pointer_to_function(
        compiled.fndesc.llvm_func_name
    )
    return address


def call_at(
    context: Any, builder: ir.IRBuilder, address: Any, signature: Any, values: Any
) -> ir.Value:
    """Generate a call of the kernel at an address; what it raises is raised again."""
    convention = context.call_conv
    function = convention.get_function_type(signature.return_type, signature.args)
    status, result = convention.call_function(
        builder,
        builder.bitcast(address, function.as_pointer()),
        signature.return_type,
        signature.args,
        values,
    )
    with cgutils.if_unlikely(builder, status.is_error):
        convention.return_status_propagate(builder, status)
    return result
