# SPDX-License-Identifier: Apache-2.0
"""Whether another node commands the arm already, found out before the first torque.

A publisher of torques may be one of a controller in command, of one that is not active,
or of one that was killed: it stays visible for some 20 s.  So the torques themselves
decide, for which there is a moment to wait where there is such a publisher.  Of controllers
that are started at once, each waits for a time of its own: the first commands, the others
hear it.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from enum import Enum
from math import inf

import numpy as np
from rclpy.node import Node

from blf_dsc_controller.configuration.nodes import WATCHDOG
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayDecoder,
    Float64MultiArrayEncoder,
)
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.nodes.endpoints import RawMessage, RawSubscriptions

_LISTENING = 1.0  # s, in which a controller in command is heard
_SPREAD = 1.0  # s, over which controllers that start together spread
_LOOK_PERIOD = 0.05  # s
_ACTING = 100_000_000  # ns, for which a torque of the watchdog is the one that acts


class Finding(Enum):
    """Whether another node commands the arm."""

    UNKNOWN = 'unknown yet'
    NOBODY = 'nobody'
    SOMEBODY = 'somebody'


class OtherCommander:
    """Listens to the torques of an arm on a topic, until this node publishes its own there.

    `steady` is its clock [ns].

    Attributes:
        topic: its full name.
    """

    def __init__(
        self, node: Node, topic: str, joints: int, steady: Callable[[], int]
    ) -> None:
        self._node = node
        self.topic = topic
        self._joints = joints
        self._steady = steady
        self._listening = _LISTENING + random.uniform(0.0, _SPREAD)  # noqa: S311
        self._of_watchdog: RawMessage | None = None  # its last torque
        self._watchdogs = Float64MultiArrayEncoder(joints, WATCHDOG)
        self._subscriptions = RawSubscriptions(node)
        quality = Quality(depth=1, reliability='best_effort')
        type_name = topics.COMMANDS.type
        self._subscriptions.subscribe(self.topic, type_name, quality, None)
        self.begin()

    def begin(self) -> None:
        """Listen from now on."""
        self._subscriptions.take()
        self._since = inf  # s, when other publishers were seen first
        self._looked = -inf

    def find(self) -> Finding:
        """Return who commands the arm, as far as it is known by now."""
        now = self._steady() * 1e-9
        if self._take():
            return Finding.SOMEBODY
        if now - self._looked >= _LOOK_PERIOD:
            self._looked = now
            if not self._has_others():
                return Finding.NOBODY
            self._since = min(self._since, now)
        is_silent = now - self._since >= self._listening
        return Finding.NOBODY if is_silent else Finding.UNKNOWN

    def _take(self) -> bool:
        """Take the torques that have come; return whether one was another controller's."""
        others = False
        for message in self._subscriptions.take():
            if self._watchdogs.has_layout(message.raw):
                self._of_watchdog = message
            else:
                others = True
        return others

    def torque_of_watchdog(self) -> np.ndarray | None:
        """Return the torque (n,) [N m] by which the watchdog holds the arm now; or None."""
        self._take()
        message = self._of_watchdog
        if message is None or time.time_ns() - message.received > _ACTING:
            return None
        decoder = Float64MultiArrayDecoder(self._joints)
        decoder.decode(message.raw)
        return decoder.values

    def close(self) -> None:
        """Listen no more."""
        self._subscriptions.close()

    def _has_others(self) -> bool:
        """Whether other nodes than the watchdog publish torques, besides the own one."""
        found = self._node.get_publishers_info_by_topic(self.topic)
        others = [each for each in found if each.node_name != WATCHDOG]
        return len(others) > 1
