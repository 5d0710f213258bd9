# SPDX-License-Identifier: Apache-2.0
"""The joint states of a bag that the controller answered, as it took them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from blf_dsc_controller.bags.batch import decode_joint_states
from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.run import Floats, Stamps
from blf_dsc_controller.bags.topics import JOINT_STATES, LEARNING, REFERENCE, TRACKING_ERROR

_TOLD_OF_EACH = (TRACKING_ERROR, REFERENCE, LEARNING)


@dataclass(frozen=True)
class States:
    """N answered states of n joints.

    Attributes:
        stamp: (N,) [ns], increasing.
        measurement: [q (n,) rad, dq (n,) rad/s, torque of the last interval (n,) N m] (N, 3 n).
        passed_over: states that were not answered: repeated, or overtaken by the next.
        lost: stamp [ns] of the first state that was answered but is not in the bag; the law's
            state cannot be told from there on, and the states end before it.
    """

    stamp: Stamps
    measurement: Floats
    passed_over: int = 0
    lost: int | None = None

    def until(self, stamp: int) -> States:
        """The states before a stamp [ns]."""
        kept = self.stamp < stamp
        return replace(self, stamp=self.stamp[kept], measurement=self.measurement[kept])

    @property
    def time(self) -> Floats:
        """Time since the first state (N,) [s], as the controller counts it."""
        return np.asarray((self.stamp - self.stamp[0]) * 1e-9)

    @property
    def duration(self) -> float:
        """Time from the first state to the last [s]."""
        return float(self.time[-1])


def answered_states(
    content: Content, joints: Sequence[str], required: Sequence[str] = ('position', 'velocity')
) -> States:
    """Take the answered states from a bag; all of them, if its telemetry does not tell which.

    Args:
        content: of the bag.
        joints: the n names that they have in the bag.
        required: fields that the controller asks for.

    Raises:
        UnreadableMessageError: a state cannot be decoded, or a joint is not in it.
    """
    stamp, values = decode_joint_states(content.topics[JOINT_STATES], joints, required)
    increasing = stamp > np.maximum.accumulate(np.concatenate([[-1], stamp[:-1]]))
    told = _told(content)
    kept = increasing if told is None else increasing & np.isin(stamp, told)
    lost = None
    if told is not None:
        absent = np.setdiff1d(told, stamp)
        lost = int(absent[0]) if absent.size else None
    if lost is not None:
        kept &= stamp < lost
    passed_over = int(np.count_nonzero(~kept)) if lost is None else 0
    return States(stamp[kept], values[kept].reshape(-1, 3 * len(joints)), passed_over, lost)


def _told(content: Content) -> Stamps | None:
    """Stamps of the states that the controller tells of; one topic may have what another lost."""
    told = [
        decode_joint_states(content.topics[topic], (), ())[0]
        for topic in _TOLD_OF_EACH
        if topic in content.topics
    ]
    return np.unique(np.concatenate(told)) if told else None
