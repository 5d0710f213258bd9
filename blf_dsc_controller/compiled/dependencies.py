# SPDX-License-Identifier: Apache-2.0
"""Which sources a kernel is compiled from.

Numba keys a cached function by the contents of its own file, not by those of the
functions it calls in other files, so an edit there would leave stale machine code
behind.  Here every module with functions for kernels is known, with the modules of the
types whose methods it calls.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

CHECKED = 'law_'
"""How the names of modules begin in whose functions each index is checked."""

PACKAGE = Path(__file__).resolve().parents[1]
# Layouts and arm models reach a kernel through the types of its arguments.
_IN_EVERY_KERNEL = (*PACKAGE.glob('compiled/*.py'), *PACKAGE.glob('arms/*.py'))
_COMPILED: dict[str, set[str]] = {}
"""Modules with functions for kernels, each with those of the types whose methods it calls."""


def add_module(name: str) -> None:
    """Note that a module has functions for kernels."""
    _COMPILED.setdefault(name, set())


def depend_on(interface: type, *types: type) -> None:
    """Let all kernels that use an interface depend on the files of these types."""
    add_module(interface.__module__)
    uses = _COMPILED[interface.__module__]
    for module in (type_.__module__ for type_ in types):
        add_module(module)
        uses.add(module)


def dependencies(
    function: Callable[..., object], *types: type
) -> tuple[set[Path], set[str]]:
    """Return the source files of a kernel, and the constants in them as `name=value`.

    They are those of its module and of these types', of the modules with functions for
    kernels that those import, and so on.
    """
    pending = [function.__module__, *(type_.__module__ for type_ in types)]
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
