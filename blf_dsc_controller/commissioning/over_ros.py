# SPDX-License-Identifier: Apache-2.0
"""Commissioning of a robot over ROS: each run is one of the controller's node.

Between two of them the node answers joint states with the safe torque, and what takes
longer than a sample is computed in another process: the arm is held all the time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.topic_recorder import TopicRecorder
from blf_dsc_controller.commissioning.commissioning import Commissioning
from blf_dsc_controller.commissioning.postures import (
    Answer,
    Given,
    PostureByPosture,
)
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.drive.loop import End
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import EventType, decode
from blf_dsc_controller.messages.topics import Topic
from blf_dsc_controller.nodes.run_by_run import RunByRunNode
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.supervisor import Phase, Reason

Floats = NDArray[np.float64]

# s without joint states, or anybody who takes torques: longer than the watchdog of the
# law waits, which is for stamps of the wall clock only
_PATIENCE = 10.0
_LOOK = 1.0  # s between looks whether somebody takes the torques
_SETTLING = 3.0  # s of the arm's time, to come to rest
_HELD = 'the arm is held until Ctrl-C: engage its brakes first'
_OTHERS = {
    EventType.TRAJECTORY: 'a trajectory was sent to the controller',
    EventType.TARGET: 'a position was sent to the controller',
    EventType.BRAKE: 'somebody called ~/stop',
    EventType.RESET: 'somebody called ~/reset',
    EventType.CONTACT: 'something touched the arm',
}


class _Disturbed:
    """An output that notes what changes a motion: a run with it shows nothing.

    Attributes:
        text: what it was; empty so far.
    """

    text = ''

    def write(self, _stamp: int, topic: Topic, raw: bytes) -> None:
        if topic in (topics.JOURNAL, topics.TARGETS) and not self.text:
            self.text = _OTHERS.get(decode(raw).type, '')


class OverRos(PostureByPosture):
    """A robot behind the topics of joint states and torques."""

    def __init__(
        self,
        node: RunByRunNode,
        spin: Callable[[], None],
        commissioning: Commissioning,
        folder: Path,
        worker: Executor,
    ) -> None:
        """Use a node, which `spin` lets work for a moment, and write bags into `folder`.

        `worker` computes beside the loop.
        """
        super().__init__(commissioning, folder)
        self._node = node
        self._spin = spin
        self._worker = worker
        self._others = 0  # publishers of torques, beside the node, since the first run
        self._looked = 0.0  # s, when there was the last look at who takes the torques

    def wait(self) -> None:
        """Wait until there are joint states, and somebody takes the torques.

        Raises BlfDscError if there are none, or nobody does, for ten seconds.
        """
        node = self._node
        end = time.monotonic() + _PATIENCE
        while node.position() is None:
            self._spin()
            if self._requests:
                raise KeyboardInterrupt
            if time.monotonic() < end:
                continue
            if not node.is_heard:
                raise BlfDscError(
                    f'nobody takes torques on {node.commands}: start the effort controller, or '
                    'name its topic with --commands'
                )
            raise BlfDscError(
                f'no joint states on {node.states}: start the driver, or name its topic with '
                '--states'
            )

    def hold_after(self) -> None:
        """Hold an arm whose drives do not until an end is requested."""
        if self._config.robot.drive_compensates != 'none':
            return
        self._node.warn(_HELD)
        while not self._requests:
            self._spin()

    def _positions(self) -> Floats:
        position = self._node.position()
        if position is None:
            raise BlfDscError(f'no joint states on {self._node.states}')
        return position

    def _pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._spin()

    def aside(
        self,
        compute: Callable[Given, Answer],
        *given: Given.args,
        **named: Given.kwargs,
    ) -> Answer:
        """Return the answer of a function that another process computes."""
        computed = self._worker.submit(compute, *given, **named)
        while not computed.done():
            self._spin()
        return computed.result()

    def _control(
        self, config: ControllerConfig, duration: float, bag: Path, name: str
    ) -> None:
        if self._requests:
            raise self._ended(name, End.REQUESTED, '', None)
        node = self._node
        if not node.guard or not node.guard.commanding:
            self._others = node.others
        recorder, disturbed = TopicRecorder(bag, in_background=True), _Disturbed()
        guard = node.begin(config, (recorder, disturbed))
        try:
            end, text = self._until_over(guard, disturbed, duration)
            self._come_to_rest(guard)
        finally:
            node.end(disturbed)
            node.end(recorder, recorder.close)
        if guard.starting.error is not None:
            raise BlfDscError(f'{name}: {guard.starting.error}')
        if end is not End.DURATION:
            raise self._ended(name, end, text, guard)
        if node.outputs.problem:
            raise self._not_whole(name)

    def _until_over(
        self, guard: Guard, disturbed: _Disturbed, duration: float
    ) -> tuple[End, str]:
        """Return why a run is over, and in words, if it was not planned."""
        began = time.monotonic()
        while True:
            self._spin()
            if self._requests:
                return End.REQUESTED, ''
            if trouble := self._stopped(guard) or self._look_for_loss(began):
                return trouble
            if text := disturbed.text or self._look_for_others():
                return End.STOPPED, text
            passed = (guard.journal.stamp - guard.reference.start_stamp) * NANOSECOND
            if guard.commanding and passed >= duration:
                return End.DURATION, ''

    def _stopped(self, guard: Guard) -> tuple[End, str] | None:
        """Return why the law is not in command any more."""
        supervisor = guard.supervisor
        if self._node.guard is not guard or supervisor.phase is Phase.INACTIVE:
            return End.REQUESTED, 'somebody deactivated the node'
        if supervisor.phase is not Phase.SAFE_STOP:
            return None
        is_lost = supervisor.reason is Reason.STATE_TIMEOUT
        return (End.LOST if is_lost else End.STOPPED), supervisor.text

    def _look_for_loss(self, began: float) -> tuple[End, str] | None:
        """Return what a run that began at `began` [s] lacks: joint states, or who takes torques."""
        node = self._node
        now = time.monotonic()
        silent = now - max(node.heard, began)
        if silent > _PATIENCE:
            return End.LOST, f'no joint states on {node.states} for {silent:.2g} s'
        if now - self._looked > _LOOK:
            self._looked = now
            if not node.is_heard:
                return End.LOST, f'nobody takes torques on {node.commands}'
        return None

    def _look_for_others(self) -> str:
        """Return that there are more other publishers of torques than before; or empty.

        One that was killed stays visible for some time.
        """
        node = self._node
        self._others = min(self._others, node.others)
        if node.others == self._others:
            return ''
        return f'another node publishes torques on {node.commands}, too'

    def _come_to_rest(self, guard: Guard) -> None:
        """Let the node hold the arm, until it rests or its time is over."""
        if guard.supervisor.uses_states and self._node.guard is guard:
            self._node.deactivate()
        since = guard.journal.stamp
        while guard.commanding and not guard.is_settled and self._requests < 2:
            self._spin()
            is_late = (guard.journal.stamp - since) * NANOSECOND > _SETTLING
            if is_late or time.monotonic() - self._node.heard > _PATIENCE:
                return
