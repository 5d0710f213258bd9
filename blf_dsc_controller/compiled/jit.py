# SPDX-License-Identifier: Apache-2.0
"""Compilation of the numerical kernels, with a cache that knows what each depends on.

Numba keys a cached function by the contents of its own file, not by those of the functions it
calls in other files, so an edit there would leave stale machine code behind.  Here the cache folder
of a kernel is named after a digest of every source file it is compiled from and of the constants it
uses: an edit compiles afresh what depends on it, and a reinstall finds the old cache again.

Where nothing can be written below the home folder, the cache is in the folder for temporary files.
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
"""Compiler options of functions that are compiled into kernels."""

_PACKAGES = ('blf_dsc_controller.', 'sim_plant.')
_ROOM = Path(__file__).resolve().parents[1]
# Layouts and arm models reach a kernel through the types of its arguments.
_IN_EVERY_KERNEL = (*_ROOM.glob('compiled/*.py'), *_ROOM.glob('arms/*.py'))
_METHODS: dict[str, list[Callable[..., object]]] = {}  # by name, see `compile_methods`


def dependencies(function: Callable[..., object]) -> tuple[set[Path], set[str]]:
    """Source files that a kernel is compiled from, and the constants in it as `name=value`."""
    files, constants = set(_IN_EVERY_KERNEL), set()
    pending: list[tuple[str, Any]] = [('', function)]
    seen: list[object] = []
    while pending:
        name, value = pending.pop()
        value = getattr(value, 'py_func', value)
        if isinstance(value, (int, float, str, tuple)):
            constants.add(f'{name}={value!r}')
        module = getattr(value, '__module__', None) or ''
        if not module.startswith(_PACKAGES) or any(value is other for other in seen):
            continue
        seen.append(value)
        files.add(Path(inspect.getfile(sys.modules[module])).resolve())
        if isinstance(value, FunctionType):
            pending.extend(_globals_of(value))
    return files, constants


def _globals_of(function: FunctionType) -> Iterator[tuple[str, object]]:
    """What a function names, with what it names of the modules it names."""
    names = function.__code__.co_names
    for name in names:
        value = function.__globals__.get(name)
        yield name, value
        yield from ((name, method) for method in _METHODS.get(name, ()))
        if isinstance(value, ModuleType) and value.__name__.startswith(_PACKAGES):
            for attribute in names:
                yield f'{value.__name__}.{attribute}', getattr(value, attribute, None)


def cache_folder(function: Callable[..., object]) -> Path:
    """Folder of a kernel's machine code, below NUMBA_CACHE_DIR or else the user's cache."""
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
    except OSError:  # another user's
        return Path(tempfile.mkdtemp(prefix='blf_dsc_controller-'))


def _writable(folder: Path) -> Path:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise PermissionError
    with tempfile.TemporaryFile(dir=folder):
        return folder


def inner(function: F) -> F:
    """Let kernels call `function`, which is compiled into them; in Python it stays what it is."""
    register_jitable(**INLINED)(function)
    return function


def called(function: F) -> F:
    """Let kernels call `function` without inlining it: for large ones, which compile faster so."""
    register_jitable(**INLINED | {'forceinline': False})(function)
    return function


def compile_methods(interface: type, names: Sequence[str], *types: type) -> None:
    """Let kernels call these methods of named tuples: of the type at hand, and of no other.

    `interface` declares them, `types` implement them: a kernel depends on the files of all.
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
    """Compile `function`, which Python calls: IEEE arithmetic (no fast-math), cached."""
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
        return cast('F', compiled)
    finally:
        config.CACHE_DIR = before
