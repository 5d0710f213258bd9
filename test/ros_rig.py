# SPDX-License-Identifier: Apache-2.0
"""Nodes of the package in one process, with helpers for topics and services."""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path

import node_garbage
import numpy as np
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from own_domain import own_domain
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

import blf_dsc_controller as blf
from blf_dsc_controller.cli.domains import strangers
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateDecoder
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile
from blf_dsc_controller.nodes.plant_node import PlantNode

PATIENCE = 240.0  # s, until a test gives up waiting for another process
LIMIT = 20.0  # s of a computer without other work, until it gives up waiting for a node
_SPIN = 0.01  # s
JOINTS = ('joint1', 'joint2')
START = (2.293, 1.696)  # rad, inside the bound at the reference's start


def _joined(args):
    """Return a context in a domain in which nobody else is, also after it was entered."""
    while True:
        context = rclpy.Context()
        rclpy.init(
            args=args,
            context=context,
            domain_id=own_domain(),
            signal_handler_options=rclpy.SignalHandlerOptions.NO,
        )
        if not strangers(context.get_domain_id()):
            return context
        rclpy.try_shutdown(context=context)


def _share():
    """Return the part of a core that each of the threads that run now has."""
    running, _, _ = Path('/proc/loadavg').read_text().split()[3].partition('/')
    return min(1.0, len(os.sched_getaffinity(0)) / int(running))


class RosRig:
    """A ROS context of its own; call `close` at the end."""

    def __init__(self, args=None):
        node_garbage.begin()
        self.context = _joined(args)
        self.executor = EventsExecutor(context=self.context)
        self.nodes = []
        self.tester = self.keep(
            rclpy.create_node('record_tester', context=self.context)
        )
        # by the name of their service; kept, since events may be pending
        self._clients = {}

    def keep(self, node):
        """Spin a node, until the end or `kill`."""
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def close(self):
        while self.nodes:
            self.kill(self.nodes[-1])
        rclpy.try_shutdown(context=self.context)
        self.tester = self.executor = None
        self._clients.clear()
        node_garbage.end()

    def kill(self, node):
        """Destroy a node without notifying the others."""
        self.nodes.remove(node)
        self.executor.remove_node(node)
        # A busy computer may be late: the node's pending events are before this task.
        self.until(self.executor.create_task(lambda: None).done)
        node.destroy_node()

    def add(self, make, values=None, *, namespace='', clock=time.monotonic_ns, **given):
        """Start a node with parameters: `values` by dotted name, keywords with `__` for a dot."""
        given = {k.replace('__', '.'): v for k, v in given.items()} | (values or {})
        overrides = [Parameter(k, value=v) for k, v in given.items() if v != ()]
        node = make(
            context=self.context,
            namespace=namespace,
            parameter_overrides=overrides,
            cli_args=[],
            **({'steady': clock} if make in (PlantNode, ControllerNode) else {}),
        )
        return self.keep(node)

    def loop(self, plant=None, controller=None, **options):
        """Start plant and controller in lock-step; return both."""
        arm = self.add(PlantNode, mode='lockstep', **options, **(plant or {}))
        law = self.add(ControllerNode, **options, **(controller or {}))
        return arm, law

    def until(self, condition, limit=LIMIT):
        """Spin until the condition holds, at most `limit` [s] of a computer without other work.

        Time that others take from this process and from those that it waits for is not
        counted, nor how long a callback takes, such as one that compiles.
        """
        waited = 0.0
        while not condition():
            assert waited < limit, 'waited in vain'
            begin = time.monotonic()
            self.executor.spin_once(timeout_sec=_SPIN)
            waited += min(time.monotonic() - begin, _SPIN) * _share()

    def spin(self, seconds):
        """Spin for a while."""
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() >= end)

    def run(self, arm, samples):
        """Let the loop run for this many samples, of 1 ms or so each."""
        goal = arm.plant.sample + samples
        self.until(lambda: arm.plant.sample >= goal, LIMIT + 0.01 * samples)

    def listen(self, topic, *, raw=False):
        """Return a list that fills with all messages of a topic."""
        messages = []
        name = topic.relative if isinstance(topic, topics.Topic) else topic
        self.tester.create_subscription(
            message_class(topic.type),
            name,
            messages.append,
            qos_profile(topic.offered),
            raw=raw,
        )
        return messages

    def observe(self, node):
        """Subscribe to all that a node publishes, as a recorder does: it may wait for one."""
        self.until(lambda: node.state_label != 'unconfigured')
        for each in list(node.publishers):
            self.tester.create_subscription(
                each.msg_type, each.topic_name, lambda _: None, 10, raw=True
            )

    def driver(self):
        """Start a node that takes torques, as an effort controller does."""
        node = self.keep(rclpy.create_node('driver', context=self.context))
        topic = topics.COMMANDS
        quality = qos_profile(topic.requested)
        node.create_subscription(
            message_class(topic.type), topic.relative, lambda _: None, quality
        )

    def publisher(self, topic):
        """Return a publisher of the test on a topic of another node."""
        return self.tester.create_publisher(
            message_class(topic.type), topic.relative, qos_profile(topic.offered)
        )

    def call(self, service, name, request):
        """Call a service and return its response."""
        client = self._clients.get(name) or self.tester.create_client(service, name)
        self._clients[name] = client
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def reset(self, node):
        """Call `~/reset` of a node."""
        return self.call(
            Trigger, f'{node.get_fully_qualified_name()}/reset', Trigger.Request()
        )

    def change(self, node, transition):
        """Request a lifecycle transition by its id; return whether it was made."""
        request = ChangeState.Request(transition=Transition(id=transition))
        name = f'{node.get_fully_qualified_name()}/change_state'
        return self.call(ChangeState, name, request).success


class PatientClock:
    """Steady clock [ns], slower than real time, that stands while nobody reads it.

    So the arm does not fall on while the computer lets this process and its watchdog wait.
    """

    MOST = 2_000_000  # ns between two readings: a sample of the arm

    def __init__(self, slower=5):
        self.slower = slower  # times
        self.now = 10**9
        self._read = time.monotonic_ns()

    def __call__(self):
        read = time.monotonic_ns()
        self.now += min((read - self._read) // self.slower, self.MOST)
        self._read = read
        return self.now


class FakeClock:
    """Steady clock [ns]."""

    def __init__(self):
        self.now = 10**9

    def __call__(self):
        return self.now

    def advance(self, seconds):
        self.now += round(1e9 * seconds)


def torques(messages):
    """Return the values of commands as an array."""
    return np.array([message.data for message in messages])


def states(messages, names=JOINTS):
    """Decode serialised joint states: stamps (k,) ns and values (k, 3, names)."""
    decoder = JointStateDecoder(names, required=('position',))
    stamps, rows = [], []
    for raw in messages:
        stamps.append(decoder.decode(raw))
        rows.append(np.reshape(decoder.values, (3, len(names))).copy())
    return np.array(stamps), np.array(rows)


def simulated(plant, controller=None):
    """Return the simulated run with the same parameters."""
    return blf.simulate(
        build(blf.ControllerConfig, controller or {}), build(blf.PlantConfig, plant)
    ).run()


def values(status):
    """Return the key-value pairs of a status as a dict."""
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
