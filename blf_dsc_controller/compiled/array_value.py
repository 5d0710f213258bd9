# SPDX-License-Identifier: Apache-2.0
"""Arrays in compiled code that are made of an address and lengths: nobody counts references."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils

_ITEM = ir.IntType(64)(8)  # bytes


def array_value(
    manager: Any, builder: Any, array: Any, data: Any, lengths: Sequence[Any]
) -> Any:
    """Return a contiguous array of float64 of a type, by its address and lengths."""
    strides = [_ITEM]
    for length in lengths[:0:-1]:
        strides.insert(0, builder.mul(strides[0], length))
    count = lengths[0]
    for length in lengths[1:]:
        count = builder.mul(count, length)
    parts = {
        'nitems': count,
        'itemsize': _ITEM,
        'data': data,
        'shape': cgutils.pack_array(builder, lengths),
        'strides': cgutils.pack_array(builder, strides),
    }
    model = manager.lookup(array)
    result = model.get_value_type()(None)
    for name, part in parts.items():
        result = model.set(builder, result, part, name)
    return result
