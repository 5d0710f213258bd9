# SPDX-License-Identifier: Apache-2.0
"""Configurations as parameters: declared, read, and changed at run time."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.wait_for_message import wait_for_message
from std_msgs.msg import String

from blf_dsc_controller.configuration.nodes import (
    is_builtin,
    is_gain_of_law,
    is_of_node,
    known_names,
    with_base,
)
from blf_dsc_controller.configuration.received import check_arm
from blf_dsc_controller.configuration.robot import TOPIC
from blf_dsc_controller.configuration.schema import (
    Parameter,
    build,
    change,
    flatten,
    parameters,
    variant_of,
)
from blf_dsc_controller.errors import BlfDscError, ConfigurationError
from blf_dsc_controller.messages.topics import ROBOT_DESCRIPTION
from blf_dsc_controller.nodes import process
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.nodes.ros_arguments import (
    assigned,
    check_sections,
    parameter_files,
)

Config = TypeVar('Config')
_PREPARED = 8  # changes kept


def declare(node: Node, cls: type[Config]) -> Config:
    """Declare all parameters of a configuration, and return the one to start with.

    Waits for a URDF that comes from a topic. Raises ConfigurationError with all
    problems of the files and arguments the node was started with; no parameter is
    declared in that case.
    """
    given = _overrides(node, cls)
    if str(given.get('robot.urdf', '')).startswith(TOPIC):
        given['robot.urdf'] = wait_for_description(
            node, given['robot.urdf'].removeprefix(TOPIC)
        )
    config = build(cls, given, node.get_fully_qualified_name())
    values = flatten(config)
    initial = []
    declared = parameters(type(config))  # with those of a law of a file
    for parameter in declared:
        # By its type, since rclpy would take an empty list for one of bytes.
        name = parameter.name
        kind = RosParameter.Type[parameter.ros_type]
        node.declare_parameter(name, kind, descriptor(parameter), ignore_override=True)
        value = values[name]
        initial.append(
            RosParameter(name, kind, list(value) if isinstance(value, tuple) else value)
        )
    node.set_parameters_atomically(initial)
    fixed = {parameter.name: parameter for parameter in declared if parameter.read_only}

    def refuse_fixed(requested: list[RosParameter]) -> SetParametersResult:
        names = [each.name for each in requested if each.name in fixed]
        reasons = [f'{name} is {_fixed(fixed[name])}' for name in names]
        return SetParametersResult(successful=not reasons, reason='\n'.join(reasons))

    # With `read_only` in their descriptors, rclpy would refuse them without the reason.
    node.add_on_set_parameters_callback(refuse_fixed)
    return config


class _Change(NamedTuple, Generic[Config]):
    """A change of the configuration, and what the check found."""

    before: Config
    values: dict[str, Any]
    after: Config
    problems: list[str]


class Changes(Generic[Config]):
    """Accepts parameter changes while a node runs: all changes of a request or none.

    A request is validated as the complete resulting configuration, and rejected with the reasons
    if that is invalid, or the node cannot accept it now.

    rclpy's EventsExecutor sends at once what a callback returns, and awaits nothing.  What takes
    long, to build and to check a change, is therefore done in a thread: what the callback returns
    is not sent, but kept with the header of the request.  Once the thread is done, `poll` calls
    the original callback, which finds the change prepared, and sends the answer.
    """

    def __init__(
        self,
        node: Node,
        config: Config,
        apply: Callable[[Config], None],
        problems: Callable[[Config], list[str]] | None = None,
        check: Callable[[Config, Config], list[str]] | None = None,
    ) -> None:
        """Accept changes of the configuration that the node has declared.

        Args:
            node: that of the parameters.
            config: the present one.
            apply: receives the new configuration once it is in effect, and must not fail.
            problems: why the node cannot accept a configuration now.
            check: for what takes long, returns reasons against a change from one configuration
                to another.  With it the node's services work in the thread: call `poll`.
        """
        self._config = config
        self._accepted = config
        self._names = {parameter.name for parameter in parameters(type(config))}
        self._apply = apply
        self._problems = problems
        self._check = check
        self._prepared: tuple[_Change[Config], ...] = ()
        self._thread = ThreadPoolExecutor(1, 'preparation')
        # what a request waits for, and how to answer it
        self._waiting: deque[tuple[Future[None], Callable[[], None]]] = deque()
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._put_in_force)
        for service in node.services if check is not None else ():
            if service.srv_type in {SetParameters, SetParametersAtomically}:
                self._delay(service)

    def poll(self) -> None:
        """Answer the requests that are prepared, in the order of their arrival."""
        while self._waiting and self._waiting[0][0].done():
            self._waiting.popleft()[1]()

    def _delay(self, service: Any) -> None:
        """Prepare the requests of a service in the thread, then answer.

        What that raises is left to the original callback, which finds the same problem.
        """
        answer, send = service.callback, service.send_response

        def accept(request: Any, response: Any) -> Any:
            return (
                self._thread.submit(self._prepare_request, request),
                request,
                response,
            )

        def keep(later: Any, header: Any) -> None:
            prepared, *of_callback = later
            self._waiting.append((prepared, lambda: send(answer(*of_callback), header)))

        service.callback = accept
        service.send_response = keep

    def _validate(self, requested: list[RosParameter]) -> SetParametersResult:
        """Accept the complete configuration that results, or say why not."""
        values = self._own(requested)
        if not values:
            return SetParametersResult(successful=True)
        try:
            found = self._find(values)
        except ConfigurationError as error:
            reasons = error.problems
        else:
            self._accepted = found.after
            now = self._problems(found.after) if self._problems else []
            reasons = [*found.problems, *now]
        return SetParametersResult(successful=not reasons, reason='\n'.join(reasons))

    def _put_in_force(self, changed: list[RosParameter]) -> None:
        """Apply the configuration that was accepted last."""
        if self._own(changed):
            self._config = self._accepted
            self._apply(self._config)

    def _prepare_request(self, request: Any) -> None:
        """Build and check what a request changes, as if all of it were accepted."""
        is_atomic = isinstance(request, SetParametersAtomically.Request)
        given = [RosParameter.from_parameter_msg(each) for each in request.parameters]
        config = self._config
        for group in [given] if is_atomic else [[each] for each in given]:
            values = self._own(group)
            if values:
                config = self._prepare(config, values).after

    def _own(self, given: list[RosParameter]) -> dict[str, Any]:
        """Return the values of own parameters by name."""
        return {each.name: each.value for each in given if each.name in self._names}

    def _prepare(self, before: Config, values: dict[str, Any]) -> _Change[Config]:
        """Build and check a change; raise ConfigurationError with its problems."""
        after = change(before, values)
        found = self._check(before, after) if self._check else []
        prepared = _Change(before, values, after, found)
        self._prepared = (*self._prepared[-_PREPARED:], prepared)
        return prepared

    def _find(self, values: dict[str, Any]) -> _Change[Config]:
        """Return a change of the configuration in force, prepared only once."""
        for each in self._prepared:
            if each.before is self._config and each.values == values:
                return each
        return self._prepare(self._config, values)


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows for a parameter.

    Its range is told as a constraint, since those of ROS are inclusive, and not for
    lists.
    """
    symbol = f'{parameter.symbol}: ' if parameter.symbol else ''
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    fixed = _fixed(parameter) if parameter.read_only else ''
    return ParameterDescriptor(
        description=f'{symbol}{parameter.description}{unit}',
        additional_constraints='; '.join(filter(None, (parameter.constraints, fixed))),
    )


