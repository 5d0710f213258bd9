# SPDX-License-Identifier: Apache-2.0
"""A control law in a Python file, named by the parameter `law`: a user's, or one of the package.

The file defines `LAW`, a `NamedTuple` of gains with the methods of `law.interface.Law`,
and, if the law keeps anything between samples, `MEMORY`, a `NamedTuple` of arrays.
Each gain is declared once, where the law is, and is a parameter `gains.NAME` of the
controller:

    class LogBarrier(NamedTuple):
        rate: Annotated[float, positive(20.0, 'decay of the error', '1/s', 'k_1')]

The file is code that runs. Written as `FILE@DIGEST`, it runs only with the content of
this SHA-256; where a configuration was received, nothing else runs (`received`).
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.util
import inspect
import re
import sys
import traceback
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, NamedTuple

from blf_dsc_controller.compiled.dependencies import CHECKED
from blf_dsc_controller.configuration.schema import Parameter
from blf_dsc_controller.errors import BlfDscError

GROUP = 'gains'
"""Group of the parameters that only one law has."""

PACKAGED = ('paper', 'model_based', 'backstepping', 'slotine_li')
"""Law files of the package, which are found by their name."""

_FOLDER = Path(__file__).resolve().parents[1] / 'laws'
_METHODS = {
    'compute_demand': ('self', 'settings', 'state', 'signals', 't', 'dt'),
    'finish': ('self', 'settings', 'state', 'signals', 'dt', 'saturated'),
}
_PAST_THE_END = 'index is out of bounds'
_WRITTEN = re.compile(r'(.+\.py)(?:@([0-9a-f]{12,64}))?', re.DOTALL)


class _File(NamedTuple):
    """A file of a law as it is written: its path, and the digest that it must have."""

    path: Path
    wanted: str  # the beginning at least; empty: any

    @classmethod
    def of(cls, law: str) -> _File:
        """Return the file that the parameter `law` names."""
        if law in PACKAGED:
            return cls(_FOLDER / f'{law}.py', '')
        written = _WRITTEN.fullmatch(law)
        if written is None:
            raise BlfDscError(f'{law} is not a Python file')
        path, wanted = written.groups(default='')
        return cls(Path(path).expanduser().resolve(), wanted)

    def read(self) -> bytes:
        """Return the content; BlfDscError if it cannot be read, or is another one."""
        try:
            content = self.path.read_bytes()
        except OSError as error:
            problem = f'{self.path} cannot be read: {error.strerror}'
            raise BlfDscError(problem) from error
        found = hashlib.sha256(content).hexdigest()
        if not found.startswith(self.wanted):
            raise BlfDscError(
                f'{self.path} has the SHA-256 {found}, not {self.wanted} as given, so it was not '
                f'run: read it, and give {self.path}@{found} if it may run'
            )
        return content


def is_file(law: str) -> bool:
    """Whether the parameter `law` names a user's file, not a law of the package."""
    return _WRITTEN.fullmatch(law) is not None


def has_file(law: str) -> bool:
    """Whether the parameter `law` names a law in a file, of a user or of the package."""
    return law in PACKAGED or is_file(law)


def is_pinned(law: str) -> bool:
    """Whether the parameter `law` names a file with the digest that it must have."""
    return is_file(law) and bool(_File.of(law).wanted)


def check_pinned(law: str) -> None:
    """Raise BlfDscError unless `law` names a file with the digest that it has."""
    found = digest(law)
    if not _File.of(law).wanted:
        raise BlfDscError(
            f'got the law {law} without its digest. A file runs as code: read it, and if it may '
            f'run, give {law}@{found}'
        )


def kept(law: str) -> str:
    """Return the parameter `law` as kept: a file by its absolute path."""
    if not is_file(law):
        return law
    path, wanted = _File.of(law)
    return f'{path}@{wanted}' if wanted else str(path)


def load_law(law: str) -> type:
    """Return `LAW` of the file that the parameter `law` names; a content is loaded once.

    Raises BlfDscError if it cannot be read or imported, is another file than the one
    that is wanted, or defines no law.
    """
    file = _File.of(law)
    return _load(file.path, file.read())


def digest(law: str) -> str:
    """Return the SHA-256 of the file that the parameter `law` names, in hexadecimal.

    Raises BlfDscError if it cannot be read, or is another file than the one wanted.
    """
    return hashlib.sha256(_File.of(law).read()).hexdigest()


@contextmanager
def errors_told_with_line(law: str) -> Iterator[None]:
    """Raise what a law of a file raises as a BlfDscError with its line; nothing else changes."""
    try:
        yield
    except Exception as error:
        raised = traceback.extract_tb(error.__traceback__)[-1]
        path = _File.of(law).path if has_file(law) else None
        if path and str(error) == _PAST_THE_END:  # which numba tells without a line
            raise BlfDscError(
                f'{path}: an index is past the end of an array. Run it with NUMBA_DISABLE_JIT=1 '
                'for the line: see doc/tutorial_law.md'
            ) from error
        # Kernels that are kept name a file of this content, perhaps elsewhere.
        if path is None or Path(raised.filename).name != path.name:
            raise
        text = f'{path}, line {raised.lineno}: {type(error).__name__}: {error}'
        raise BlfDscError(text) from error


