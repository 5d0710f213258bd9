# SPDX-License-Identifier: Apache-2.0
"""Compilation of the numerical kernels, with a cache that tracks their dependencies.

Numba keys a cached function by the contents of its own file, not by those of the functions it
calls in other files, so an edit there would leave stale machine code behind.  Here the cache folder
of a kernel is named after a digest of every source file it is compiled from and of the constants it
uses: an edit recompiles what depends on it, and a reinstall finds the existing cache.

If the user's cache folder is not writable, the cache is in the folder for temporary files.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
from numba.core import config
from numba.core.types.containers import BaseNamedTuple
from numba.extending import overload_method, register_jitable

from blf_dsc_controller.compiled.linked import KernelCompiler, LinkedCompiler

F = TypeVar('F', bound=Callable[..., object])

INLINED = {
    'error_model': 'numpy',
    'forceinline': True,
    'no_cfunc_wrapper': True,
    'pipeline_class': LinkedCompiler,
}
"""Compiler options for functions that are compiled into kernels."""

KERNELS: list[Any] = []
"""All kernels that have been imported."""

_PACKAGES = ('blf_dsc_controller.', 'sim_plant.')
_ROOM = Path(__file__).resolve().parents[1]
# Layouts and arm models reach a kernel through the types of its arguments.
_IN_EVERY_KERNEL = (*_ROOM.glob('compiled/*.py'), *_ROOM.glob('arms/*.py'))
_METHODS: dict[str, list[Callable[..., object]]] = {}  # by name, see `compile_methods`


def dependencies(function: Callable[..., object]) -> tuple[set[Path], set[str]]:
    """Return the source files of a kernel, and the constants in it as `name=value`.

    The kernel itself may be outside the package.
    """
    files, constants = set(_IN_EVERY_KERNEL), set()
    pending: list[tuple[str, Any]] = [('', function)]
    seen: list[object] = []
    function = getattr(function, 'py_func', function)
    while pending:
        name, value = pending.pop()
        value = getattr(value, 'py_func', value)
        if isinstance(value, (int, float, str, tuple)):
            constants.add(f'{name}={value!r}')
        module = getattr(value, '__module__', None) or ''
        ours = value is function or module.startswith(_PACKAGES)
        if not ours or any(value is other for other in seen):
            continue
        seen.append(value)
        files.add(Path(inspect.getfile(sys.modules[module])).resolve())
        if isinstance(value, FunctionType):
            pending.extend(_globals_of(value))
    return files, constants


def _globals_of(function: FunctionType) -> Iterator[tuple[str, object]]:
    """Yield the globals that a function uses, and what it uses of the package's modules."""
    names = function.__code__.co_names
    for name in names:
        value = function.__globals__.get(name)
        yield name, value
        yield from ((name, method) for method in _METHODS.get(name, ()))
        if isinstance(value, ModuleType) and value.__name__.startswith(_PACKAGES):
            for attribute in names:
                yield f'{value.__name__}.{attribute}', getattr(value, attribute, None)


def cache_folder(function: Callable[..., object]) -> Path:
    """Return the folder of a kernel's machine code, in NUMBA_CACHE_DIR or else the user's cache."""
    files, constants = dependencies(function)
    digest = hashlib.sha256(' '.join([numba.__version__, *sorted(constants)]).encode())
    for source in sorted(files):
        digest.update(_contents(source))
    chosen = os.environ.get('NUMBA_CACHE_DIR')
    return (Path(chosen) if chosen else _base()) / digest.hexdigest()[:16]


@functools.cache
def _contents(source: Path) -> bytes:
    return source.read_bytes()


@functools.cache
def _base() -> Path:
    try:
        users = Path(os.environ.get('XDG_CACHE_HOME') or '~/.cache').expanduser()
        return _writable(users / 'blf_dsc_controller')
    except (OSError, RuntimeError):  # read-only, full, or no home at all
        pass
    try:
        return _writable(Path(tempfile.gettempdir(), f'blf_dsc_controller-{os.getuid()}'))
    except OSError:  # owned by another user
        return Path(tempfile.mkdtemp(prefix='blf_dsc_controller-'))


def _writable(folder: Path) -> Path:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise PermissionError
    with tempfile.TemporaryFile(dir=folder):
        return folder


def inner(function: F) -> F:
    """Let kernels call `function`, which is compiled into them; in Python it is unchanged."""
    register_jitable(**INLINED)(function)
    return function


def called(function: F) -> F:
    """Let kernels call `function` without inlining it: large functions compile faster this way."""
    register_jitable(**INLINED | {'forceinline': False})(function)
    return function


def compile_methods(interface: type, names: Sequence[str], *types: type) -> None:
    """Let kernels call these methods of named tuples; only those of the actual type are compiled.

    `interface` declares them, `types` implement them; a kernel depends on the files of all types.
    """
    for name in names:
        _METHODS.setdefault(name, []).extend(getattr(one, name) for one in types)
        _compile_method(name, inspect.signature(getattr(interface, name)))


def _compile_method(name: str, signature: inspect.Signature) -> None:
    def chosen(self: Any, *_arguments: Any) -> Any:
        return getattr(self.instance_class, name, None)

    chosen.__signature__ = signature  # type: ignore[attr-defined]
    overload_method(BaseNamedTuple, name, strict=False, jit_options=INLINED)(chosen)


def kernel(function: F) -> F:
    """Compile `function` for calls from Python: IEEE arithmetic (no fast-math), cached."""
    before = config.CACHE_DIR
    config.CACHE_DIR = str(cache_folder(function))
    try:
        compiled = numba.njit(
            function,
            cache=True,
            error_model='numpy',
            nogil=True,
            no_cfunc_wrapper=True,
            pipeline_class=KernelCompiler,
        )
        KERNELS.append(compiled)
        return cast('F', compiled)
    finally:
        config.CACHE_DIR = before