def _fixed(parameter: Parameter) -> str:
    return f'fixed at the start: {parameter.read_only}'


def _overrides(node: Node, cls: type[Config]) -> dict[str, Any]:
    """Return the values the node was started with, without parameters of other nodes.

    rclpy does not show which section a value comes from, so parameters of any node of
    the package are accepted, as in a section for several nodes.
    """
    known = known_names()
    for remark in check_sections(sys.argv, node.get_fully_qualified_name()):
        node.get_logger().warning(remark)
    overrides = node._parameter_overrides  # noqa: SLF001 - those in start files and arguments
    given = {name: parameter.value for name, parameter in overrides.items()}
    given |= assigned(sys.argv)
    folder = Path(next(iter(parameter_files(sys.argv)), '')).parent
    given = with_base(given, node.get_fully_qualified_name(), cls, folder)
    lists = _lists(cls, given)
    return {
        name: [] if value is None and name in lists else value
        for name, value in given.items()
        if is_of_node(name, cls) or not (name in known or is_gain_of_law(name))
        if not is_builtin(name)
    }


def _lists(cls: type, given: Mapping[str, Any]) -> set[str]:
    """Return the names of the lists that the node has with given values: empty ones are None."""
    with suppress(BlfDscError):  # no such law
        cls = variant_of(cls, given)
    return {parameter.name for parameter in parameters(cls) if parameter.is_array}


TIMEOUT = 60  # s


def wait_for_description(node: Node, name: str) -> str:
    """Return the URDF from a topic of the node; a signal ends the process.

    Raises ConfigurationError if none is received within a minute.
    """
    topic = node.resolve_topic_name(name)
    quality = qos_profile(ROBOT_DESCRIPTION.offered)
    for _ in range(TIMEOUT):
        found, message = wait_for_message(
            String, node, topic, qos_profile=quality, time_to_wait=1
        )
        if process.interrupted():
            raise SystemExit(0)
        if found:
            return _checked(message.data, topic)
        node.get_logger().info(
            f'waiting for the URDF on {topic}', throttle_duration_sec=5.0
        )
    count = node.count_publishers(topic)
    problem = f'no URDF within {TIMEOUT} s on {topic}, which has {count} publishers'
    remedy = 'start robot_state_publisher, whose topic is latched, correct the name, or give a file'
    raise ConfigurationError([f'robot.urdf: {problem}: {remedy}'])


def _checked(text: str, topic: str) -> str:
    """Return a URDF that anybody may have sent; ConfigurationError if it is none."""
    if not text.strip():
        raise ConfigurationError(
            [f'robot.urdf: the one on {topic} is empty: did xacro fail?']
        )
    try:
        check_arm({'robot.urdf': text})
    except BlfDscError as error:
        raise ConfigurationError([f'{error} ({topic})']) from error
    return text
