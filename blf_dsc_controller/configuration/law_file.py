# SPDX-License-Identifier: Apache-2.0
"""A control law of a user's own: a Python file, named by the parameter `law`.

The file defines `LAW`, a `NamedTuple` of gains with the methods of `law.interface.Law`,
and, if the law keeps anything between samples, `MEMORY`, a `NamedTuple` of arrays.
Each gain is declared once, where the law is, and is a parameter `gains.NAME` of the
controller:

    class LogBarrier(NamedTuple):
        rate: Annotated[float, positive(20.0, 'decay of the error', '1/s', 'k_1')]
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.util
import sys
import typing
from pathlib import Path
from typing import Any

from blf_dsc_controller.configuration.schema import Parameter
from blf_dsc_controller.errors import BlfDscError

GROUP = 'gains'
"""Group of the parameters of a law of a file."""


def is_file(law: str) -> bool:
    """Whether the parameter `law` names a file, not a law of the package."""
    return law.endswith('.py')


def kept(law: str) -> str:
    """Return the parameter `law` as kept: a file by its absolute path."""
    return str(Path(law).expanduser().resolve()) if is_file(law) else law


def load_law(path: str) -> type:
    """Return `LAW` of a Python file; the same file is loaded once.

    Raises BlfDscError if it cannot be imported, or defines no law.
    """
    return _load(Path(path).expanduser().resolve(), digest(path))


def digest(path: str) -> str:
    """Return the beginning of the SHA-256 of a file, in hexadecimal.

    Raises BlfDscError if it cannot be read.
    """
    try:
        content = Path(path).expanduser().read_bytes()
    except OSError as error:
        raise BlfDscError(f'{path} cannot be read: {error.strerror}') from error
    return hashlib.sha256(content).hexdigest()[:12]


@functools.cache
def _load(place: Path, digest: str) -> type:
    # Kernels and pickles find the module by this name, another content has another one.
    name = f'law_{place.stem}_{digest}'
    spec = importlib.util.spec_from_file_location(name, place)
    if spec is None or spec.loader is None:
        raise BlfDscError(f'{place} is not a Python file')
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise BlfDscError(f'{place} cannot be imported: {error!r}') from error
    law = getattr(module, 'LAW', None)
    problem = _problem(law)
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
    missing = [name for name in ('compute_demand', 'finish') if not hasattr(law, name)]
    return f'LAW has no method {missing[0]}' if missing else ''


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
