# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a law of a file, in one line: its line there, and the remedy.

Numba reports a mistake in some 130 lines, of which most are about its own search and the
loop that calls the law.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from numba.core.errors import NumbaError, UnsupportedBytecodeError

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.state import Settings, Signals, State

_ARGUMENTS = {'settings': Settings, 'state': State, 'signals': Signals}
_READ_MORE = 'doc/tutorial_law.md'
_Mistake = tuple[str, int | None]
"""What is wrong and what to do, and the line, where numba does not say it."""
_PLACE = re.compile(
    r'File "(?P<file>[^"]+)", line (?P<line>\d+):'
    r'|\b(?:at|Raised from) (?P<at>\S[^\n]*?) \((?P<there>\d+)\)'
)
_CREATES = (ast.Dict, ast.DictComp, ast.List, ast.ListComp, ast.Set, ast.SetComp)
_RAISED = (
    NumbaError,
    UnsupportedBytecodeError,
    AttributeError,
    NotImplementedError,
    TypeError,
    ValueError,
)
"""What the compilation of a mistaken function raises."""


def tell_mistakes(kernel: Callable[..., Any], law: type) -> None:
    """Let the compilation of a kernel say in one line, as BlfDscError, what is wrong in a law."""
    compile_types = getattr(kernel, 'compile', None)
    if compile_types is None:  # it is plain Python
        return

    def compiled(types: Any) -> Any:
        try:
            return compile_types(types)
        except _RAISED as error:
            cause = None if isinstance(error, NumbaError) else error
            raise BlfDscError(mistake_in(law, str(error))) from cause

    kernel.compile = compiled  # type: ignore[attr-defined]


def mistake_in(law: type, text: str) -> str:
    """Return the file and line of a mistake in a law, and its remedy, from the text of numba."""
    file = Path(str(sys.modules[law.__module__].__file__))
    source = ast.parse(file.read_bytes())
    places = [
        place
        for place in _PLACE.finditer(text)
        if Path(place['file'] or place['at']).name == file.name
    ]
    inner = text[: places[0].start()] if places else text  # the innermost comes first
    errors = [
        (match.start(), rule, match)
        for pattern, rule in _RULES.items()
        for match in re.finditer(pattern, inner)
    ]
    if errors:
        _, rule, match = max(errors, key=lambda error: error[0])
        mistake, line = rule(law, source, match)
    else:
        mistake, line = f'it cannot be compiled: {inner.strip().splitlines()[0]}', None
    number = places[0]['line'] or places[0]['there'] if places else line
    where = f'{file}, line {number}' if number else f'{file}'
    return f'{where}: {mistake}: see {_READ_MORE}'


def _line_of(source: ast.Module, is_it: Callable[[ast.AST], bool]) -> int | None:
    """Return the first line in a function where there is such a node."""
    functions = (each for each in ast.walk(source) if isinstance(each, ast.FunctionDef))
    lines = (
        getattr(node, 'lineno', None)
        for function in functions
        for statement in function.body
        for node in ast.walk(statement)
        if is_it(node)
    )
    return next(lines, None)


def _line_with(source: ast.Module, name: str) -> int | None:
    """Return the first line in a function that has a name or an attribute."""
    return _line_of(
        source,
        lambda node: name in (getattr(node, 'id', ''), getattr(node, 'attr', '')),
    )


def _unknown_attribute(
    law: type, _source: ast.Module, match: re.Match[str]
) -> _Mistake:
    """Say which attribute of an argument, the law or an array does not exist."""
    name, owner = match.groups()
    memory = getattr(sys.modules[law.__module__], 'MEMORY', None)
    layouts = _ARGUMENTS | ({'memory': memory} if memory else {})
    for argument, layout in layouts.items():
        if owner == layout.__name__:
            return _unknown_field(argument, layout, name), None
    if owner == law.__name__:
        return _unknown_gain(law, name), None
    if owner == 'array':
        return (
            f'an array has no {name}: read what the law keeps as memory = memory_of(state.memory, '
            'settings), with memory_of = view_of(Memory) at the top of the file'
        ), None
    if owner.startswith(('float', 'int')):
        return f'a number has no {name}: of numbers, use min, max and math', None
    return f'{owner} has no {name}', None


def _unknown_gain(law: type, name: str) -> str:
    """Say what may be meant by `self.name`, which is no gain of the law."""
    near = get_close_matches(name, getattr(law, '_fields', ()), 1)
    if near:
        return f'{law.__name__} has no gain {name}: did you mean self.{near[0]}?'
    if hasattr(law, name):
        return (
            f'the method {name} is not compiled: make it a function with @inner above it (from '
            'blf_dsc_controller.compiled.jit import inner)'
        )
    if name in Settings._fields:
        return f'{law.__name__} has no gain {name}: it is settings.{name}'
    return f'{law.__name__} has no gain {name}: declare it as a gain'


