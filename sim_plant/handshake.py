# SPDX-License-Identifier: Apache-2.0
"""Before the first state of a run: peers are discovered, and the controller is reset."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNode
from std_srvs.srv import Trigger

from blf_dsc_controller.messages import topics

_SETTLING_TIME = 0.2  # s from having found every peer until they have found this node too
_RESET_TIMEOUT = 2.0  # s that a controller may take to respond


class Handshake:
    """Waits until the first state can be sent.

    After a reset of the plant the wait also lets torques of the previous run expire, and the
    controller is reset if it has the service; any other controller has to be reset by hand. `clock`
    is steady [s].
    """

    def __init__(self, node: LifecycleNode, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._log = node.get_logger()
        self._client = node.create_client(Trigger, f'{topics.CONTROLLER}/reset')
        self.begin(reset=False)

    def begin(self, *, reset: bool) -> None:
        """Start waiting; with `reset` the controller is reset when everybody is there."""
        self._complete_since: float | None = None
        self._to_reset = reset
        self._response: Any = None
        self._requested = 0.0

    def reset_controller(self) -> Any:
        """Request a reset of the controller; return its future, None if it has no such service."""
        ready = self._client.service_is_ready()
        return self._client.call_async(Trigger.Request()) if ready else None

    def is_done(self, *, observed: bool) -> bool:
        """Whether the state can be sent; `observed`: whether all topics have subscribers now."""
        now = self._clock()
        if not observed:
            self._complete_since = None
            return False
        if self._complete_since is None:
            self._complete_since = now
        if now - self._complete_since < _SETTLING_TIME:
            return False
        if self._to_reset:
            self._to_reset = False
            self._response = self.reset_controller()
            self._requested = now
        if self._response is None:
            return True
        if self._response.done():
            result = self._response.result()
            if not result.success:
                self._log.warning(f'the controller was not reset: {result.message}')
            return True
        if now - self._requested < _RESET_TIMEOUT:
            return False
        self._log.warning('the controller did not respond to its reset: starting without')
        return True
