# SPDX-License-Identifier: Apache-2.0
"""A configuration as the parameters of a ROS 2 node: declared, read, and changed while it runs."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.parameter import Parameter as RosParameter

from blf_dsc_controller.configuration.nodes import is_builtin, known_names
from blf_dsc_controller.configuration.schema import (
    Kind,
    Parameter,
    build,
    change,
    flatten,
    parameters,
)
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.nodes.rclpy_internals import parameter_overrides

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node

Config = TypeVar('Config')

_TYPES = {
    Kind.BOOL: RosParameter.Type.BOOL,
    Kind.INTEGER: RosParameter.Type.INTEGER,
    Kind.DOUBLE: RosParameter.Type.DOUBLE,
    Kind.STRING: RosParameter.Type.STRING,
    Kind.DOUBLE_ARRAY: RosParameter.Type.DOUBLE_ARRAY,
    Kind.STRING_ARRAY: RosParameter.Type.STRING_ARRAY,
}

_LARGEST_INTEGER = 2**63 - 1


def declare(node: Node, cls: type[Config]) -> Config:
    """Declare every parameter of the configuration `cls` and return what the node was given.

    Raises ConfigurationError with everything that is wrong with the files and arguments the node
    was started with; no parameter is declared then.
    """
    config = build(cls, _given(node, cls), node.get_fully_qualified_name())
    values = flatten(config)
    for one in parameters(cls):
        value = values[one.name]
        typed = list(value) if isinstance(value, tuple) else value
        # rclpy takes an empty list for bytes: left unset under its type, it reads back as empty.
        content = _TYPES[one.kind] if typed == [] else typed
        node.declare_parameter(one.name, content, descriptor(one), ignore_override=True)
    return config


def read(node: Node, cls: type[Config]) -> Config:
    """Return the present configuration of a node that has declared it."""
    return build(cls, _current(node, cls), node.get_fully_qualified_name())


def on_change(
    node: Node,
    cls: type[Config],
    apply: Callable[[Config], None],
    problems: Callable[[Config], list[str]] | None = None,
) -> None:
    """Let the parameters of a node be changed while it runs, all of one request or none.

    To be called after `declare`. Each request is judged as the whole configuration it would lead
    to, and refused with the reasons if that is no valid one, or if `problems` finds that the node
    cannot take it now.
    `apply` gets the new configuration once it is in force; it must not fail.
    """
    names = {one.name for one in parameters(cls)}

    def judge(requested: list[RosParameter]) -> SetParametersResult:
        values = {one.name: one.value for one in requested if one.name in names}
        if not values:
            return SetParametersResult(successful=True)
        try:
            candidate = change(read(node, cls), values)
        except ConfigurationError as error:
            return SetParametersResult(successful=False, reason='\n'.join(error.problems))
        found = problems(candidate) if problems else []
        return SetParametersResult(successful=not found, reason='\n'.join(found))

    def take(changed: list[RosParameter]) -> None:
        if any(one.name in names for one in changed):
            apply(read(node, cls))

    node.add_on_set_parameters_callback(judge)
    node.add_post_set_parameters_callback(take)


def descriptor(one: Parameter) -> ParameterDescriptor:
    """Say of a parameter what `ros2 param describe` shows."""
    rule = one.rule
    symbol = f'{rule.symbol}: ' if rule.symbol else ''
    unit = f' [{rule.unit}]' if rule.unit else ''
    told = ParameterDescriptor(
        description=f'{symbol}{rule.description}{unit}',
        read_only=bool(rule.read_only),
        additional_constraints='; '.join(_constraints(one)),
    )
    low, high = _limits(one)
    if one.kind is Kind.DOUBLE and (low, high) != (None, None):
        told.floating_point_range = [
            FloatingPointRange(
                from_value=-sys.float_info.max if low is None else low,
                to_value=sys.float_info.max if high is None else high,
            )
        ]
    if one.kind is Kind.INTEGER and (low, high) != (None, None):
        told.integer_range = [
            IntegerRange(
                from_value=-_LARGEST_INTEGER if low is None else int(low),
                to_value=_LARGEST_INTEGER if high is None else int(high),
            )
        ]
    return told


def _limits(one: Parameter) -> tuple[float | None, float | None]:
    """Give ROS the limits it can express: one that is itself excluded is left to `build`."""
    rule = one.rule
    low = rule.above if rule.at_least is None else rule.at_least
    high = rule.below if rule.at_most is None else rule.at_most
    return low, high


def _constraints(one: Parameter) -> list[str]:
    rule = one.rule
    constraints = [one.allowed] if one.allowed else []
    if rule.length:
        constraints.append('as many entries as ' + ' times '.join(rule.length))
    if rule.read_only:
        constraints.append(f'fixed at the start: {rule.read_only}')
    return constraints


def _given(node: Node, cls: type[Config]) -> dict[str, Any]:
    """Return what the node was given in files and arguments, without what is for other nodes.

    A section for several nodes looks here like one for this node alone, so that only names which
    no node of the package has are unknown.
    """
    own = {one.name: one.kind for one in parameters(cls)}
    others = known_names() - own.keys()
    given = parameter_overrides(node)
    return {
        name: [] if parameter.value is None and _is_array(own.get(name)) else parameter.value
        for name, parameter in given.items()
        if name not in others and not is_builtin(name)
    }


def _current(node: Node, cls: type[Config]) -> dict[str, Any]:
    values = {one.name: node.get_parameter_or(one.name).value for one in parameters(cls)}
    return {name: [] if value is None else value for name, value in values.items()}


def _is_array(kind: Kind | None) -> bool:
    return kind is not None and kind.is_array
