# SPDX-License-Identifier: Apache-2.0
"""Asking other nodes for their parameters: the configuration that is really in force.

The clients belong to a node that no executor spins, and their answers are fetched by the owner: the
EventsExecutor of these releases crashes when clients come and go.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

Values = Mapping[str, Any]

_WITHOUT_YAML = (ParameterType.PARAMETER_NOT_SET, ParameterType.PARAMETER_BYTE_ARRAY)


class Inquiry:
    """Asks each node once, when its parameter services are there.

    Args:
        tell: called with the full name of a node and the values of its parameters.
    """

    def __init__(self, tell: Callable[[str, Values], None]) -> None:
        self._tell = tell
        self._conversations: dict[str, _Conversation] = {}

    @property
    def unanswered(self) -> tuple[str, ...]:
        """Nodes that have not answered yet."""
        return tuple(name for name, one in self._conversations.items() if not one.is_over)

    def of(self, node: Node, name: str) -> None:
        """Let `node`, which must not be spun, ask the node of this full name if it has not yet."""
        if name not in self._conversations:
            self._conversations[name] = _Conversation(node, name)

    def go_on(self) -> None:
        """Ask whoever has become ready, and tell of whoever has answered."""
        for name in self.unanswered:
            values = self._conversations[name].go_on()
            if values is not None:
                self._tell(name, values)


class _Conversation:
    """First which parameters there are, then what they hold.

    Where one of them is declared but not set, rclpy answers with nothing at all: the names are then
    asked for in halves, down to the one that is not set.
    """

    def __init__(self, node: Node, name: str) -> None:
        self._listing = node.create_client(ListParameters, f'{name}/list_parameters')
        self._getting = node.create_client(GetParameters, f'{name}/get_parameters')
        self._batches: list[list[str]] = []
        self._values: dict[str, Any] = {}
        self._step = self._list
        self.is_over = False

    def go_on(self) -> dict[str, Any] | None:
        """Take the next step that is possible; the values, once all have come."""
        self._step()
        return dict(sorted(self._values.items())) if self.is_over else None

    def _list(self) -> None:
        if self._listing.service_is_ready() and self._getting.service_is_ready():
            self._listing.call_async(ListParameters.Request())
            self._step = self._take_list

    def _take_list(self) -> None:
        listed = _answer(self._listing)
        if listed is not None:
            self._batches = [listed.result.names]
            self._get()

    def _get(self) -> None:
        self.is_over = not self._batches
        if self._batches:
            self._getting.call_async(GetParameters.Request(names=self._batches[-1]))
            self._step = self._take_values

    def _take_values(self) -> None:
        got = _answer(self._getting)
        if got is None:
            return
        names = self._batches.pop()
        if len(got.values) == len(names):
            for name, value in zip(names, got.values, strict=True):
                if value.type not in _WITHOUT_YAML:
                    self._values[name] = _plain(value)
        elif len(names) > 1:
            middle = len(names) // 2
            self._batches += [names[:middle], names[middle:]]
        self._get()


def _answer(client: Any) -> Any:
    """Response that waits, None if none does."""
    _, response = client.handle.take_response(client.srv_type.Response)
    return response


def _plain(value: Any) -> Any:
    """Value as the configurations hold it: sequences as tuples."""
    content = parameter_value_to_python(value)
    return content if isinstance(content, (bool, int, float, str)) else tuple(content)
