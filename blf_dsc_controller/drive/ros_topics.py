# SPDX-License-Identifier: Apache-2.0
"""The controller's topics, in a process for which the loop never waits.

The process (`nodes/topics_process.py`) has the name, the topics and `~/stop` of the
node.  If it ends or hangs, the loop goes on without.
"""

from __future__ import annotations

from time import monotonic

from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.control.status_report import StatusReport
from blf_dsc_controller.drive.beside import Beside
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topic_link, topics
from blf_dsc_controller.messages.link import LinkedProcess
from blf_dsc_controller.messages.strings import encode_string
from blf_dsc_controller.messages.topic_link import KINDS, OF_LOOP, READY, STATUS, STOP
from blf_dsc_controller.messages.topics import Topic
from blf_dsc_controller.supervision.guard import Guard

_PROCESS = 'blf_dsc_controller.nodes.topics_process'
_START = 30.0  # s, for ROS to start
_END = 10.0  # s, for its last messages
_STATUS_PERIOD = 1.0  # s


class RosTopics(Beside):
    """The topics of a controller that runs in a loop without ROS.

    It takes the messages of the loop, and passes on trajectories, targets and stops.

    Attributes:
        problem: why there are no topics any more, or how many messages were lost; or empty.
    """

    def __init__(self, controller: ArmController, namespace: str = '') -> None:
        """Start the process, with the names in a namespace, and wait for ROS.

        Raises:
            BlfDscError: it did not start.
        """
        config = controller.config
        self._ros = LinkedProcess(_PROCESS, f'/{namespace.strip("/")}', *config.joints)
        super().__init__(self._ros, controller)
        self._report = StatusReport(self.log)
        self._report.trajectories = self._inputs
        self._late = ''
        self._reported = -1.0, -1  # s, and revision of the state
        self._await_ros()
        if config.robot.urdf:
            description = encode_string(config.robot.text)
            self._link.put(KINDS[topics.ROBOT_DESCRIPTION], description)
        controller.add_output(self)

    @property
    def problem(self) -> str:
        """Why there are no topics any more, or the number of lost messages."""
        if self._link.broken:
            return 'ROS ended before the loop, which went on without its topics'
        if self._link.lost:
            return f'ROS did not take {self._link.lost} messages in time: they were dropped'
        return self._late

    def write(self, _stamp: int, topic: Topic, raw: bytes) -> None:
        """Publish a serialised message, or drop it."""
        if topic in OF_LOOP:
            self._link.put(KINDS[topic], raw)

    def close(self) -> None:
        """Publish what waits, and end the process."""
        if not self._link.broken:
            self._tell_status(self._guard)
        end = monotonic() + _END
        self._link.close(_END)
        if not self._ros.await_end(max(end - monotonic(), 0.0)):
            self._late = 'ROS did not take the last messages'

    def _take(self, kind: int, content: bytes) -> None:
        if kind == STOP:
            number = topic_link.decode(content)
            answer = [number, self._inputs.take_stop()]
            self._link.put(STOP, topic_link.encode(answer))
        elif kind == KINDS[topics.JOINT_TRAJECTORY]:
            self._inputs.take_trajectory(content)
        elif kind == KINDS[topics.JOINT_POSITIONS]:
            self._inputs.take_positions(content)

    def _tell_changes(self) -> None:
        """Tell the status every second, and when the state changes."""
        guard = self._guard
        since, revision = self._reported
        now = monotonic()
        if now - since > _STATUS_PERIOD or guard.supervisor.revision != revision:
            self._reported = now, guard.supervisor.revision
            self._tell_status(guard)

    def _tell_status(self, guard: Guard) -> None:
        parts = [
            (
                name,
                level[0],
                message,
                {key: f'{value}' for key, value in values.items()},
            )
            for name, level, message, values in self._report.parts('active', guard)
        ]
        status = {'revision': guard.supervisor.revision, 'parts': parts}
        self._link.put(STATUS, topic_link.encode(status))

    def _await_ros(self) -> None:
        """Wait until the topics exist."""
        end = monotonic() + _START
        while monotonic() < end and not self._link.broken:
            self._link.wait(0.1)
            if any(kind == READY for kind, _ in self._link.messages()):
                return
        self._ros.await_end(0.0)
        raise BlfDscError(
            'ROS did not start: see above; without --ros the robot is controlled without topics'
        )
