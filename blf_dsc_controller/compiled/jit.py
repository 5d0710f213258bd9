# SPDX-License-Identifier: Apache-2.0
"""Compilation of the numerical kernels, with a cache that tracks their dependencies.

Numba keys a cached function by the contents of its own file, not by those of the
functions it calls in other files, so an edit there would leave stale machine code
behind, and by the place of that file.  Here the cache folder of a kernel is named after
a digest of every source file it is compiled from and of the constants it uses, and of
nothing else: an edit recompiles what depends on it, and a reinstall or a second
checkout finds the existing cache.

The package's own folder `SHIPPED` is looked at first, and never written to when kernels
run.  If the user's cache folder is not writable, the cache is in the folder for
temporary files.  Machine code is loaded only from a folder of this user that nobody
else can write.

Compilation is announced, since the wait would look like a hang.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

import numba
from llvmlite.binding import get_host_cpu_features
from numba.core import config, event
from numba.core.types.containers import BaseNamedTuple
from numba.extending import overload_method, register_jitable

try:
    from blf_dsc_controller.compiled.linked import (
        KernelCache,
        KernelCompiler,
        LinkedCompiler,
    )
except ImportError:  # it uses parts of numba that other releases may lack: see there
    _CACHE: Any = None
    _INNER_COMPILER: dict[str, Any] = {}
    _KERNEL_COMPILER: dict[str, Any] = {}
    SLOW = (
        f'numba {numba.__version__} lacks what this package uses to compile kernels as a whole: '
        'compilation takes three times as long, and each sample of a Panda half as long again'
    )
else:
    _CACHE = KernelCache
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

COMPILING = 'compiling kernel '
"""How a notice begins."""

KERNELS: list[Any] = []
"""All kernels that have been imported."""

SHIPPED = Path(__file__).with_name('kernels')
"""Folder of kernels that come with the package: see `ship`."""

_X86_64_V3 = ('avx2', 'bmi', 'bmi2', 'f16c', 'fma', 'lzcnt', 'movbe')
_chosen = config.CPU_NAME is not None or config.CPU_FEATURES is not None
if not _chosen and all(map(get_host_cpu_features().get, _X86_64_V3)):
    # The same code for all these processors, about as fast, so that kernels can be
    # shipped.
    config.CPU_NAME = 'x86-64-v3'
    config.CPU_FEATURES = ''

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH

_PACKAGE = Path(__file__).resolve().parents[1]
# Layouts and arm models reach a kernel through the types of its arguments.
_IN_EVERY_KERNEL = (*_PACKAGE.glob('compiled/*.py'), *_PACKAGE.glob('arms/*.py'))
_COMPILED: dict[str, set[str]] = {}
"""Modules with functions for kernels, each with those of the types whose methods it calls."""


def dependencies(function: Callable[..., object]) -> tuple[set[Path], set[str]]:
    """Return the source files of a kernel, and the constants in them as `name=value`.

    They are those of its module, of the modules with functions for kernels that this
    one imports, and so on.
    """
    pending = [function.__module__]
    modules = set()
    constants = set()
    while pending:
        module = pending.pop()
        modules.add(module)
        uses = set(_COMPILED.get(module, ()))
        for name, value in vars(sys.modules[module]).items():
            is_module = isinstance(value, ModuleType)
            uses.add(value.__name__ if is_module else getattr(value, '__module__', ''))
            if isinstance(value, (int, float, tuple)):
                constants.add(f'{name}={value!r}')
        pending.extend(uses & _COMPILED.keys() - modules)
    files = {Path(inspect.getfile(sys.modules[module])).resolve() for module in modules}
    return {*_IN_EVERY_KERNEL, *files}, constants


def cache_folder(function: Callable[..., object]) -> Path:
    """Return the folder of a kernel's machine code, in NUMBA_CACHE_DIR or else the user's cache."""
    files, constants = dependencies(function)
    digest = hashlib.sha256(' '.join([numba.__version__, *sorted(constants)]).encode())
    for name, source in sorted((_name(source), source) for source in files):
        digest.update(name.encode() + b'\0' + source.read_bytes())
    return _base(os.environ.get('NUMBA_CACHE_DIR')) / digest.hexdigest()[:16]


@functools.cache
def _base(chosen: str | None) -> Path:
    """Return the first folder for machine code that can be written, if need be a temporary one."""
    users = Path(os.environ.get('XDG_CACHE_HOME') or '~/.cache', 'blf_dsc_controller')
    inside = f'blf_dsc_controller-{os.getuid()}'  # of a folder for everybody
    folders = [users, Path(tempfile.gettempdir(), inside)]
    if chosen:
        folders[:0] = [Path(chosen), Path(chosen, inside)]
    for folder in folders:
        with suppress(OSError, RuntimeError):  # read-only, full, or no home at all
            place: Path = folder.expanduser()
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            if _is_private(place):
                with tempfile.TemporaryFile(dir=place):
                    return place
    return Path(tempfile.mkdtemp(prefix='blf_dsc_controller-'))


def _is_private(folder: Path) -> bool:
    """Whether this user owns a folder, and nobody else can write it."""
    found = folder.stat()
    return found.st_uid == os.getuid() and not found.st_mode & _OTHERS_WRITE


def _name(source: Path) -> str:
    """Return the place of a file in the packages, which cached types refer to."""
    inside = source.is_relative_to(_PACKAGE.parent)
    return str(source.relative_to(_PACKAGE.parent)) if inside else source.name


def inner(function: F) -> F:
    """Let kernels call `function`, which is compiled into them; in Python it is unchanged."""
    _COMPILED.setdefault(function.__module__, set())
    register_jitable(**INLINED)(function)
    return function


def called(function: F) -> F:
    """Let kernels call `function` without inlining it: large functions compile faster this way."""
    _COMPILED.setdefault(function.__module__, set())
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


def depend_on(interface: type, *types: type) -> None:
    """Let kernels that are defined from now on depend on the files of further types."""
    uses = _COMPILED.setdefault(interface.__module__, set())
    for module in (type_.__module__ for type_ in types):
        _COMPILED.setdefault(module, set())
        uses.add(module)


def _compile_method(name: str, signature: inspect.Signature) -> None:
    def chosen(self: Any, *_arguments: Any) -> Any:
        return getattr(self.instance_class, name, None)

    chosen.__signature__ = signature  # type: ignore[attr-defined]
    overload_method(BaseNamedTuple, name, strict=False, jit_options=INLINED)(chosen)


def kernel(function: F) -> F:
    """Compile `function` for calls from Python: IEEE arithmetic (no fast-math), cached."""
    compiled = numba.njit(
        function,
        error_model='numpy',
        nogil=True,
        no_cfunc_wrapper=True,
        **_KERNEL_COMPILER,
    )
    KERNELS.append(compiled)
    if not config.DISABLE_JIT:
        _keep(compiled, cache_folder(function))
    return cast('F', compiled)


def direct(kernel: Callable[..., Any], *arguments: object) -> Callable[..., Any]:
    """Return a kernel that may only be called with arguments of the types of these.

    Kernels look at all types in every call, which takes longer than many a kernel.
    """
    if config.DISABLE_JIT:
        return kernel
    compiled: Callable[..., Any] = cast('Any', kernel).compile(
        tuple(map(numba.typeof, arguments))
    )
    return compiled


def _keep(kernel: Any, folder: Path) -> None:
    """Cache the machine code of a kernel in a folder that no other source shares.

    Within it, numba tells signatures, processors and Python versions apart.
    """
    if _CACHE is not None:
        cache = _CACHE(kernel.py_func, folder, SHIPPED / folder.name)
        kernel._cache = cache  # noqa: SLF001 - as numba's enable_caching
        return
    before = config.CACHE_DIR
    # of a further folder in it, for the place of the source
    config.CACHE_DIR = str(folder)
    try:
        kernel.enable_caching()
    finally:
        config.CACHE_DIR = before


def ship() -> Path:
    """Copy the kernels in the cache into a folder of the package, and return it."""
    for each in KERNELS:
        folder = cache_folder(each)
        if folder.exists():
            shutil.copytree(
                folder,
                SHIPPED / folder.name,
                ignore=shutil.ignore_patterns('*.lock'),
                dirs_exist_ok=True,
            )
    return SHIPPED


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
            f'{kernel.py_func.__name__}'
        )

    def on_end(self, _event: object) -> None:
        pass


def announced_compilation(
    say: Callable[[str], object],
) -> AbstractContextManager[object]:
    """Call `say` with a notice for each kernel not in the cache that is compiled in this context.

    Only numba knows this: a kernel has a version for each type of arguments. Of those
    that are loaded, some may not be called.
    """
    listener: AbstractContextManager[object] = event.install_listener(
        'numba:compile', _Listener(say)
    )
    return listener