@functools.cache
def _load(place: Path, content: bytes) -> type:
    # Kernels and pickles find the module by this name, another content has another one.
    name = f'{CHECKED}{place.stem}_{hashlib.sha256(content).hexdigest()[:12]}'
    spec = importlib.util.spec_from_file_location(name, place)
    if spec is None:
        raise BlfDscError(f'{place} is not a Python file')
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        # What was read, neither the file again nor bytecode beside it.
        code = compile(content, place, 'exec', dont_inherit=True)
        exec(code, vars(module))  # noqa: S102 - the user has named this file
    except Exception as error:
        del sys.modules[name]
        raised = traceback.extract_tb(error.__traceback__)
        lines = [f', line {at.lineno},' for at in raised if at.filename == str(place)]
        where = f'{place}{lines[-1] if lines else ""}'  # a SyntaxError tells its line
        told = f'{where} cannot be imported: {type(error).__name__}: {error}'
        raise BlfDscError(told) from error
    law = getattr(module, 'LAW', None)
    problem = _problem(law) or _problem_of_memory(module, code)
    if problem:
        raise BlfDscError(f'{place}: {problem}')
    return typing.cast('type', law)


def _problem(law: Any) -> str:
    """Return why `LAW` of a file is no law, or nothing."""
    if not (isinstance(law, type) and hasattr(law, '_fields')):
        return 'expected LAW, a NamedTuple of gains: see doc/tutorial_law.md'
    if not law._fields:
        return 'LAW has no gains, but kernels need at least one'
    undeclared = [name for name in law._fields if name not in declared_gains(law)]
    if undeclared:
        return (
            f'LAW.{undeclared[0]} must be declared with its default and unit, such as '
            "Annotated[float, positive(20.0, 'decay of the error', '1/s')]"
        )
    return _problem_of_methods(law)


def _problem_of_methods(law: type) -> str:
    """Return what `LAW` lacks beside its gains, or nothing."""
    for name, arguments in _METHODS.items():
        if not hasattr(law, name):
            return f'LAW has no method {name}'
        if len(inspect.signature(getattr(law, name)).parameters) != len(arguments):
            return f'LAW.{name} must have the arguments {", ".join(arguments)}'
    if not hasattr(law, 'has_barrier'):
        return 'LAW does not say by has_barrier whether it keeps the error inside its bound'
    if callable(law.has_barrier):
        return 'LAW.has_barrier is a method: put @property above it'
    return ''


def _problem_of_memory(module: ModuleType, code: CodeType) -> str:
    """Return what is wrong with `MEMORY` of a file, or nothing.

    Without it the memory has no numbers, and what a law keeps would overwrite others.
    """
    if hasattr(module, 'MEMORY'):
        if not isinstance(module.MEMORY, type):
            return f'MEMORY is {module.MEMORY!r}, no class whose parts have names'
        try:
            hints = typing.get_type_hints(module.MEMORY)
        except NameError as error:
            return f'MEMORY cannot be read: {error}'
        for name, hint in hints.items():
            if hint in (int, float):
                return (
                    f'MEMORY.{name} is a number, which kernels cannot write: declare it as Cell '
                    f'(from blf_dsc_controller.compiled.layout), and write memory.{name}[0]'
                )
        return ''
    if 'memory' not in _names_in(code):
        return ''
    return (
        'state.memory is used, but there is no MEMORY, which says how many numbers it has: add '
        'MEMORY = Memory at the end, with the name of your class'
    )


def _names_in(code: CodeType) -> set[str]:
    """Return the attributes and global names that code uses, with its functions and classes."""
    inner = [each for each in code.co_consts if isinstance(each, CodeType)]
    return {*code.co_names}.union(*(_names_in(each) for each in inner))


def memory_of(law: type) -> type | None:
    """Return `MEMORY` of the file of a law: the parts of its memory, if it has any."""
    return getattr(sys.modules[law.__module__], 'MEMORY', None)


def declared_gains(law: type) -> dict[str, dataclasses.Field[Any]]:
    """Return the declaration of each gain of a law, by its name."""
    hints = typing.get_type_hints(law, include_extras=True)
    declared: dict[str, dataclasses.Field[Any]] = {}
    for name, hint in hints.items():
        for entry in getattr(hint, '__metadata__', ()):
            if isinstance(entry, dataclasses.Field) and 'parameter' in entry.metadata:
                declared[name] = entry
    return declared


@functools.cache
def gains_of(law: type) -> type:
    """Return a configuration with the gains of a law as its parameters."""
    fields: list[Any] = []
    for name, declared in declared_gains(law).items():
        param: Parameter = declared.metadata['parameter']
        field = dataclasses.field(default=param.default, metadata={'parameter': param})
        fields.append((name, type(param.default), field))
    return dataclasses.make_dataclass(f'{law.__name__}Gains', fields, frozen=True)
