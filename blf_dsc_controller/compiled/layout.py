# SPDX-License-Identifier: Apache-2.0
"""Flat vectors with named parts, each described once, by the annotated fields of a `NamedTuple`.

Kernels take one float64 vector for all settings, one for the whole state, and so on:
passing many arrays would cost more than a step.  A `NamedTuple` names the parts of such
a vector, in order:

    class State(NamedTuple):
        samples: Cell  # one number that kernels write, as state.samples[0]
        alpha2: Annotated[Array, 'n']  # rad/s
        ring: Annotated[Array, 'N', 'n', 'm + 1']  # an array of shape (N, n, m + 1)

    state_of, state_size = view_of(State), size_of(State)

    vector = np.zeros(state_size(settings))
    state = state_of(vector, settings)  # in Python and in kernels alike; nothing is copied

Lengths are expressions in the attributes of the second argument, here `settings.n`,
`settings.m` and `settings.N`; `'actuator.delay'` works as well, and any named tuple or
object will do (a named tuple in kernels).  Fields of type `int` and `float` are
numbers, read when the view is made.  An `int` field of the layout itself, or of one in
it, can be a length of those after it; if the vector holds all lengths, the view takes
the vector alone, and `pack` makes it from the tuple.  A field may itself be such a
`NamedTuple`, which `filled` makes from parameters of the same names.  A field of any
other type, or of type `Passed`, is not in the vector: the view takes it as an argument.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import numpy as np

from blf_dsc_controller.compiled.jit import inner_as
from blf_dsc_controller.compiled.references import (
    by_reference,
    compiled_reference,
    reference,
)
from blf_dsc_controller.compiled.views import compiled_part, part

Array = np.ndarray
Cell = Annotated[Array, '1']
"""One number of a vector, which kernels can write."""
Passed = Annotated[int, 'an argument of the view']
"""An integer that the caller of a view knows, maybe as a constant."""

T = TypeVar('T')

_hints: Callable[[Any], dict[str, Any]] = functools.cache(
    functools.partial(get_type_hints, include_extras=True)
)


def pack(layout: Any) -> np.ndarray:
    """Return the vector of a layout's numbers and arrays (or sequences), in field order."""
    parts = [
        pack(getattr(layout, name))
        if hasattr(hint, '_fields')
        else np.ravel(np.asarray(getattr(layout, name), dtype=np.float64))
        for name, hint in _hints(type(layout)).items()
        if _is_part(hint)
    ]
    return np.concatenate(parts)


def filled(layout: type[T], *groups: object, **computed: object) -> T:
    """Return a layout with the parameters named as its fields, and what is computed.

    Parameters are the attributes of the `groups`; a switch becomes 0 or 1, a choice its
    index among those of its `Literal`.
    """
    given = {
        name: _as_number(group, name, value)
        for group in groups
        for name, value in vars(group).items()
        if name in _hints(layout)
    }
    return layout(**given | computed)


def _as_number(group: object, name: str, value: Any) -> Any:
    """Return the value of a group's parameter as a vector holds it."""
    if isinstance(value, str):
        return get_args(_hints(type(group))[name]).index(value)
    if isinstance(value, tuple):
        return np.array(value)
    return int(value) if isinstance(value, bool) else value


def size_of(layout: type) -> Callable[..., int]:
    """Return a function of the lengths (see above) that computes the size of a layout's vector."""
    size: Callable[..., int] = _defined(
        '_sizes', f'return {" + ".join(_sizes(layout))}', {}
    )
    return size


def view_of(layout: type[T]) -> Callable[..., T]:
    """Return a function of a vector, and of what is not in it, that returns the layout.

    Kernels may call it; its arrays are views that must not outlive the vector (`part`).
    """
    body = '\n    '.join(_view_lines(layout))
    tuples = _tuples(layout, '')
    by_reference(*tuples.values())
    names = {'_part': part, '_reference': reference, **tuples}
    names['__name__'] = layout.__module__
    arguments = _view_arguments(layout)
    defined: Callable[..., T] = _defined(arguments, body, names)
    # Hundreds of functions less to be compiled into each kernel.
    names = names | {'_part': compiled_part, '_reference': compiled_reference}
    in_kernels: Callable[..., T] = _defined(arguments, body, names)
    return inner_as(defined, in_kernels)


def _view_arguments(layout: type) -> str:
    passed = [name for name, hint in _hints(layout).items() if not _is_part(hint)]
    if any('_sizes' in line for line in _view_lines(layout)):
        passed.insert(0, '_sizes')
    return ', '.join(['_vector', *passed])


def _view_lines(layout: type) -> list[str]:
    """Return the statements of the view; no field's name starts with an underscore."""
    own = {name: name for name, hint in _hints(layout).items() if not _is_part(hint)}
    lines = ['_at = 0']
    result = _read(layout, own, lines, '')
    return [*lines, f'return _reference({result})']


def _tuples(layout: type, prefix: str) -> dict[str, Any]:
    """Return the named tuples that the view builds, by their names in its source."""
    found: dict[str, Any] = {f'{prefix}{layout.__name__}': layout}
    for name, hint in _hints(layout).items():
        if hasattr(hint, '_fields'):
            found |= _tuples(hint, f'{prefix}{name}_')
    return found


def _read(layout: type, own: dict[str, str], lines: list[str], prefix: str) -> str:
    """Append a statement for each field to `lines`; return the call that builds the tuple.

    `own` has the numbers that have been read and can be lengths: their local names.
    """
    values = []
    for name, hint in _hints(layout).items():
        path = f'{prefix}{name}'
        local = path.replace('.', '_')
        if hasattr(hint, '_fields'):
            values.append(f'{name}={_read(hint, own, lines, f"{path}.")}')
            continue
        values.append(f'{name}={local}')
        if hint is int:
            lines.append(f'{local} = int(_vector[_at])')
            lines.append('_at += 1')
            own[path] = local
        elif hint is float:
            lines.append(f'{local} = _vector[_at]')
            lines.append('_at += 1')
        elif _is_part(hint):
            shape = [_length(length, own) for length in hint.__metadata__]
            lines.append(f'{local} = _part(_vector, _at, ({", ".join(shape)},))')
            lines.append(f'_at += {_product(shape)}')
    builds = f'{prefix}{layout.__name__}'.replace('.', '_')
    return f'{builds}({", ".join(values)})'


def _sizes(layout: type) -> Iterator[str]:
    for hint in _hints(layout).values():
        if hasattr(hint, '_fields'):
            yield from _sizes(hint)
        elif _is_part(hint):
            yield _product(
                [_length(length, {}) for length in getattr(hint, '__metadata__', '1')]
            )


def _is_part(hint: Any) -> bool:
    is_array = getattr(hint, '__origin__', None) is Array and hasattr(
        hint, '__metadata__'
    )
    return hint in (int, float) or is_array or hasattr(hint, '_fields')


def _length(expression: object, own: Mapping[str, str]) -> str:
    """Return the length with names read from `_sizes`, except for those in `own`."""
    return re.sub(
        r'[A-Za-z_][\w.]*',
        lambda name: own.get(name[0], f'_sizes.{name[0]}'),
        str(expression),
    )


def _product(lengths: list[str]) -> str:
    return ' * '.join(f'({length})' for length in lengths)


def _defined(arguments: str, body: str, names: dict[str, Any]) -> Any:
    """Return the Python function of a generated source."""
    source = f'def generated({arguments}):\n    {body}\n'
    exec(source, names)  # noqa: S102 - generated above, from the package's own annotations
    return names['generated']
