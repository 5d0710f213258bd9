# SPDX-License-Identifier: Apache-2.0
"""A node that is killed beside others, on a computer that is too busy to keep up."""

from __future__ import annotations

import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from blf_dsc_controller.nodes.watchdog_node import WatchdogNode


def test_killed_node_is_called_no_more_however_late_the_executor_is(ros):
    """Its timers expire every 4 ms behind events that take 0.3 s."""
    for _ in range(8):
        node = ros.add(WatchdogNode)
        ros.spin(0.1)
        for _ in range(300):
            ros.executor.create_task(lambda: time.sleep(1e-3))
        ros.kill(node)
        ros.spin(0.1)
    assert ros.nodes == [ros.tester]
