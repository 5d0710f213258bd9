# SPDX-License-Identifier: Apache-2.0
"""Nodes of the package in one process, with what a test listens to and asks."""

from __future__ import annotations

import gc
import time
from functools import partial

import numpy as np
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from own_domain import own_domain
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile
from sim_plant.node import PlantNode

PATIENCE = 300.0  # s until a test that waits in vain is given up


class RosRig:
    """A context of its own; `close` it."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(
            context=self.context,
            domain_id=own_domain(),
            signal_handler_options=rclpy.SignalHandlerOptions.NO,
        )
        self.executor = EventsExecutor(context=self.context)
        self.nodes = []
        self.tester = self._keep(rclpy.create_node('tester', context=self.context))
        self._clients = {}

    def _keep(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def close(self):
        while self.nodes:
            self.kill(self.nodes[-1])
        rclpy.try_shutdown(context=self.context)
        # A node's services hold its participant until it is collected, for others to hear.
        self.tester = self.executor = None
        self._clients.clear()
        gc.collect()

    def kill(self, node):
        """End a node without a word to the others."""
        self.nodes.remove(node)
        self.executor.remove_node(node)
        self.spin(0.05)  # what was on its way to the node runs out before its handles are gone
        node.destroy_node()

    def add(self, make, namespace='', clock=time.monotonic_ns, **given):
        """Start a node; `__` in a parameter's name stands for the dot."""
        overrides = [Parameter(k.replace('__', '.'), value=v) for k, v in given.items()]
        node = make(
            context=self.context,
            namespace=namespace,
            parameter_overrides=overrides,
            cli_args=[],
            **({'steady': clock} if make in (PlantNode, ControllerNode) else {}),
        )
        return self._keep(node)

    def loop(self, plant=None, controller=None, namespace='', clock=time.monotonic_ns):
        """Start plant and controller in lock-step; return both."""
        arm = self.add(PlantNode, namespace, clock, mode='lockstep', **(plant or {}))
        law = self.add(ControllerNode, namespace, clock, **(controller or {}))
        return arm, law

    def until(self, condition):
        """Spin until the condition holds."""
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, 'waited in vain'
            self.executor.spin_once(timeout_sec=0.01)

    def spin(self, seconds):
        """Spin for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.01)

    def run(self, arm, samples):
        """Let the loop go on by so many samples."""
        goal = arm.plant.sample + samples
        self.until(lambda: arm.plant.sample >= goal)

    def listen(self, topic, *, raw=False):
        """Return a list that fills with all messages of a topic."""
        heard = []
        name = topic.relative if isinstance(topic, topics.Topic) else topic
        self.tester.create_subscription(
            message_class(topic.type), name, heard.append, qos_profile(topic.offered), raw=raw
        )
        return heard

    def ask(self, service, name, request):
        """Call a service and return its response."""
        key = (service, name)
        if key not in self._clients:
            self._clients[key] = self.tester.create_client(service, name)
        client = self._clients[key]
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def reset(self, node):
        """Call `~/reset` of a node."""
        return self.ask(Trigger, f'{node.get_fully_qualified_name()}/reset', Trigger.Request())

    def change(self, node, transition):
        """Ask for a lifecycle transition by its id; return whether it was made."""
        request = ChangeState.Request(transition=Transition(id=transition))
        name = f'{node.get_fully_qualified_name()}/change_state'
        return self.ask(ChangeState, name, request).success


def torques(heard):
    """Values of commands as an array."""
    return np.array([message.data for message in heard])


def values(status):
    """Key-value pairs of a status as a dict."""
    return {pair.key: pair.value for pair in status.values}


configure, cleanup, activate, deactivate, shutdown = (
    partial(RosRig.change, transition=number)
    for number in (
        Transition.TRANSITION_CONFIGURE,
        Transition.TRANSITION_CLEANUP,
        Transition.TRANSITION_ACTIVATE,
        Transition.TRANSITION_DEACTIVATE,
        Transition.TRANSITION_ACTIVE_SHUTDOWN,
    )
)
