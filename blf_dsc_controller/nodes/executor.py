# SPDX-License-Identifier: Apache-2.0
"""Running one node as a process: start, spin, and an end that always exits with the right code."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterable
from typing import Protocol

import rclpy
from rclpy.duration import Duration
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher

from blf_dsc_controller.errors import BlfDscError

_POLL = 0.1  # s; EventsExecutor has no usable spin()
_GRACE = Duration(seconds=2)


class Runnable(Protocol):
    """What `run` needs of a node, beside being one."""

    finished: bool
    """True once the node has nothing more to do."""

    def close(self) -> None:
        """Let go of everything that must not be lost, while the node still exists."""


def run(make_node: Callable[[], Runnable]) -> int:
    """Run a node until it has finished, a signal comes, or its configuration is refused.

    Returns:
        Exit code: 0 at the end or on SIGINT and SIGTERM, 1 after an error, which is on stderr.
    """
    rclpy.init(args=sys.argv)
    executor = EventsExecutor()
    node: Runnable | None = None
    try:
        node = make_node()
        executor.add_node(node)
        while rclpy.ok() and not node.finished:
            executor.spin_once(timeout_sec=_POLL)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except BlfDscError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return 1
    except RCLError:
        if rclpy.ok():
            raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if node is not None:
            _end(executor, node)
        rclpy.try_shutdown()
    return 0


def drain(publishers: Iterable[Publisher]) -> None:
    """Wait until every subscriber has what was published, so that no recorder misses the end."""
    if rclpy.ok():
        for publisher in publishers:
            publisher.wait_for_all_acked(_GRACE)


def _end(executor: rclpy.executors.Executor, node: Runnable) -> None:
    node.close()
    if isinstance(node, Node):
        executor.remove_node(node)
        node.destroy_node()
