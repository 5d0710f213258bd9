# SPDX-License-Identifier: Apache-2.0
"""Vectors that compiled code uses without counting references to them.

Numba counts the references to every slice of an array with an atomic operation, which in a step of
a few hundred floating point operations costs more than the arithmetic. The vectors of a kernel
belong to its caller, who keeps them alive during the call, so nothing needs counting.
"""

from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

if TYPE_CHECKING or numba.config.DISABLE_JIT:

    def borrowed(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the same vector; its slices are not reference-counted in compiled code.

        Never return it, or a slice of it, from a kernel that Python calls.
        """
        return vector

else:

    @intrinsic
    def borrowed(_typing: Any, vector: Any) -> Any:
        """Return the same vector without its owner."""

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            array = context.make_array(signature.return_type)(context, builder, args[0])
            array.meminfo = cgutils.get_null_value(array.meminfo.type)
            array.parent = cgutils.get_null_value(array.parent.type)
            return array._getvalue()  # noqa: SLF001 - as numba itself spells it

        return vector(vector), generate
