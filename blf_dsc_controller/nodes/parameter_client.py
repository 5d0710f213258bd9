# SPDX-License-Identifier: Apache-2.0
"""Client that reads the parameters of other nodes: the configuration actually in force.

The service clients belong to a node that no executor spins, and the owner polls for responses: the
EventsExecutor of these releases crashes when clients are created and destroyed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from blf_dsc_controller.nodes.rclpy_internals import take_response

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
