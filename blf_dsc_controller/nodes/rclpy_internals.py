# SPDX-License-Identifier: Apache-2.0
"""All private and undocumented parts of rclpy 7 that the nodes use."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.client import Client
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

__all__ = ['RCLError', 'UnknownROSArgsError']  # re-exported


def parameter_overrides(node: Node) -> Mapping[str, Parameter]:
    """Return the parameters in a node's start files and arguments, declared or not."""
    return node._parameter_overrides  # noqa: SLF001


def raw_publish(publisher: Publisher) -> Callable[[bytes], None]:
    """Return a function that publishes raw messages in half the time while the node exists."""
    publish: Callable[[bytes], None] = publisher.handle.publish_raw
    return publish


def subscription_count(publisher: Publisher) -> Callable[[], int]:
    """Return a function that counts subscribers in a fifth of the time while the node exists."""
    count: Callable[[], int] = publisher.handle.get_subscription_count
    return count


def take_messages(
    subscription: Subscription, limit: int
) -> Iterator[tuple[bytes, Mapping[str, int | None]]]:
    """Take up to `limit` waiting messages from a subscription that no executor spins.

    Each is serialised and comes with `source_timestamp` [ns], `received_timestamp` [ns] and
    `publication_sequence_number`, which are None where the middleware does not know them.
    """
    take, type_ = subscription.handle.take_message, subscription.msg_type
    for _ in range(limit):
        taken = take(type_, True)  # noqa: FBT003 - serialised; positional in rclpy
        if taken is None:
            return
        yield taken


def take_response(client: Client) -> Any:
    """Take a response from a client that no executor spins; None if there is none yet."""
    type_: Any = client.srv_type
    _, response = client.handle.take_response(type_.Response)
    return response


def lifecycle_state(node: LifecycleNode) -> str:
    """Return the state of a lifecycle node: unconfigured, inactive, active or finalized."""
    return str(node._state_machine.current_state[1])  # noqa: SLF001


def destroy_state_machine(node: LifecycleNode) -> None:
    """Destroy the state machine, which rclpy forgets when it destroys the node.

    It would keep the middleware's threads alive until the process exits: a known cause of crashes.
    """
    node._state_machine.destroy_when_not_in_use()  # noqa: SLF001


def wrap_change_state(
    node: LifecycleNode, wrap: Callable[[Callable[[Any, Any], Any]], Callable[[Any, Any], Any]]
) -> None:
    """Replace the callback of the service `~/change_state` with `wrap(callback)`."""
    service = node._service_change_state  # noqa: SLF001
    service.callback = wrap(service.callback)
