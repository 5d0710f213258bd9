# SPDX-License-Identifier: Apache-2.0
"""A managed (lifecycle) node that starts by itself, and that no request can bring down."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from blf_dsc_controller.errors import BlfDscError


class TransitionError(BlfDscError):
    """A node could not be brought into the state it was to start in."""

    def __init__(self, node: str, step: str, reason: str) -> None:
        self.node = node
        self.step = step
        super().__init__(f'{node} could not {step}: {reason}')


class ManagedNode(LifecycleNode):
    """Base of the nodes: override `configure`, `activate`, `deactivate` and `release`.

    Topics, services and parameters are there for the life of the node; what it computes with is
    made when it is configured and let go of when it is cleaned up.

    Attributes:
        finished: True once the node has nothing more to do.
        failure: why the node cannot go on; the process ends with it.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self.finished = False
        self.failure: BlfDscError | None = None
        self._obstacle: Exception | None = None
        super().__init__(name, **options)
        self._take_request = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_request

    def configure(self) -> None:
        """Make what the node computes with."""

    def activate(self) -> None:
        """Begin to work."""

    def deactivate(self) -> None:
        """End to work."""

    def release(self) -> None:
        """Let go of what `configure` made; also after an error, and when nothing was made."""

    def close(self) -> None:
        """Let go of everything that must not be lost, while ROS is still up."""

    @property
    def state_label(self) -> str:
        """State of the node in the words of ROS: unconfigured, inactive, active, finalized."""
        return str(self._state_machine.current_state[1])

    def autostart(self) -> None:
        """Configure and activate the node, as a manager would.

        Raises:
            BlfDscError: what a step raised, or a TransitionError if that was no error of ours.
        """
        for step, trigger in (
            ('configure', self.trigger_configure),
            ('activate', self.trigger_activate),
        ):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                obstacle = self._obstacle
                if isinstance(obstacle, BlfDscError):
                    raise obstacle
                raise TransitionError(self.get_name(), step, repr(obstacle)) from obstacle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer the request to configure."""
        return self._attempt(self.configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer the request to activate."""
        return self._attempt(self.activate, state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer the request to deactivate."""
        return self._attempt(self.deactivate, state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer the request to clean up."""
        return self._attempt(self.release, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer the request to shut down, after which the process ends."""
        answer = self._attempt(self.release, state)
        self.finished = True
        return answer

    def on_error(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Go back to unconfigured after an error nobody foresaw."""
        self.release()
        return TransitionCallbackReturn.SUCCESS

    def _attempt(
        self, step: Callable[[], None], _state: LifecycleState
    ) -> TransitionCallbackReturn:
        try:
            step()
        except BlfDscError as error:
            self._obstacle = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001 - rclpy would swallow it without a word
            self._obstacle = error
            self.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _on_change_request(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Refuse a transition that is not possible now: rclpy lets it end the process."""
        try:
            return self._take_request(request, response)
        except RCLError:
            wanted = request.transition.label or request.transition.id
            self.get_logger().warning(f'no transition {wanted} from {self.state_label}: refused')
            response.success = False
            return response