def _unknown_field(argument: str, layout: type, name: str) -> str:
    """Say what may be meant by a field that an argument does not have."""
    for other, fields in _ARGUMENTS.items():
        if name in getattr(fields, '_fields', ()):
            return f'{argument} has no {name}: it is {other}.{name}'
    near = get_close_matches(name, getattr(layout, '_fields', ()), 1)
    if near:
        return f'{argument} has no {name}: did you mean {argument}.{near[0]}?'
    return f'{argument} has no {name}: law/state.py lists what it has; what the law keeps is MEMORY'


def _undefined(law: type, source: ast.Module, match: re.Match[str]) -> _Mistake:
    """Say of a name that is not defined whether it is a gain."""
    name = match[1]
    is_gain = name in getattr(law, '_fields', ())
    remedy = f'write self.{name}' if is_gain else 'define it at the top, or import it'
    return f'{name} is not defined: {remedy}', _line_with(source, name)


def _uncompiled(_law: type, _source: ast.Module, match: re.Match[str]) -> _Mistake:
    """Say of a function or an object of Python that kernels cannot use it."""
    name, kind = match.groups()
    if kind == 'function':
        return (
            f'the function {name} is not compiled: put @inner above it (from '
            'blf_dsc_controller.compiled.jit import inner)'
        ), None
    return f'{name} is a {kind}, which cannot be compiled: use numbers and arrays', None


def _impossible(_law: type, _source: ast.Module, match: re.Match[str]) -> _Mistake:
    """Say of an expression that its shapes or types do not fit."""
    call = ' '.join(match[1].split())
    return (
        f'{call}: these shapes or types do not fit: compute entry by entry, with [i]',
        None,
    )


def _allocates(_law: type, source: ast.Module, _match: re.Match[str]) -> _Mistake:
    """Say that a law creates an array, a list or a dictionary."""
    line = _line_of(source, lambda node: isinstance(node, _CREATES))
    return (
        'a law must not create arrays or lists, as numpy and expressions of arrays do: compute '
        'entry by entry, into the scratch of signals or into MEMORY'
    ), line or _line_with(source, 'np') or _line_with(source, 'numpy')


def _set(_law: type, source: ast.Module, match: re.Match[str]) -> _Mistake:
    """Say of an assigned attribute that only entries of arrays can be written."""
    name = match[1]
    line = _line_of(
        source,
        lambda node: (
            isinstance(node, ast.Attribute)
            and node.attr == name
            and isinstance(node.ctx, ast.Store)
        ),
    )
    return (
        f'{name} cannot be set: write to entries of arrays, as signals.demand[i]; what the law '
        'keeps is MEMORY'
    ), line


def _memory(_law: type, _source: ast.Module, _match: re.Match[str]) -> _Mistake:
    """Say when `memory_of` takes the settings."""
    return (
        "memory_of takes settings only where MEMORY has a length of the arm, such as 'n': with "
        'cells alone, write memory_of(state.memory)'
    ), None


def _not_in_module(_law: type, source: ast.Module, match: re.Match[str]) -> _Mistake:
    """Say of a module that it does not have a name."""
    return f'{match[1]} has no {match[2]}', _line_with(source, match[2])


def _other(_law: type, _source: ast.Module, match: re.Match[str]) -> _Mistake:
    """Say what else numba reports."""
    return f'it cannot be compiled: {match[1].strip()}', None


_Rule = Callable[[type, ast.Module, 're.Match[str]'], _Mistake]
_NO_MATCH = r'No implementation of function .*? found for signature:\s+>>> '
_RULES: dict[str, _Rule] = {
    r"Unknown attribute '(\w+)' of type (?:Reference\()?(\w+)": _unknown_attribute,
    r"NameError: name '(\w+)' is not defined": _undefined,
    r"Untyped global name '(\w+)':?.*?<class '(\w+)'>": _uncompiled,
    rf'{_NO_MATCH}(?!chosen|generated)(.+)': _impossible,
    rf'{_NO_MATCH}generated\(': _memory,
    r'allocates an array|NRT required but not enabled': _allocates,
    r'(?:Cannot resolve setattr:|No definition for lowering) .*\.(\w+) = ': _set,
    r"module '(\w+)' has no attribute '(\w+)'": _not_in_module,
    r'\(step: [^)]*\)\s+(\S.*)': _other,
}
