# SPDX-License-Identifier: Apache-2.0
"""The call by which a node caused an event of its journal, to be made again in a replay.

Events that no call of the guard caused, such as a contact, are not among them.  Neither
are those whose replay needs more than a call: `rerun` has them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.reference.retargeting import Target
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryPoint
from blf_dsc_controller.supervision.guard import Guard

Content = Mapping[str, Any]


def _take_over_from(guard: Guard, content: Content) -> None:
    guard.starting.take_over_from(np.array(content['torque']))


def _prepare(guard: Guard, content: Content) -> None:
    guard.starting.prepare(np.array(content['positions']))


def _follow_trajectory(guard: Guard, content: Content) -> None:
    points = tuple(TrajectoryPoint(**point) for point in content['points'])
    trajectory = Trajectory(tuple(content['joints']), points, content['begin'])
    guard.motions.adopt(guard.motions.plan(trajectory, content['at']))


def _follow_target(guard: Guard, content: Content) -> None:
    target = Target(**{name: content[name] for name in Target._fields})
    guard.motions.adopt(guard.motions.plan(target, content['at']))


def _declare_load(guard: Guard, content: Content) -> None:
    guard.take_over(TipLoad(content['mass'], tuple(content['centre'])))


def _expect_load(guard: Guard, content: Content) -> None:
    load = TipLoad(content['mass'], tuple(content['centre']))
    guard.expect_load(load, content['interval'])


GUARD_CALLS: dict[EventType, Callable[[Guard, Content], object]] = {
    EventType.ACTIVATE: lambda guard, _: guard.starting.activate(),
    EventType.RESET: lambda guard, _: guard.starting.reset(),
    EventType.DEACTIVATE: lambda guard, _: guard.deactivate(),
    EventType.TAKEOVER: _take_over_from,
    EventType.PREPARE: _prepare,
    EventType.WITHDRAW: lambda guard, content: guard.withdraw(content['text']),
    EventType.TRAJECTORY: _follow_trajectory,
    EventType.TARGET: _follow_target,
    EventType.BRAKE: lambda guard, _: guard.motions.brake(),
    EventType.TARE: lambda guard, _: guard.findings.tare(),
    EventType.DRIVE_LOAD: _declare_load,
    EventType.EXPECTED_LOAD: _expect_load,
}
"""For each event, the call of a guard with the event's content.

Each raises what the guard raises, a BlfDscError.
"""
