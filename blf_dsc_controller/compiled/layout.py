# SPDX-License-Identifier: Apache-2.0
"""Flat vectors with named parts, each described once, by the annotated fields of a `NamedTuple`.

Kernels take one float64 vector for all settings, one for the whole state, and so on: passing
many arrays would cost more than a step.  A `NamedTuple` names the parts of such a vector, in order:

    class State(NamedTuple):
        samples: Cell  # one number that kernels write, as state.samples[0]
        alpha2: Annotated[Array, 'n']  # rad/s
        ring: Annotated[Array, 'N', 'n', 'm + 1']  # an array of shape (N, n, m + 1)

    state_of, state_size = view_of(State), size_of(State)

    vector = np.zeros(state_size(settings))
    state = state_of(vector, settings)  # in Python and in kernels alike; nothing is copied

Lengths are expressions in the attributes of the second argument, here `settings.n`, `settings.m`
and `settings.N`; `'actuator.delay'` works as well, and any named tuple or object will do (a named
tuple in kernels).  Fields of type `int` and `float` are numbers, read when the view is made.  An
`int` field of the layout itself can also be a length; if the vector holds all lengths, the view
takes the vector alone, and `pack` makes it from the tuple.  A field may itself be such a
`NamedTuple`.  A field of any other type, or of type `Passed`, is not in the vector: the view takes
it as an argument.

Nor is a field of type `Fixed`, an integer that is compiled into kernels, such as the number of
joints: loops of known length are unrolled.  The view takes all of them as its second argument,
`sizes_of` the tuple; a kernel is compiled once for each combination of values that occurs.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator
from math import prod
from typing import Annotated, Any, TypeVar, get_type_hints

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload
from numba.np.arrayobj import populate_array

from blf_dsc_controller.compiled.jit import INLINED, inner

Array = np.ndarray
Cell = Annotated[Array, '1']
"""One number of a vector, which kernels can write."""
Fixed = Annotated[int, 'compiled into kernels']
"""An integer that kernels are compiled for."""
Passed = Annotated[int, 'an argument of the view']
"""An integer that the caller of a view knows, maybe as a constant."""

T = TypeVar('T')

_hints: Callable[[Any], dict[str, Any]] = functools.cache(
    functools.partial(get_type_hints, include_extras=True)
)


def sizes_of(layout: Any) -> np.dtype[np.void]:
    """Return the fixed numbers of a layout, as the second argument of its view in kernels.

    They are the lengths of the arrays in a structured data type, which for numba is a type.
    """
    names = [name for name, hint in _hints(type(layout)).items() if hint is Fixed]
    return np.dtype([(name, 'u1', (getattr(layout, name),)) for name in names])


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


def size_of(layout: type) -> Callable[..., int]:
    """Return a function of the lengths (see above) that computes the size of a layout's vector."""
    size: Callable[..., int] = _defined('_sizes', f'return {" + ".join(_sizes(layout))}', {})
    return size


def view_of(layout: type[T]) -> Callable[..., T]:
    """Return a function of a vector, and of lengths not in it, that returns the layout.

    Kernels may call it; its arrays are views that must not outlive the vector (`part`).
    """
    # No field's name starts with an underscore.
    names: dict[str, Any] = {'_part': part, '_fixed': fixed, '__name__': layout.__module__}
    hints = _hints(layout)
    own = tuple(name for name, hint in hints.items() if hint is int or not _is_part(hint))
    lines = ['_at = 0']
    result = _view(layout, own, lines, names, '')
    passed = (name for name, hint in hints.items() if not (_is_part(hint) or hint is Fixed))
    arguments = ['_vector', *passed]
    if any('_sizes' in line for line in lines):
        arguments.insert(1, '_sizes')
    body = '\n    '.join([*lines, f'return {result}'])
    defined: Callable[..., T] = _defined(', '.join(arguments), body, names)
    return inner(defined)


def _view(
    layout: type, own: tuple[str, ...], lines: list[str], names: dict[str, Any], prefix: str
) -> str:
    """Append code that reads each field to `lines` and return the call that builds the tuple."""
    names[f'{prefix}{layout.__name__}'] = layout
    values = []
    for name, hint in _hints(layout).items():
        local = f'{prefix}{name}'
        if hasattr(hint, '_fields'):
            values.append(f'{name}={_view(hint, own, lines, names, f"{local}_")}')
            continue
        values.append(f'{name}={local}')
        if hint is Fixed:
            lines += [f'{local} = _fixed(_sizes, {name!r})']
        elif hint in (int, float):
            lines += [f'{local} = {"int(_vector[_at])" if hint is int else "_vector[_at]"}']
            lines += ['_at += 1']
        elif _is_part(hint):
            shape = [_length(length, own) for length in hint.__metadata__]
            lines += [f'{local} = _part(_vector, _at, ({", ".join(shape)},))']
            lines += [f'_at += {_product(shape)}']
    return f'{prefix}{layout.__name__}({", ".join(values)})'


