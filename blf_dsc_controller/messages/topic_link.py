# SPDX-License-Identifier: Apache-2.0
"""Messages over a `Link` between a loop without ROS and the process of its topics.

The kind of a message is either a topic, and the content is the serialised message, or one of
those below, and the content is JSON.
"""

from __future__ import annotations

import json
from typing import Any

from blf_dsc_controller.messages import topics

TOPICS = (
    *topics.TOPICS,
    topics.ROBOT_DESCRIPTION,
    topics.JOINT_TRAJECTORY,
    topics.JOINT_POSITIONS,
)
KINDS = {topic: kind for kind, topic in enumerate(TOPICS)}

OF_LOOP = (
    topics.JOINT_STATES,
    topics.COMMANDS,
    topics.JOURNAL,
    topics.TARGETS,
    topics.REFERENCE,
    topics.TRACKING_ERROR,
    topics.BOUND,
    topics.MONITOR,
    topics.EXTERNAL_TORQUE,
    topics.EXTERNAL_WRENCH,
)
"""Topics of which the loop sends each message; STATE and DIAGNOSTICS come from STATUS."""

READY = 100
"""The topics exist: null."""
STATUS = 101
"""For `/diagnostics`: `revision`, `parts` (name, level, message, values)."""
LOG = 102
"""For the log of the node: `level` and `text`."""
STOP = 103
"""`~/stop` was called, and what became of it: text."""


def encode(content: Any) -> bytes:
    """Return JSON."""
    return json.dumps(content).encode()


def decode(content: bytes) -> Any:
    """Return what JSON says."""
    return json.loads(content)
