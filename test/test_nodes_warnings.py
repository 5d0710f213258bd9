# SPDX-License-Identifier: Apache-2.0
"""What the controller node warns of: refused columns with their reason, gains that cannot work."""

from __future__ import annotations

from functools import partial

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from diagnostic_msgs.msg import DiagnosticArray
from node_loop import NodeLoop
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile

from blf_dsc_controller.nodes.controller_node import ControllerNode
from sim_plant.node import PlantNode

OBSERVED = {'wait_for_subscribers': 0}
COSINE = {'learning.frequencies': [1.0], 'learning.bias': False}


@pytest.fixture
def loop():
    one = NodeLoop()
    yield one
    one.close()


# /rosout keeps what was logged before anyone had found the node.
KEPT = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def named(namespace, make_node):
    """Node whose logger no other test of this process has: rcl keeps a publisher for each name."""
    return partial(make_node, namespace=namespace)


def listen(loop, kind, topic, quality=100):
    heard = []
    loop.tester.create_subscription(kind, topic, heard.append, quality)
    return heard


def test_refused_columns_are_logged_and_diagnosed_with_what_they_are_like(loop):
    """On the paper's reference cos t on both joints is the column of m2 l2^2."""
    log, diagnostics = (
        listen(loop, Log, '/rosout', KEPT),
        listen(loop, DiagnosticArray, '/diagnostics'),
    )
    loop.add(named('refused', ControllerNode), COSINE)
    arm = loop.add(named('refused', PlantNode), {'mode': 'lockstep', 'duration': 7.0})

    def refused():
        return [
            (status.message, value)
            for array in diagnostics
            for status in array.status
            for value in status.values
            if value.key.startswith('rejected cos 1 rad/s')
        ]

    loop.spin_until(lambda: arm.finished and refused())
    message, value = refused()[-1]
    assert message.startswith('not estimated: cos 1 rad/s')
    assert 'cannot be told from m2*l2^2' in value.value
    warned = [one.msg for one in log if 'is not estimated' in one.msg]
    assert len(warned) == 1  # once, not in every sample
    assert 'cannot be told from m2*l2^2' in warned[0]


def test_concerns_are_logged_before_the_first_state(loop):
    log = listen(loop, Log, '/rosout', KEPT)
    loop.add(named('concerned', ControllerNode), {'learning.window': 5.0})
    loop.spin_until(lambda: any('learning.window: 5 s' in one.msg for one in log))
