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
from numba.extending import overload

from blf_dsc_controller.compiled.jit import INLINED, SLOW, inner

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


if SLOW:
    inner(view)
    inner(part)
    compiled_part = part
else:
    from blf_dsc_controller.compiled.linked import part_of, uncounted

    @overload(view, strict=False, jit_options=INLINED)
    def _compiled_view(vector: Any) -> Any:  # noqa: ARG001 - numba looks at the names
        return lambda vector: uncounted(vector)  # noqa: PLW0108

    @overload(part, strict=False, jit_options=INLINED)
    def _compiled_part(vector: Any, at: Any, shape: Any) -> Any:  # noqa: ARG001
        return lambda vector, at, shape: part_of(vector, at, shape)  # noqa: PLW0108

    compiled_part = part_of
