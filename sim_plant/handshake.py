# SPDX-License-Identifier: Apache-2.0
"""What happens between a plant that is ready and its first state: peers found, controller asked."""

from __future__ import annotations

from time import perf_counter
from typing import Any

from rclpy.lifecycle import LifecycleNode
from std_srvs.srv import Trigger

from blf_dsc_controller.messages import topics

_SETTLING = 0.2  # s from having found every peer until they have found this node too
_PATIENCE = 2.0  # s that a controller may take to answer


class Handshake:
    """Waits until the first state can be sent.

    After a reset the wait also lets torques for the run before run out, and the controller is
    asked to start anew, where it has the service; another controller has to be told by hand.

    Args:
        node: of the plant.
    """

    def __init__(self, node: LifecycleNode) -> None:
        self._node = node
        self._client = node.create_client(Trigger, f'{topics.CONTROLLER}/reset')
        self._since = 0.0
        self._ask = False
        self._answer: Any = None
        self._asked = 0.0

    def begin(self, *, ask: bool) -> None:
        """Start to wait; `ask` the controller for a reset when everybody is there."""
        self._since = 0.0
        self._ask = ask
        self._answer = None

    def is_done(self, *, observed: bool) -> bool:
        """Whether the state can be sent; to be called again and again, with whether all listen."""
        if not observed:
            self._since = 0.0
            return False
        now = perf_counter()
        self._since = self._since or now
        if now - self._since < _SETTLING:
            return False
        if self._ask:
            self._ask = False
            if self._client.service_is_ready():
                self._answer = self._client.call_async(Trigger.Request())
                self._asked = now
        return self._is_answered(now)

    def _is_answered(self, now: float) -> bool:
        if self._answer is None:
            return True
        if self._answer.done():
            said = self._answer.result()
            if not said.success:
                self._node.get_logger().warning(f'the controller was not reset: {said.message}')
            return True
        if now - self._asked < _PATIENCE:
            return False
        self._node.get_logger().warning('the controller did not answer to be reset: going on')
        return True
