# SPDX-License-Identifier: Apache-2.0
"""A managed (lifecycle) node that starts by itself, and that no request can bring down."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.rclpy_internals import RCLError, lifecycle_state, wrap_change_state


class ManagedNode(LifecycleNode):
    """Base class of the nodes: override `configure`, `activate`, `deactivate` and `release`.

    Topics, services and parameters exist for the life of the node; what it computes with is made
    when it is configured and released when it is cleaned up.

    Attributes:
        finished: True once the node has nothing more to do.
        failure: why the node cannot go on; the process ends with it.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self.finished = False
        self.failure: BlfDscError | None = None
        self._transition_error: Exception | None = None
        super().__init__(name, **options)
        wrap_change_state(self, self._rejecting)

    def configure(self) -> None:
        """Make what the node computes with."""

    def activate(self) -> None:
        """Start working."""

    def deactivate(self) -> None:
        """Stop working."""

    def release(self) -> None:
        """Release what `configure` made; also called after an error, when nothing was made."""

    def close(self) -> None:
        """Save and release what must not be lost, while ROS is still up."""

    @property
    def state_label(self) -> str:
        """State of the node: unconfigured, inactive, active or finalized."""
        return lifecycle_state(self)

    def autostart(self) -> None:
        """Configure and activate the node, as a manager would.

        Raises:
            BlfDscError: a step failed; the error that it raised, if that was one of ours.
        """
        for name, step in (
            ('configure', self.trigger_configure),
            ('activate', self.trigger_activate),
        ):
            if step() != TransitionCallbackReturn.SUCCESS:
                error = self._transition_error
                if isinstance(error, BlfDscError):
                    raise error
                raise BlfDscError(f'{self.get_name()} could not {name}: {error!r}') from error

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: D102
        return self._try(self.configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: D102
        return self._try(self.activate, state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: D102
        return self._try(self.deactivate, state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: D102
        return self._try(self.release, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything and end the process."""
        result = self._try(self.release, state)
        self.finished = True
        return result

    def on_error(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Return to unconfigured after an unforeseen error."""
        self.release()
        return TransitionCallbackReturn.SUCCESS

    def _try(self, step: Callable[[], None], _state: LifecycleState) -> TransitionCallbackReturn:
        try:
            step()
        except BlfDscError as error:
            self._transition_error = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001 - rclpy would drop it silently
            self._transition_error = error
            self.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _rejecting(self, change_state: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Reject impossible transitions, which would otherwise end the process."""

        def callback(request: ChangeState.Request, response: ChangeState.Response) -> Any:
            try:
                return change_state(request, response)
            except RCLError:
                wanted = request.transition.label or request.transition.id
                self.get_logger().warning(
                    f'no transition {wanted} from {self.state_label}: rejected'
                )
                response.success = False
                return response

        return callback
