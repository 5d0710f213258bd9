# SPDX-License-Identifier: Apache-2.0
"""The rig: nodes that are killed beside others, and what a test leaves to the next one."""

from __future__ import annotations

import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from own_domain import own_domain

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


def test_domain_in_which_a_node_is_left_is_not_taken_again(ros):
    """A subscription in it would be taken for that of the next test's node."""
    assert ros.context.get_domain_id() not in {own_domain() for _ in range(20)}
