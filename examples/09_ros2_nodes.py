# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 nodes: controller, simulated Panda, a trajectory on a topic, and RViz if it is there.

python examples/09_ros2_nodes.py [realtime | lockstep]
"""

import shutil
import subprocess
import sys

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

import blf_dsc_controller as blf

PRESET = str(blf.share_folder() / 'config' / 'panda.yaml')
# A node ends as by Ctrl-C with its input, which is this program's as long as it lives.
STARTED = """
import os, signal, threading
def end_with_parent():
    os.read(0, 1)  # not by sys.stdin, whose lock Python takes at its end
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=end_with_parent, daemon=True).start()
from blf_dsc_controller.cli.main import {0}
raise SystemExit({0}())
"""


def started(name: str, *parameters: str) -> subprocess.Popen:
    """Start a node, as `ros2 run blf_dsc_controller NAME` does."""
    given = [word for each in parameters for word in ('-p', each)]
    words = ['--ros-args', '--params-file', PRESET, *given]
    command = [sys.executable, '-c', STARTED.format(name), *words]
    return subprocess.Popen(command, stdin=subprocess.PIPE)


mode = sys.argv[1] if len(sys.argv) > 1 else 'realtime'
processes = []
rclpy.init()  # before the nodes: from here on, Ctrl-C and SIGTERM end in `finally`
try:
    processes.append(started('blf_dsc_controller', 'reference.type:=hold'))
    processes.append(started('sim_plant', f'mode:={mode}'))
    if rviz := shutil.which('rviz2'):
        view = str(blf.share_folder() / 'config' / 'arm.rviz')
        processes.append(subprocess.Popen([rviz, '-d', view]))
    node = Node('example')
    status, states = [], []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(
        DiagnosticStatus, 'blf_dsc_controller/state', status.append, latched
    )
    node.create_subscription(JointState, 'joint_states', states.append, 1)
    sender = node.create_publisher(
        JointTrajectory, 'blf_dsc_controller/joint_trajectory', 1
    )
    while not (status and 'tracking' in status[-1].message and states):
        rclpy.spin_once(node, timeout_sec=0.1)
    names, begin = states[-1].name, states[-1].position
    point = JointTrajectoryPoint(positions=[q + 0.1 for q in begin])
    point.time_from_start = Duration(seconds=2.0).to_msg()
    sender.publish(JointTrajectory(joint_names=names, points=[point]))
    there = np.array(point.positions)
    while np.abs(states[-1].position - there).max() > 0.01:
        rclpy.spin_once(node, timeout_sec=0.1)
        del states[:-1]
    print('the arm is there:', [round(q, 2) for q in states[-1].position])
finally:
    for process in processes:
        process.terminate()
    for process in processes:
        process.wait()
