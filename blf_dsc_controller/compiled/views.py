# SPDX-License-Identifier: Apache-2.0
"""Views of parts of vectors, which cost nothing in compiled code.

Numba counts the references to every slice of an array with an atomic operation, and
checks every slice and reshape, which in a step of a few hundred floating point
operations costs more than the arithmetic.  The vectors of a kernel belong to its
caller, which keeps them alive during the call, and their layout is fixed: nothing needs
counting or checking.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload

from blf_dsc_controller.compiled.array_value import array_value
from blf_dsc_controller.compiled.jit import INLINED

Array = np.ndarray


def view(vector: Array) -> Array:
    """Return the same vector; its slices are not reference-counted in compiled code.

    Never return it, or a slice of it, from a kernel that Python calls.
    """
    return vector


def part(vector: Array, at: int, shape: tuple[int, ...]) -> Array:
    """Return the part of this shape that starts at entry `at`, under the same conditions."""
    size = 1
    for length in shape:
        size *= length
    return vector[at : at + size].reshape(shape)


@intrinsic
def _uncounted(_typing: Any, vector: Any) -> Any:
    """Return the vector as an array whose references are not counted."""

    def generate(
        context: Any, builder: ir.IRBuilder, signature: Any, args: Any
    ) -> ir.Value:
        model = context.data_model_manager.lookup(signature.return_type)
        (array,) = args
        for name in ('meminfo', 'parent'):
            none = cgutils.get_null_value(model.get(builder, array, name).type)
            array = model.set(builder, array, none, name)
        return array

    return vector(vector), generate


@intrinsic
def compiled_part(_typing: Any, vector: Any, at: Any, shape: Any) -> Any:
    """Return the contiguous part of this shape at an entry of a vector, unchecked."""
    view = types.Array(vector.dtype, len(shape), 'C')

    def generate(
        context: Any, builder: ir.IRBuilder, signature: Any, args: Any
    ) -> ir.Value:
        manager = context.data_model_manager
        whole, at, shape = args
        data = manager.lookup(signature.args[0]).get(builder, whole, 'data')
        begin = builder.gep(data, [at])
        lengths = cgutils.unpack_tuple(builder, shape)
        return array_value(manager, builder, signature.return_type, begin, lengths)

    return view(vector, at, shape), generate


@overload(view, strict=False, jit_options=INLINED)
def _compiled_view(vector: Any) -> Any:  # noqa: ARG001 - numba looks at the names
    return lambda vector: _uncounted(vector)  # noqa: PLW0108


@overload(part, strict=False, jit_options=INLINED)
def _compiled_part(vector: Any, at: Any, shape: Any) -> Any:  # noqa: ARG001
    return lambda vector, at, shape: compiled_part(vector, at, shape)  # noqa: PLW0108
