# SPDX-License-Identifier: Apache-2.0
"""Configurations as parameters of ROS 2 nodes: declared, read, and changed while the node runs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from blf_dsc_controller.configuration.nodes import is_builtin, known_names
from blf_dsc_controller.configuration.robot import TOPIC
from blf_dsc_controller.configuration.schema import (
    Kind,
    Parameter,
    build,
    change,
    flatten,
    parameters,
)
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.nodes import arguments
from blf_dsc_controller.nodes.description import wait_for_description
from blf_dsc_controller.nodes.rclpy_internals import parameter_overrides

Config = TypeVar('Config')

_RANGES: dict[Kind, tuple[str, type[Any], type[Any], Any]] = {
    Kind.DOUBLE: ('floating_point_range', FloatingPointRange, float, sys.float_info.max),
    Kind.INTEGER: ('integer_range', IntegerRange, int, 2**63 - 1),
}


class FixedParameterError(ParameterNotDeclaredException):
    """Refusal to change a parameter that is fixed at the start.

    rclpy refuses it before it asks any callback that can give a reason, but passes the text of its
    own exception on to `ros2 param set`.
    """

    def __init__(self, one: Parameter) -> None:
        Exception.__init__(self, f'{one.name} is {_fixed(one)}')


def declare(node: Node, cls: type[Config]) -> Config:
    """Declare all parameters of a configuration, and return the one the node was started with.

    Waits for a URDF that comes from a topic. Raises ConfigurationError with all problems of the
    files and arguments the node was started with; no parameter is declared in that case.
    """
    given = _overrides(node, cls)
    if str(given.get('robot.urdf', '')).startswith(TOPIC):
        given['robot.urdf'] = wait_for_description(node, given['robot.urdf'].removeprefix(TOPIC))
    config = build(cls, given, node.get_fully_qualified_name())
    values = flatten(config)
    for one in parameters(cls):
        value = values[one.name]
        if value == ():
            _declare_empty(node, one)
        else:
            typed = list(value) if isinstance(value, tuple) else value
            node.declare_parameter(one.name, typed, descriptor(one), ignore_override=True)
    fixed = {one.name: one for one in parameters(cls) if one.read_only}

    def refuse_fixed(requested: list[RosParameter]) -> list[RosParameter]:
        for each in requested:
            if each.name in fixed:
                raise FixedParameterError(fixed[each.name])
        return requested

    node.add_pre_set_parameters_callback(refuse_fixed)
    return config


def _declare_empty(node: Node, one: Parameter) -> None:
    """Declare an empty list by its type, since rclpy would infer a list of bytes.

    It is set as well: if any of several requested parameters is unset, rclpy's response is empty.
    """
    kind, described = RosParameter.Type[one.kind.name], descriptor(one)
    node.declare_parameter(one.name, kind, ignore_override=True)
    node.set_parameters([RosParameter(one.name, kind, [])])
    described.type = kind.value
    node.set_descriptor(one.name, described)


def read(node: Node, cls: type[Config]) -> Config:
    """Return the current configuration of a node that has declared it."""
    given = {one.name: node.get_parameter(one.name).value for one in parameters(cls)}
    return build(cls, given, node.get_fully_qualified_name())


def on_change(
    node: Node,
    cls: type[Config],
    apply: Callable[[Config], None],
    problems: Callable[[Config], list[str]] | None = None,
) -> None:
    """Accept parameter changes while the node runs: all changes of a request or none.

    Call it after `declare`. A request is validated as the complete resulting configuration,
    and rejected with the reasons if that is invalid, or if `problems` finds that the node cannot
    accept it now. `apply` receives the new configuration once it is in effect, and must not fail.
    """
    names = {one.name for one in parameters(cls)}

    def validate(requested: list[RosParameter]) -> SetParametersResult:
        values = {one.name: one.value for one in requested if one.name in names}
        if not values:
            return SetParametersResult(successful=True)
        try:
            candidate = change(read(node, cls), values)
        except ConfigurationError as error:
            return SetParametersResult(successful=False, reason='\n'.join(error.problems))
        found = problems(candidate) if problems else []
        return SetParametersResult(successful=not found, reason='\n'.join(found))

    def apply_changes(changed: list[RosParameter]) -> None:
        if any(one.name in names for one in changed):
            apply(read(node, cls))

    node.add_on_set_parameters_callback(validate)
    node.add_post_set_parameters_callback(apply_changes)


def descriptor(one: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows for a parameter.

    ROS only has inclusive ranges, so an excluded limit is rejected by `build` alone.
    """
    symbol = f'{one.symbol}: ' if one.symbol else ''
    unit = f' [{one.unit}]' if one.unit else ''
    constraints = [one.allowed] if one.allowed else []
    if one.length:
        constraints.append('as many entries as ' + ' times '.join(one.length))
    if one.read_only:
        constraints.append(_fixed(one))
    described = ParameterDescriptor(
        description=f'{symbol}{one.description}{unit}',
        read_only=bool(one.read_only),
        additional_constraints='; '.join(constraints),
    )
    low = one.above if one.at_least is None else one.at_least
    high = one.below if one.at_most is None else one.at_most
    if one.kind in _RANGES and (low, high) != (None, None):
        name, message, number, largest = _RANGES[one.kind]
        from_value = -largest if low is None else number(low)
        to_value = largest if high is None else number(high)
        setattr(described, name, [message(from_value=from_value, to_value=to_value)])
    return described


def _fixed(one: Parameter) -> str:
    return f'fixed at the start: {one.read_only}'


def _overrides(node: Node, cls: type[Config]) -> dict[str, Any]:
    """Return the values the node was started with, without parameters of other nodes.

    rclpy does not show which section a value comes from, so parameters of any node of the package
    are accepted, as in a section for several nodes.
    """
    own = {one.name: one.kind for one in parameters(cls)}
    others = known_names() - own.keys()
    arguments.check_sections(sys.argv, node.get_fully_qualified_name())
    given = {name: one.value for name, one in parameter_overrides(node).items()}
    given |= arguments.assigned(sys.argv)
    return {
        name: [] if value is None and name in own and own[name].is_array else value
        for name, value in given.items()
        if name not in others and not is_builtin(name)
    }