def _sizes(layout: type) -> Iterator[str]:
    for hint in _hints(layout).values():
        if hasattr(hint, '_fields'):
            yield from _sizes(hint)
        elif _is_part(hint):
            yield _product([_length(length, ()) for length in getattr(hint, '__metadata__', '1')])


def _is_part(hint: Any) -> bool:
    is_array = getattr(hint, '__origin__', None) is Array and hasattr(hint, '__metadata__')
    return hint in (int, float) or is_array or hasattr(hint, '_fields')


def _length(expression: object, own: tuple[str, ...]) -> str:
    """Return the length with names read from `_sizes`, except for the layout's own."""
    return re.sub(
        r'[A-Za-z_][\w.]*',
        lambda name: name[0] if name[0] in own else f'_sizes.{name[0]}',
        str(expression),
    )


def _product(lengths: list[str]) -> str:
    return ' * '.join(f'({length})' for length in lengths)


def _defined(arguments: str, body: str, names: dict[str, Any]) -> Any:
    """Return the Python function of a generated source."""
    source = f'def generated({arguments}):\n    {body}\n'
    exec(source, names)  # noqa: S102 - generated above, from the package's own annotations
    return names['generated']


# Views of parts of vectors. Numba counts the references to every slice of an array with an atomic
# operation, and checks every slice and reshape, which in a step of a few hundred floating point
# operations costs more than the arithmetic. The vectors of a kernel belong to its caller, which
# keeps them alive during the call, and their layout is fixed: nothing needs counting or checking.


def view(vector: Array) -> Array:
    """Return the same vector; its slices are not reference-counted in compiled code.

    Never return it, or a slice of it, from a kernel that Python calls.
    """
    return vector


def part(vector: Array, at: int, shape: tuple[int, ...]) -> Array:
    """Return the part of this shape that starts at entry `at`, under the same conditions."""
    return vector[at : at + prod(shape)].reshape(shape)


def fixed(sizes: np.dtype[np.void], name: str) -> int:
    """Return the named number of `sizes_of`, a constant in compiled code."""
    return int(sizes[name].shape[0])


@intrinsic
def _uncounted(_typing: Any, vector: Any) -> Any:
    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        array = context.make_array(signature.return_type)(context, builder, args[0])
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()  # noqa: SLF001 - numba's own way to read a structure

    return vector(vector), generate


@intrinsic
def _part(_typing: Any, vector: Any, at: Any, shape: Any) -> Any:
    view = types.Array(vector.dtype, len(shape), 'C')

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        source = context.make_array(signature.args[0])(context, builder, args[0])
        result = context.make_array(signature.return_type)(context, builder)
        lengths = cgutils.unpack_tuple(builder, args[2])
        itemsize = context.get_constant(types.intp, 8)
        strides = [itemsize]
        for length in lengths[:0:-1]:
            strides.insert(0, builder.mul(strides[0], length))
        populate_array(
            result,
            data=builder.gep(source.data, [args[1]]),
            shape=lengths,
            strides=strides,
            itemsize=itemsize,
            meminfo=None,
        )
        return result._getvalue()  # noqa: SLF001

    return view(vector, at, shape), generate


@overload(view, strict=False, jit_options=INLINED)
def _compiled_view(vector: Any) -> Any:  # noqa: ARG001 - numba looks at the names
    return lambda vector: _uncounted(vector)  # noqa: PLW0108


@overload(part, strict=False, jit_options=INLINED)
def _compiled_part(vector: Any, at: Any, shape: Any) -> Any:  # noqa: ARG001
    return lambda vector, at, shape: _part(vector, at, shape)  # noqa: PLW0108


@overload(fixed, strict=False, jit_options=INLINED, prefer_literal=True)
def _compiled_fixed(sizes: Any, name: Any) -> Any:
    (number,) = sizes.dtype.typeof(name.literal_value).shape
    return lambda sizes, name: number  # noqa: ARG005 - numba looks at the names
