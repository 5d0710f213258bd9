# SPDX-License-Identifier: Apache-2.0
"""Nodes of the package in this process: one context and one executor for each test."""

from __future__ import annotations

import gc
import time

import numpy as np
import rclpy
from own_domain import own_domain
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayDecoder,
    JointStateDecoder,
    JointStateEncoder,
)
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile
from blf_dsc_controller.simulation.loop import simulate

PATIENCE = 300.0  # s, until a test gives up on what should take a moment
JOINTS = ('joint1', 'joint2')
START = (2.293, 1.696)  # rad, inside the bound at the reference's start


class NodeLoop:
    """Nodes on one executor, and a node of the test's own beside them."""

    def __init__(self):
        self.context = Context()
        rclpy.init(context=self.context, domain_id=own_domain())
        self.executor = EventsExecutor(context=self.context)
        self.nodes = []
        self.tester = Node('tester', context=self.context, start_parameter_services=False)
        self.executor.add_node(self.tester)

    def add(self, make_node, values=None, **clocks):
        """Start a node with these parameters by their dotted names."""
        overrides = [Parameter(name, value=value) for name, value in (values or {}).items()]
        node = make_node(context=self.context, parameter_overrides=overrides, **clocks)
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def listen(self, topic):
        """Return a list that gets every serialised message of a topic."""
        heard = []
        self.tester.create_subscription(
            message_class(topic.type),
            topic.relative,
            heard.append,
            qos_profile(topics.STREAM),
            raw=True,
        )
        return heard

    def publisher(self, topic):
        """Publisher of the test's own on a topic of another node."""
        return self.tester.create_publisher(
            message_class(topic.type), topic.relative, qos_profile(topic.offered)
        )

    def spin_until(self, condition):
        """Let the nodes work until the condition holds."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, 'still waiting'
            self.executor.spin_once(timeout_sec=0.05)

    def close(self):
        """End every node."""
        for node in (*self.nodes, self.tester):
            self.executor.remove_node(node)
            node.destroy_node()
        self.context.try_shutdown()
        # A node's services hold its participant until it is collected, for others to hear.
        self.nodes.clear()
        self.tester = self.executor = None
        gc.collect()


class Arm:
    """Joint states sent by hand to a controller, and the torques that come back."""

    def __init__(self, loop, names=JOINTS):
        self._loop = loop
        self._publisher = loop.publisher(topics.JOINT_STATES)
        self._commands = loop.listen(topics.COMMANDS)
        self._encoder = JointStateEncoder(names)

    def ask(self, k, position, velocity=None, *, encoder=None):
        """Send the state of sample k and return the torque that answers it, (2,) N m."""
        size = len(position)
        velocity = np.zeros(size) if velocity is None else velocity
        raw = (encoder or self._encoder).encode(
            1_000_000_000 + k * 1_000_000, position, velocity, np.zeros(size)
        )
        self._loop.spin_until(lambda: self._publisher.get_subscription_count() > 0)
        before = len(self._commands)
        self._publisher.publish(raw)
        self._loop.spin_until(lambda: len(self._commands) > before)
        return torques(self._commands)[-1]


def torques(commands):
    """Decode commands, (k, 2) N m."""
    decoder = Float64MultiArrayDecoder(2)
    rows = []
    for raw in commands:
        assert decoder.decode(raw) == 2
        rows.append(decoder.values.copy())
    return np.array(rows)


def states(messages, names=JOINTS):
    """Decode joint states: stamps (k,) ns and values (k, 3, names)."""
    decoder = JointStateDecoder(names, required=('position',))
    stamps, rows = [], []
    for raw in messages:
        stamps.append(decoder.decode(raw))
        rows.append(np.reshape(decoder.values, (3, len(names))).copy())
    return np.array(stamps), np.array(rows)


def simulated_torques(plant, controller=None):
    """Torques of the compiled loop on the same parameters, (k, 2) N m."""
    record = simulate(build(ControllerConfig, controller or {}), build(PlantConfig, plant))
    return np.array([record.sample(row).torque for row in range(record.stamps.size)])
