# SPDX-License-Identifier: Apache-2.0
"""A process beside a loop, for which the loop never waits: its motions in, reports out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from math import inf
from time import monotonic

from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.messages import topic_link
from blf_dsc_controller.messages.link import Link
from blf_dsc_controller.messages.topic_link import LOG
from blf_dsc_controller.supervision.guard import Guard


class Beside(ABC):
    """What a loop without ROS exchanges with a process beside it."""

    def __init__(
        self,
        link: Link,
        controller: ArmController,
        inputs: MotionInput | None = None,
    ) -> None:
        """Take motions that come over a link, to which the log goes.

        `inputs` are those that the driver has itself: who stops them, stops these.
        """
        self._link = link
        self._guard = controller.guard
        self.log = LinkLog(link)
        self._untrusted = ''  # what was said of the torque sensors
        self._inputs = inputs or MotionInput(
            len(controller.joints), lambda: self._guard, _is_live, self.log
        )
        self._inputs.log = self.log

    def follow(self) -> None:
        """Send what waits and take what has arrived; after each state's torque."""
        if self._link.broken:
            return
        self._inputs.poll(self._guard)
        for kind, content in self._link.messages():
            self._take(kind, content)
        self._tell_untrusted()
        self._tell_changes()
        self._link.flush()

    def _tell_untrusted(self) -> None:
        """Warn once of efforts that the law takes for those of no torque sensors."""
        if self._guard.findings.untrusted != self._untrusted:
            self._untrusted = self._guard.findings.untrusted
            if self._untrusted:
                self.log.warning(self._untrusted)

    @abstractmethod
    def _take(self, kind: int, content: bytes) -> None:
        """Do what a message wants."""

    @abstractmethod
    def _tell_changes(self) -> None:
        """Tell what has changed since the last state."""


class LinkLog:
    """The log of the loop, which is written in the other process."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._last = '', -inf  # warning, and when [s]

    def info(self, message: str) -> None:
        """Tell what is as it should be."""
        self._send('info', message)

    def warning(self, message: str, *, throttle_duration_sec: float = 0.0) -> None:
        """Warn, of the same again only after a pause [s]."""
        now = monotonic()
        last, at = self._last
        if message != last or now - at >= throttle_duration_sec:
            self._last = message, now
            self._send('warning', message)

    def error(self, message: str) -> None:
        """Tell what has gone wrong."""
        self._send('error', message)

    def _send(self, level: str, text: str) -> None:
        content = topic_link.encode({'level': level, 'text': text})
        self._link.put(LOG, content)


def _is_live(_guard: Guard) -> bool:
    """Whether the robot does not wait: never, also if it is a simulated one."""
    return True
