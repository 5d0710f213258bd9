# SPDX-License-Identifier: Apache-2.0
"""Topics of the package: name, message type, quality of service, names of their values.

Nodes, offline writer and reader share this table, so that a bag made without ROS holds
the same topics as a recording of the running nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, WATCHDOG

FOREVER = 2**63 - 1  # ns


@dataclass(frozen=True)
class Quality:
    """Quality of service as plain data, with ROS 2's names; durations in ns."""

    depth: int
    reliability: str = 'reliable'
    durability: str = 'volatile'
    history: str = 'keep_last'
    deadline: int = FOREVER
    lifespan: int = FOREVER
    liveliness: str = 'automatic'
    liveliness_lease_duration: int = FOREVER


@dataclass(frozen=True, eq=False)
class Topic:
    """One topic.

    Compared by identity, because publishers are looked up by it in each sample.

    `name` is as its publisher `node` writes it: `~/x` is private to the node, `x`
    relative to the namespace, `/x` absolute. `offered` is the publisher's quality,
    `requested` the subscriber's.
    """

    node: str
    name: str
    type: str
    offered: Quality
    requested: Quality

    @cached_property
    def relative(self) -> str:
        """Name as another node of the same namespace writes it: `sim_plant/truth`."""
        return self.name.replace('~', self.node, 1)

    @cached_property
    def resolved(self) -> str:
        """Full name in the root namespace without remaps, e.g. `/sim_plant/truth`."""
        return '/' + self.relative.lstrip('/')

    @cached_property
    def leaf(self) -> str:
        """Last part of the name, under any namespace and node, e.g. `truth`."""
        return self.name.rsplit('/', 1)[-1]


Message: TypeAlias = tuple[Topic, bytes]
"""A serialised message and its topic."""


JOINT_STATE = 'sensor_msgs/msg/JointState'
FLOAT64_MULTI_ARRAY = 'std_msgs/msg/Float64MultiArray'
WRENCH = 'geometry_msgs/msg/WrenchStamped'

# The subscribers of the control loop keep one message: a late state or torque is
# useless once the next one has arrived. Publishers keep more, so that a recorder misses
# none. Most are volatile: an arm must never receive an old torque. A recorder that
# starts late reports it, and closed_loop waits until the recorder has subscribed.
LATEST = Quality(depth=1)
UNRELIABLE = Quality(depth=1, reliability='best_effort')
STREAM = Quality(depth=5000)
HISTORY = Quality(depth=5000, durability='transient_local')
LATCHED_QUALITY = Quality(depth=1, durability='transient_local')
DIAGNOSTIC = Quality(depth=10)

