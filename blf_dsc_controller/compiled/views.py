# SPDX-License-Identifier: Apache-2.0
"""Views of parts of vectors, without reference counting in compiled code.

Numba counts the references to every slice of an array with an atomic operation, and checks every
slice and reshape, which in a step of a few hundred floating point operations costs more than the
arithmetic. The vectors of a kernel belong to its caller, which keeps them alive during the call,
and their layout is fixed, so nothing needs counting or checking.
"""

from math import prod
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload
from numba.np.arrayobj import populate_array
from numpy.typing import NDArray

from blf_dsc_controller.compiled.jit import INLINED


def view(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the same vector; its slices are not reference-counted in compiled code.

    Never return it, or a slice of it, from a kernel that Python calls.
    """
    return vector


def part(vector: NDArray[np.float64], at: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the part of this shape that starts at entry `at`, under the same conditions."""
    return vector[at : at + prod(shape)].reshape(shape)


def fixed(sizes: np.dtype[np.void], name: str) -> int:
    """Return the named number of `layout.sizes_of`, a constant in compiled code."""
    return int(sizes[name].shape[0])


@intrinsic
def _view(_typing: Any, vector: Any) -> Any:
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
    return lambda vector: _view(vector)  # noqa: PLW0108


@overload(part, strict=False, jit_options=INLINED)
def _compiled_part(vector: Any, at: Any, shape: Any) -> Any:  # noqa: ARG001
    return lambda vector, at, shape: _part(vector, at, shape)  # noqa: PLW0108


@overload(fixed, strict=False, jit_options=INLINED, prefer_literal=True)
def _compiled_fixed(sizes: Any, name: Any) -> Any:
    (number,) = sizes.dtype.typeof(name.literal_value).shape
    return lambda sizes, name: number  # noqa: ARG005 - numba looks at the names
