# SPDX-License-Identifier: Apache-2.0
"""Named tuples that compiled functions receive by reference.

Numba passes a named tuple by value: every number of every field is an argument of the
function.  A view of the state of a law has some 600, and most functions of a law take
three such views, all of which LLVM removes again.  Here such a function takes their
addresses, and reads what it uses; an array is an address and its lengths.  Once all
functions are inlined, the optimiser replaces the memory by registers.
"""

from __future__ import annotations

from typing import Any, TypeVar

from llvmlite import ir
from numba import typeof
from numba.core import cgutils, types
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    models,
    overload,
    register_model,
)

from blf_dsc_controller.compiled.array_value import array_value
from blf_dsc_controller.compiled.jit import INLINED

T = TypeVar('T')

_REFERRED: set[type] = set()
"""Named tuples that are passed by reference, also where they are a field of another one."""

_WORD = ir.IntType(64)
_ADDRESS = ir.DoubleType().as_pointer()


def by_reference(*tuples: type) -> None:
    """Let compiled functions read fields of these types by reference."""
    _REFERRED.update(tuples)


def reference(value: T) -> T:
    """Return a named tuple; in compiled code, a reference to it.

    It holds until the same call of this function is executed again.
    """
    return value


def referred(value: Any) -> Reference:
    """Return the type of a reference to a named tuple."""
    return Reference(typeof(value))


class Reference(types.Type):
    """Type of a reference to a named tuple."""

    def __init__(self, referred: Any) -> None:
        self.referred = referred
        super().__init__(f'Reference({referred.instance_class.__name__})')

    @property
    def key(self) -> Any:
        """The type of the named tuple, which tells such types apart."""
        return self.referred

    def __hash__(self) -> int:
        return hash(self.referred.instance_class)

    def __eq__(self, other: object) -> bool:
        return self is other or super().__eq__(other)


def _is_referred(field: Any) -> bool:
    return getattr(field, 'instance_class', None) in _REFERRED


def _is_compact(field: Any) -> bool:
    is_array = isinstance(field, types.Array)
    return is_array and field.layout == 'C' and field.dtype == types.float64


def _memory(manager: Any, field: Any) -> ir.Type:
    """Return what a field is in memory: an array of float64 its address and lengths."""
    if _is_referred(field):
        return ir.LiteralStructType([_memory(manager, each) for each in field])
    if _is_compact(field):
        return ir.LiteralStructType([_ADDRESS, *[_WORD] * field.ndim])
    return manager.lookup(field).get_value_type()


def _store(manager: Any, builder: Any, field: Any, value: Any, at: Any) -> None:
    """Write a value to the address `at`."""
    if _is_referred(field):
        for i, each in enumerate(field):
            part = builder.extract_value(value, i)
            _store(
                manager, builder, each, part, cgutils.gep_inbounds(builder, at, 0, i)
            )
    elif _is_compact(field):
        array = manager.lookup(field)
        data = array.get(builder, value, 'data')
        shape = array.get(builder, value, 'shape')
        builder.store(data, cgutils.gep_inbounds(builder, at, 0, 0))
        for i in range(field.ndim):
            length = builder.extract_value(shape, i)
            builder.store(length, cgutils.gep_inbounds(builder, at, 0, i + 1))
    else:
        builder.store(value, at)


def _load(manager: Any, builder: Any, field: Any, at: Any) -> Any:
    """Read a value from the address `at`."""
    if _is_referred(field):
        result = manager.lookup(field).get_value_type()(ir.Undefined)
        for i, each in enumerate(field):
            address = cgutils.gep_inbounds(builder, at, 0, i)
            part = _load(manager, builder, each, address)
            result = builder.insert_value(result, part, i)
        return result
    if _is_compact(field):
        return _array(manager, builder, field, at)
    return builder.load(at)


def _array(manager: Any, builder: Any, field: Any, at: Any) -> Any:
    """Return the array whose address and lengths are at the address `at`."""
    data, *lengths = (
        builder.load(cgutils.gep_inbounds(builder, at, 0, i))
        for i in range(field.ndim + 1)
    )
    return array_value(manager, builder, field, data, lengths)


def _copied(manager: Any, builder: Any, type_: Any, value: Any) -> Any:
    """Return the address of a copy of a named tuple."""
    with builder.goto_entry_block():
        at = builder.alloca(_memory(manager, type_))
    _store(manager, builder, type_, value, at)
    return at


@register_model(Reference)
class _Model(models.PrimitiveModel):  # type: ignore[misc]
    """The address of a named tuple, which functions return by value."""

    def __init__(self, manager: Any, type_: Reference) -> None:
        self._value = manager.lookup(type_.referred).get_value_type()
        super().__init__(manager, type_, _memory(manager, type_.referred).as_pointer())

    def get_data_type(self) -> ir.Type:
        return self._value

    def as_data(self, builder: ir.IRBuilder, value: Any) -> Any:
        return _load(self._dmm, builder, self._fe_type.referred, value)

    def from_data(self, builder: ir.IRBuilder, value: Any) -> Any:
        return _copied(self._dmm, builder, self._fe_type.referred, value)

    def get_return_type(self) -> ir.Type:
        return self._value

    def as_return(self, builder: ir.IRBuilder, value: Any) -> Any:
        return self.as_data(builder, value)

    def from_return(self, builder: ir.IRBuilder, value: Any) -> Any:
        return self.from_data(builder, value)


@infer_getattr
class _Fields(AttributeTemplate):  # type: ignore[misc]
    key = Reference

    def generic_resolve(self, type_: Reference, attribute: str) -> types.Type | None:
        fields = type_.referred.fields
        if attribute not in fields:
            return None
        field = type_.referred[fields.index(attribute)]
        return Reference(field) if _is_referred(field) else field


@lower_getattr_generic(Reference)
def _read_field(
    context: Any, builder: ir.IRBuilder, type_: Reference, value: Any, attribute: str
) -> Any:
    index = type_.referred.fields.index(attribute)
    field = type_.referred[index]
    at = cgutils.gep_inbounds(builder, value, 0, index)
    if _is_referred(field):
        return at
    found = _load(context.data_model_manager, builder, field, at)
    return impl_ret_borrowed(context, builder, field, found)


@intrinsic
def compiled_reference(_typing: Any, value: Any) -> Any:
    """Return a reference to a copy of a named tuple."""

    def generate(
        context: Any, builder: ir.IRBuilder, signature: Any, args: Any
    ) -> ir.Value:
        manager = context.data_model_manager
        return _copied(manager, builder, signature.args[0], args[0])

    return Reference(value)(value), generate


@overload(reference, strict=False, jit_options=INLINED)
def _compiled_reference(value: Any) -> Any:  # noqa: ARG001 - numba looks at the names
    return lambda value: compiled_reference(value)  # noqa: PLW0108