# Transient local: a recorder may be matched a moment after the controller.
JOINT_STATES = Topic(PLANT, 'joint_states', JOINT_STATE, HISTORY, LATEST)
COMMANDS = Topic(CONTROLLER, '~/commands', FLOAT64_MULTI_ARRAY, STREAM, LATEST)
REFERENCE = Topic(CONTROLLER, '~/reference', JOINT_STATE, STREAM, STREAM)
TRACKING_ERROR = Topic(CONTROLLER, '~/tracking_error', JOINT_STATE, STREAM, STREAM)
BOUND = Topic(CONTROLLER, '~/bound', JOINT_STATE, HISTORY, LATCHED_QUALITY)
STATE = Topic(
    CONTROLLER,
    '~/state',
    'diagnostic_msgs/msg/DiagnosticStatus',
    LATCHED_QUALITY,
    LATCHED_QUALITY,
)
WATCHDOG_STATE = Topic(
    WATCHDOG,
    '~/state',
    'diagnostic_msgs/msg/DiagnosticStatus',
    LATCHED_QUALITY,
    LATCHED_QUALITY,
)
"""Whether the watchdog is ready; not in TOPICS, as no loop of one process has it."""
MONITOR = Topic(CONTROLLER, '~/monitor', JOINT_STATE, HISTORY, STREAM)
EXTERNAL_TORQUE = Topic(CONTROLLER, '~/external_torque', JOINT_STATE, STREAM, STREAM)
"""Of each joint, and half of its 95 % interval as that of `joint +-`."""
EXTERNAL_WRENCH = Topic(CONTROLLER, '~/external_wrench', WRENCH, STREAM, STREAM)
"""The same at `robot.tip`, in its axes."""
TRUTH = Topic(PLANT, '~/truth', JOINT_STATE, HISTORY, STREAM)
TIMING = Topic(PLANT, '~/timing', JOINT_STATE, STREAM, STREAM)
CLOCK = Topic(PLANT, '/clock', 'rosgraph_msgs/msg/Clock', STREAM, LATEST)
DIAGNOSTICS = Topic(
    CONTROLLER,
    '/diagnostics',
    'diagnostic_msgs/msg/DiagnosticArray',
    DIAGNOSTIC,
    DIAGNOSTIC,
)
MOTOR_STATES = Topic(PLANT, 'motor_states', JOINT_STATE, STREAM, STREAM)
"""Where motors have encoders beside those of the links; not in TOPICS: beside joint states."""
ROBOT_DESCRIPTION = Topic(
    PLANT, 'robot_description', 'std_msgs/msg/String', LATCHED_QUALITY, LATCHED_QUALITY
)
"""The URDF; not in TOPICS, since the offline writer does not write it."""
CHANGES = Topic(PLANT, '~/changes', 'std_msgs/msg/String', HISTORY, HISTORY)
"""Changed parameters of the plant, as JSON: `stamp` of their first sample [ns]."""
JOINT_TRAJECTORY = Topic(
    CONTROLLER,
    '~/joint_trajectory',
    'trajectory_msgs/msg/JointTrajectory',
    DIAGNOSTIC,
    DIAGNOSTIC,
)
"""Published by other nodes for the controller."""
JOURNAL = Topic(CONTROLLER, '~/journal', 'std_msgs/msg/String', HISTORY, HISTORY)
"""Every event of the controller, also for late recorders: see messages.journal."""
TARGETS = Topic(CONTROLLER, '~/targets', 'std_msgs/msg/String', STREAM, STREAM)
"""Events with each trajectory and target, which would fill the journal's history."""
JOINT_POSITIONS = Topic(
    CONTROLLER, '~/joint_positions', FLOAT64_MULTI_ARRAY, LATEST, LATEST
)
"""Published by other nodes for the controller."""

TOPICS = (
    JOINT_STATES,
    COMMANDS,
    REFERENCE,
    TRACKING_ERROR,
    BOUND,
    STATE,
    JOURNAL,
    TARGETS,
    MONITOR,
    EXTERNAL_TORQUE,
    EXTERNAL_WRENCH,
    TRUTH,
    TIMING,
    CLOCK,
    DIAGNOSTICS,
)

# In the vectors truth, timing, monitor.
DISTURBANCE = 'disturbance '  # followed by the joint
# prefixes of disturbance columns
COLUMNS = ('bias ', 'viscous ', 'coulomb ', 'load_friction ', 'sin ', 'cos ')
POSITION = 'position '  # followed by the joint
VELOCITY = 'velocity '  # followed by the joint
RATIO = 'max_error_ratio '  # followed by the joint: the largest |xi1| / k_c so far
DISTANCE = 'distance_to_bound '  # followed by the joint: k_c - |xi1|
LAMBDA_MIN = 'lambda_min'
LATCHED = 'latched'
MODEL_CHANGES = 'model_changes'
LOAD = tuple(
    f'load {name}{what}' for what in ('', ' +-') for name in ('mass', 'x', 'y', 'z')
)  # kg and m in the tip, and half of their 95 % intervals
TOOL = ('tool_error', 'tool_bound', 'tool_angle', 'tool_angle_bound')
"""At the tip, for this posture: error and bound [m], angle and bound [rad]."""
INTERVAL = ' +-'  # after a joint: half of the 95 % interval of its external torque
CONTACT = ('contact', 'contact distance')
COMPUTE_TIME = 'compute_time'
LATENCY = 'latency'
LATENESS = 'lateness'
LATE_STEPS = 'late_steps'

# In /diagnostics.
REJECTED = 'rejected '  # followed by the column that is not estimated

# In ~/state of the watchdog.
READY = 'ready'  # whether it can take over

# In ~/state of the controller.
PHASE = 'phase'
REASON = 'reason'
STOPS = 'stops'  # since the node was configured
