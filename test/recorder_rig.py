# SPDX-License-Identifier: Apache-2.0
"""A publisher in the test's process, and recorders in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import rclpy
from own_domain import own_domain
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState

from blf_dsc_controller.messages.codecs import JointStateEncoder

PATIENCE = 300.0  # s, until a test gives up on what should take a moment
RECORDER = (sys.executable, '-m', 'blf_dsc_controller.nodes.recorder_node', '--ros-args')
ODD_PARTICIPANT = Path(__file__).with_name('odd_participant.py')
ENCODER = JointStateEncoder(['joint1', 'joint2'])
# Kept for the recorder, which may match slightly later than the publisher.
KEPT = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Rig:
    """A node that publishes, and the recorders; call `close` at the end."""

    def __init__(self, topics=('a',), quality=KEPT):
        self.context = Context()
        self.domain = own_domain()
        rclpy.init(context=self.context, domain_id=self.domain)
        self.node = Node('source', context=self.context)
        self.node.declare_parameter('gain', [1.0, 2.0])
        self.topics = topics
        self.publishers = [
            self.node.create_publisher(JointState, topic, quality) for topic in topics
        ]
        self.processes = []
        self._executor = SingleThreadedExecutor(context=self.context)

    def start(self, output, **parameters):
        """Start a recorder."""
        given = {'output': output, 'topics': f'[{", ".join(self.topics)}]', **parameters}
        words = [word for name, value in given.items() for word in ('-p', f'{name}:={value}')]
        process = subprocess.Popen(
            [*RECORDER, *words],
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, 'ROS_DOMAIN_ID': str(self.domain)},
        )
        self.processes.append(process)
        return process

    def start_odd(self, *topics):
        """Start an odd_participant.py that publishes topics such as `b=foo::bar::Name`."""
        command = [sys.executable, ODD_PARTICIPANT, *topics]
        environment = {**os.environ, 'ROS_DOMAIN_ID': str(self.domain)}
        self.processes.append(subprocess.Popen(command, env=environment))

    def record(self, output, **parameters):
        """Start a recorder and wait until it has subscribed."""
        process = self.start(output, **parameters)
        self.wait_for(lambda: all(one.get_subscription_count() for one in self.publishers))
        return process

    def wait_for(self, condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, 'still waiting'
            rclpy.spin_once(self.node, timeout_sec=0.01, executor=self._executor)

    def publish(self, number):
        """Publish a message with this number as its stamp [ns] on every topic."""
        raw = ENCODER.encode(number, [1, 2], [3, 4], [5, 6])
        for publisher in self.publishers:
            publisher.publish(raw)

    def publish_for(self, seconds):
        """Publish about once per millisecond."""
        end, number = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            self.publish(number)
            number += 1
            time.sleep(0.001)

    def close(self):
        for process in self.processes:
            if process.poll() is None:
                process.kill()
                process.communicate()
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()
