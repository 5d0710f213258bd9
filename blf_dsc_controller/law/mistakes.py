# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a law of a file, in one line: its line there, and the remedy.

Numba tells a mistake in some 130 lines, of which most are about its own search and the
loop that calls the law.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from numba.core.errors import NumbaError

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.state import Settings, Signals, State

_ARGUMENTS = {'settings': Settings, 'state': State, 'signals': Signals}
_READ_MORE = 'doc/tutorial_law.md'
_PLACE = re.compile(r'File "([^"]+)", line (\d+):')
_ALLOCATORS = ('np', 'numpy')


def tell_mistakes(kernel: Callable[..., Any], law: type) -> None:
    """Let the compilation of a kernel say in one line, as BlfDscError, what is wrong in a law."""
    compile_types = getattr(kernel, 'compile', None)
    if compile_types is None:  # it is plain Python
        return

    def compiled(types: Any) -> Any:
        try:
            return compile_types(types)
        except NumbaError as error:
            raise BlfDscError(mistake_in(law, str(error))) from None

    kernel.compile = compiled  # type: ignore[attr-defined]


def mistake_in(law: type, text: str) -> str:
    """Return the file and line of a law, what is wrong there and what to do, from numba's text."""
    file = Path(str(sys.modules[law.__module__].__file__))
    source = ast.parse(file.read_bytes())
    places = [each for each in _PLACE.finditer(text) if Path(each[1]).name == file.name]
    inner = text[: places[0].start()] if places else text  # the innermost is told first
    found = [
        (match.start(), problem, match)
        for pattern, problem in _RULES.items()
        for match in re.finditer(pattern, inner)
    ]
    if not found:
        reason = inner.strip().splitlines()[-1].strip()
        return (
            f'{_at(file, places)}: numba cannot compile it: {reason}: see {_READ_MORE}'
        )
    _, problem, match = max(found, key=lambda each: each[0])
    told, name = problem(law, source, match)
    line = None if places else next(_lines_of(source, name), None)
    return f'{_at(file, places, line)}: {told}: see {_READ_MORE}'


def _at(file: Path, places: list[re.Match[str]], line: int | None = None) -> str:
    number = places[0][2] if places else line
    return f'{file}, line {number}' if number else f'{file}'


def _lines_of(source: ast.Module, name: str) -> Iterator[int]:
    """Yield the lines that use a name in methods and functions."""
    for node in ast.walk(source):
        if isinstance(node, ast.FunctionDef):
            for inside in ast.walk(node):
                if isinstance(inside, ast.Name) and inside.id == name:
                    yield inside.lineno


def _unknown_attribute(
    law: type, _source: ast.Module, match: re.Match[str]
) -> tuple[str, str]:
    name, owner = match.groups()
    for argument, layout in _ARGUMENTS.items():
        if owner == layout.__name__:
            return _unknown_field(argument, layout, name), name
    if owner == law.__name__:
        gains = getattr(law, '_fields', ())
        near = get_close_matches(name, gains, 1)
        remedy = f'did you mean self.{near[0]}?' if near else 'declare it as a gain'
        return f'{owner} has no gain {name}: {remedy}', name
    return (
        f'an array has no {name}: read what the law keeps as memory = memory_of(state.memory, '
        'settings), with memory_of = view_of(Memory) at the top of the file'
    ), name


def _unknown_field(argument: str, layout: type, name: str) -> str:
    for other, fields in _ARGUMENTS.items():
        if name in getattr(fields, '_fields', ()):
            return f'{argument} has no {name}: it is {other}.{name}'
    near = get_close_matches(name, getattr(layout, '_fields', ()), 1)
    if near:
        return f'{argument} has no {name}: did you mean {argument}.{near[0]}?'
    return f'{argument} has no {name}: law/state.py lists what it has; what the law keeps is MEMORY'


def _undefined(law: type, _source: ast.Module, match: re.Match[str]) -> tuple[str, str]:
    name = match[1]
    is_gain = name in getattr(law, '_fields', ())
    remedy = f'write self.{name}' if is_gain else 'define it at the top, or import it'
    return f'{name} is not defined: {remedy}', name


def _uncompiled(
    _law: type, _source: ast.Module, match: re.Match[str]
) -> tuple[str, str]:
    name, kind = match.groups()
    if kind == 'function':
        return (
            f'the function {name} is not compiled: put @inner above it (from '
            'blf_dsc_controller.compiled.jit import inner)'
        ), name
    return f'{name} is a {kind}, which cannot be compiled: use numbers and arrays', name


def _impossible(
    _law: type, _source: ast.Module, match: re.Match[str]
) -> tuple[str, str]:
    call = ' '.join(match[1].split())
    return (
        f'{call}: these shapes or types do not fit: compute entry by entry, with [i]',
        '',
    )


def _allocates(
    _law: type, source: ast.Module, _match: re.Match[str]
) -> tuple[str, str]:
    name = next((each for each in _ALLOCATORS if any(_lines_of(source, each))), '')
    return (
        'a law must not create arrays, as numpy and slices in expressions do: compute entry by '
        'entry, into the scratch of signals or into MEMORY'
    ), name


_Problem = Callable[[type, ast.Module, 're.Match[str]'], tuple[str, str]]
_RULES: dict[str, _Problem] = {
    r"Unknown attribute '(\w+)' of type (?:Reference\()?(\w+)": _unknown_attribute,
    r"NameError: name '(\w+)' is not defined": _undefined,
    r"Untyped global name '(\w+)':?.*?<class '(\w+)'>": _uncompiled,
    r'No implementation of function .*? found for signature:\s+>>> (.+)': _impossible,
    r'allocates an array': _allocates,
}
