# SPDX-License-Identifier: Apache-2.0
"""Handshake before the first state of a run: discover the peers and reset the controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNode
from std_srvs.srv import Trigger

from blf_dsc_controller.messages import topics

_SETTLING_TIME = 0.2  # s from the discovery of all peers until they have discovered this node
_RESET_TIMEOUT = 2.0  # s for the controller to respond


class Handshake:
    """Handshake that ends when the first state can be sent.

    After a reset of the plant, the wait also lets torques of the previous run expire, and the
    controller is reset if it offers the service; any other controller must be reset by hand.
    `clock` returns a steady time [s].
    """

    def __init__(self, node: LifecycleNode, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._log = node.get_logger()
        self._client = node.create_client(Trigger, f'{topics.CONTROLLER}/reset')
        self.begin(reset=False)

    def begin(self, *, reset: bool) -> None:
        """Start waiting; with `reset`, reset the controller once all peers are present."""
        self._complete_since: float | None = None
        self._to_reset = reset
        self._response: Any = None
        self._requested = 0.0

    def reset_controller(self) -> Any:
        """Request a reset of the controller; return the future, or None without such a service."""
        ready = self._client.service_is_ready()
        return self._client.call_async(Trigger.Request()) if ready else None

    def is_done(self, *, observed: bool) -> bool:
        """Return whether to send the state; `observed`: whether all topics have subscribers."""
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
        self._log.warning('the controller did not respond to the reset request: starting anyway')
        return True
