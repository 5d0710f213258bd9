# SPDX-License-Identifier: Apache-2.0
"""Running one node as a process: start, spin, and an end that always exits with the right code."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterable
from types import FrameType
from typing import TypeAlias

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.duration import Duration
from rclpy.experimental import EventsExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.publisher import Publisher

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.lifecycle import ManagedNode

_POLL = 0.1  # s; EventsExecutor has no usable spin()
_GRACE = 10.0  # s for all topics; a recorder on a busy machine has been seen 2 s behind


class RunnableNode(Node):
    """A plain node that `run` can run.

    Attributes:
        finished: True once the node has nothing more to do.
        failure: why the node cannot go on; the process ends with it.
    """

    finished = False
    failure: BlfDscError | None = None

    def close(self) -> None:
        """Let go of everything that must not be lost, while ROS is still up."""


Runnable: TypeAlias = RunnableNode | ManagedNode


class _Signals:
    """SIGINT and SIGTERM as a flag: a callback is never cut off in the middle."""

    def __init__(self) -> None:
        self.came = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        self.came = True


def run(make_node: Callable[[], Runnable]) -> int:
    """Run a node until it has finished, a signal comes, or it fails.

    Returns:
        Exit code: 0 at the end or on SIGINT and SIGTERM, 1 after an error, which is on stderr.
    """
    signals = _Signals()
    node: Runnable | None = None
    complaint = ''
    try:
        rclpy.init(args=sys.argv, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        executor = EventsExecutor()
        node = make_node()
        executor.add_node(node)
        while not (signals.came or node.finished):
            executor.spin_once(timeout_sec=_POLL)
        executor.remove_node(node)
        if node.failure is not None:
            raise node.failure
    except UnknownROSArgsError as error:
        complaint = f'arguments after --ros-args that ROS does not know: {error}'
    except (BlfDscError, RCLError, OSError) as error:
        complaint = str(error)
    finally:
        if node is not None:
            _close(node)
        rclpy.try_shutdown()
    if complaint:  # last, so that it stands at the end of whatever else was said
        print(complaint, file=sys.stderr)  # noqa: T201
        return 1
    return 0


def _close(node: Runnable) -> None:
    try:
        node.close()
    except OSError as error:  # such as a full disk, which `run` has told of if it ended the node
        print(f'{node.get_name()} could not end in order: {error}', file=sys.stderr)  # noqa: T201
    node.destroy_node()


def drain(publishers: Iterable[Publisher]) -> None:
    """Wait until every subscriber has what was published, so that no recorder misses the end."""
    deadline = time.monotonic() + _GRACE
    for publisher in publishers:
        left = max(0.0, deadline - time.monotonic())
        if not publisher.wait_for_all_acked(Duration(seconds=left)):
            get_logger('end').warning(
                f'{publisher.topic_name}: the last messages have not reached every subscriber'
            )
