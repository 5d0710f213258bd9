# SPDX-License-Identifier: Apache-2.0
"""Kernels that another kernel calls: compiled once, whoever calls them.

A function that a kernel calls is compiled into it, so that each law would compile the
loop again.  Here a kernel gets the address of another one as an argument:

    @kernel
    def update(compute: Entry, x):
        invoke(compute, x)

    update(Entry(compute, x), x)

A call costs some nanoseconds, and the optimiser does not see both sides of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numba
from numba.core import cgutils, config, types
from numba.core.errors import TypingError
from numba.extending import (
    NativeValue,
    intrinsic,
    models,
    overload,
    register_model,
    typeof_impl,
    unbox,
)

from blf_dsc_controller.compiled.jit import INLINED, SLOW

if not SLOW:
    from blf_dsc_controller.compiled.linked import address_of, call_at


class Entry:
    """A kernel for arguments of certain types, as `invoke` calls it.

    Of each argument there is a value or its type.
    """

    def __init__(self, called: Callable[..., Any], *arguments: object) -> None:
        self.kernel = called
        self.address = 0
        if config.DISABLE_JIT:
            return
        dispatcher = cast('Any', called)
        given = tuple(
            each if isinstance(each, types.Type) else numba.typeof(each)
            for each in arguments
        )
        dispatcher.compile(given)
        compiled = dispatcher.overloads[given]
        self.type = EntryType(compiled.signature)
        if not SLOW:
            self.address = address_of(compiled)


def invoke(entry: Entry, *arguments: object) -> Any:
    """Call a kernel with arguments of exactly the types that it is compiled for."""
    return entry.kernel(*arguments)


class EntryType(types.Type):
    """Type of a kernel for certain types of arguments: any of them with these and this result."""

    def __init__(self, signature: Any) -> None:
        self.signature = signature
        super().__init__(f'Entry({signature})')

    @property
    def key(self) -> tuple[Any, Any]:
        """Result and arguments: their names alone do not tell laws of two files apart."""
        return self.signature.return_type, self.signature.args


@typeof_impl.register(Entry)
def _type_of_entry(entry: Entry, _context: object) -> EntryType:
    return entry.type


@register_model(EntryType)
class _Model(models.PrimitiveModel):  # type: ignore[misc]
    """The address."""

    def __init__(self, manager: Any, type_: EntryType) -> None:
        super().__init__(manager, type_, cgutils.voidptr_t)


@unbox(EntryType)
def _unbox_entry(_type: EntryType, entry: Any, context: Any) -> NativeValue:
    number = context.pyapi.object_getattr_string(entry, 'address')
    address = context.pyapi.long_as_voidptr(number)
    context.pyapi.decref(number)
    return NativeValue(address)


@intrinsic
def _call(_typing: Any, entry: Any, arguments: Any) -> Any:
    called = entry.signature
    if tuple(arguments) != tuple(called.args):
        raise TypingError(f'got arguments {arguments}, but the kernel takes {called}')

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        values = cgutils.unpack_tuple(builder, args[1])
        return call_at(context, builder, args[0], called, values)

    return called.return_type(entry, arguments), generate


@overload(invoke, strict=False, jit_options=INLINED)
def _compiled_invoke(entry: Any, *arguments: Any) -> Any:  # noqa: ARG001
    return lambda entry, *arguments: _call(entry, arguments)
