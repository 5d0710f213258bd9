# SPDX-License-Identifier: Apache-2.0
"""Running nodes as a process: signals, spinning, and the right exit code."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.duration import Duration
from rclpy.experimental import EventsExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.publisher import Publisher

from blf_dsc_controller.control.realtime import undisturbed_loop
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.ros_arguments import refuse_unknown

_POLL = 0.1  # s; EventsExecutor has no usable spin()
# s for all topics; a recorder on a busy machine has been seen 2 s behind
_DRAIN_TIMEOUT = 10.0
_SHORT = 1.0  # s likewise, until it is said


_signals: list[int] = []  # received; only recorded, so that no callback is interrupted


def interrupted() -> bool:
    """Whether the process of `run` has received SIGINT or SIGTERM."""
    return bool(_signals)


def yield_to_loop() -> None:
    """Run beside a loop, also after its signals, since it may still brake; without its priority."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


class PlainNode(Node):
    """A node for `run`.

    It sets `finished` once it has nothing more to do, with `failure` if it cannot
    continue.
    """

    finished = False
    failure: BlfDscError | None = None

    def close(self) -> None:
        """Save data and release resources while ROS is still up."""

    def prepare_to_end(self) -> bool:
        """Prepare to end after a signal; return whether it may. Called until all nodes may."""
        return True

    def survive(self, error: Exception) -> bool:  # noqa: ARG002
        """Return whether the node continues after an error in a callback."""
        return False


def run(*make_nodes: Callable[[], PlainNode]) -> int:
    """Run nodes until one finishes or fails, or the process receives a signal.

    Those made last are closed first. Only a node that runs alone survives errors of its
    callbacks. Returns the exit code: 0 at the end or on SIGINT and SIGTERM, 1 after an
    error, which is printed to stderr.
    """
    nodes: list[PlainNode] = []
    problem = ''
    with ExitStack() as ending:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: _signals.append(number))
            # ros2 launch forwards the terminal's signal: the second copy arrives at the
            # end.
            ending.callback(signal.signal, number, signal.SIG_IGN)
        try:
            refuse_unknown(sys.argv)
            rclpy.init(
                args=sys.argv, signal_handler_options=rclpy.SignalHandlerOptions.NO
            )
            ending.callback(rclpy.try_shutdown)
            with EventsExecutor() as executor:
                for make in make_nodes:
                    nodes.append(make())
                    ending.callback(_close, nodes[-1])
                    executor.add_node(nodes[-1])
                with undisturbed_loop():
                    while not _end(nodes):
                        spin_once(executor, *nodes)
            for failure in filter(None, (node.failure for node in nodes)):
                raise failure
        except UnknownROSArgsError as error:
            problem = f'unknown arguments after --ros-args: {error}'
        except (BlfDscError, RCLError, OSError) as error:
            problem = str(error)
    if problem:  # last, so that it ends the output
        print(problem, file=sys.stderr)  # noqa: T201
        return 1
    return 0


def _end(nodes: list[PlainNode]) -> bool:
    """Let nodes prepare to end after a signal; return whether all are, or one has finished."""
    ready = interrupted() and all(node.prepare_to_end() for node in nodes)
    return ready or any(node.finished for node in nodes)


def spin_once(executor: Any, *nodes: PlainNode) -> None:
    """Wait for work and do it; raise errors that the only node does not survive."""
    try:
        executor.spin_once(timeout_sec=_POLL)
    except RCLError:
        raise
    except Exception as error:
        if len(nodes) > 1 or not nodes[0].survive(error):
            raise


def _close(node: PlainNode) -> None:
    try:
        node.close()
    # such as a full disk, or ROS shut down
    except (BlfDscError, OSError, RCLError) as error:
        problem = f'{node.get_name()} could not shut down cleanly: {error}'
        print(problem, file=sys.stderr)  # noqa: T201
    finally:
        node.destroy_node()


def drain(publishers: Iterable[Publisher]) -> None:
    """Wait until every subscriber has received everything, and say so if it takes long."""
    log = get_logger('end')
    begin = time.monotonic()
    late = [each for each in publishers if not _is_drained(each, begin + _SHORT)]
    if late:
        names = ', '.join(publisher.topic_name for publisher in late)
        log.info(
            f'waiting for subscribers of {names} to take the last messages, at most '
            f'{_DRAIN_TIMEOUT:g} s: one that was killed does not'
        )
    for publisher in late:
        if not _is_drained(publisher, begin + _DRAIN_TIMEOUT):
            log.warning(
                f'{publisher.topic_name}: the last messages did not reach every subscriber'
            )


def _is_drained(publisher: Publisher, deadline: float) -> bool:
    """Whether every subscriber has received everything by a time of the steady clock [s]."""
    left = max(0.0, deadline - time.monotonic())
    return bool(publisher.wait_for_all_acked(Duration(seconds=left)))
