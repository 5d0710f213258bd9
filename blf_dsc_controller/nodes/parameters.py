# SPDX-License-Identifier: Apache-2.0
"""Configurations as parameters: declared, read, changed at run time, and those of other nodes.

The clients that read other nodes' parameters belong to a node that no executor spins, and the
owner polls for responses: the EventsExecutor of these releases crashes when clients are created
and destroyed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.parameter import parameter_value_to_python
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

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
from blf_dsc_controller.messages.topics import ROBOT_DESCRIPTION
from blf_dsc_controller.nodes import process
from blf_dsc_controller.nodes.endpoints import RawSubscriptions, parameter_overrides, take_response
from blf_dsc_controller.nodes.process import assigned, check_sections

if TYPE_CHECKING:
    from rclpy.node import Node

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
    check_sections(sys.argv, node.get_fully_qualified_name())
    given = {name: one.value for name, one in parameter_overrides(node).items()}
    given |= assigned(sys.argv)
    return {
        name: [] if value is None and name in own and own[name].is_array else value
        for name, value in given.items()
        if name not in others and not is_builtin(name)
    }


Values = Mapping[str, Any]

_WITHOUT_YAML = (ParameterType.PARAMETER_NOT_SET, ParameterType.PARAMETER_BYTE_ARRAY)


class ParameterClient:
    """Reads the parameters of each requested node once, as soon as its services are available.

    `callback` is called with the full name of the node and the values of its parameters.
    """

    def __init__(self, callback: Callable[[str, Values], None]) -> None:
        self._callback = callback
        self._requests: dict[str, Iterator[Values | None]] = {}
        self._known: set[str] = set()

    @property
    def pending(self) -> tuple[str, ...]:
        """Nodes that have not responded yet."""
        return tuple(self._requests)

    def request(self, node: Node, name: str) -> None:
        """Request the parameters of node `name` (full name) via `node`, which must not be spun."""
        if name not in self._known:
            self._known.add(name)
            self._requests[name] = _values_of(node, name)

    def poll(self) -> None:
        """Send the requests that are possible now, and call `callback` for complete responses."""
        for name in self.pending:
            values = next(self._requests[name])
            if values is not None:
                del self._requests[name]
                self._callback(name, values)


def _values_of(node: Node, name: str) -> Iterator[Values | None]:
    """List the names, then get their values; yield None until the values have arrived.

    If a parameter is declared but not set, rclpy's response is empty: the names are then requested
    in halves, down to the unset one.
    """
    listing = node.create_client(ListParameters, f'{name}/list_parameters')
    getting = node.create_client(GetParameters, f'{name}/get_parameters')
    while not (listing.service_is_ready() and getting.service_is_ready()):
        yield None
    listed = yield from _call(listing, ListParameters.Request())
    batches = [list(listed.result.names)]
    found = {}
    while batches:
        names = batches.pop()
        got = yield from _call(getting, GetParameters.Request(names=names))
        if len(got.values) == len(names):
            for parameter, value in zip(names, got.values, strict=True):
                if value.type not in _WITHOUT_YAML:
                    found[parameter] = _plain(value)
        elif len(names) > 1:
            middle = len(names) // 2
            batches += [names[:middle], names[middle:]]
    yield dict(sorted(found.items()))


def _call(client: Client, request: Any) -> Any:
    client.call_async(request)
    while (response := take_response(client)) is None:
        yield None
    return response


def _plain(value: Any) -> Any:
    """Return the value as configurations hold it, with sequences as tuples."""
    content = parameter_value_to_python(value)
    return content if isinstance(content, (bool, int, float, str)) else tuple(content)


TIMEOUT = 60.0  # s
_POLL = 0.05  # s
_SILENCE = 5.0  # s between two log lines


def wait_for_description(node: Node, name: str) -> str:
    """Return the URDF from a topic, resolving its name for the node; a signal ends the process.

    Raises ConfigurationError if none is received within a minute.
    """
    topic = node.resolve_topic_name(name)
    hidden = RawSubscriptions(node, depth=1)
    hidden.subscribe(topic, ROBOT_DESCRIPTION.type, [ROBOT_DESCRIPTION.offered], 0)
    begin = time.monotonic()
    try:
        while not (messages := hidden.take()):
            if process.interrupted():
                raise SystemExit(0)
            if time.monotonic() > begin + TIMEOUT:
                raise ConfigurationError([_nothing(topic, hidden.node.count_publishers(topic))])
            node.get_logger().info(
                f'waiting for the URDF on {topic}', throttle_duration_sec=_SILENCE
            )
            time.sleep(_POLL)
    finally:
        hidden.close()
    text: str = deserialize_message(messages[-1].raw, String).data
    if not text.strip():
        raise ConfigurationError([f'robot.urdf: the URDF on {topic} is empty: did xacro fail?'])
    return text


def _nothing(topic: str, publishers: int) -> str:
    found = 'nobody publishes there'
    if publishers:
        found = f'its {publishers} publisher(s) may not be latched (transient local)'
    return (
        f'robot.urdf: no URDF was received on {topic} within {TIMEOUT:g} s, and {found}: start '
        'robot_state_publisher, correct the name, or give a file'
    )
