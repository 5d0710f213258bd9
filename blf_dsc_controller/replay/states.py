# SPDX-License-Identifier: Apache-2.0
"""The joint states of a bag: those with telemetry of the law, or every message."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.content import Content, UnreadableMessageError, decode_joint_states
from blf_dsc_controller.messages.cdr import MessageError
from blf_dsc_controller.messages.topics import JOINT_STATES, LEARNING, REFERENCE, TRACKING_ERROR
from blf_dsc_controller.run import Floats, Stamps


class States(NamedTuple):
    """N joint states of n joints that the law uses."""

    stamp: Stamps  # (N,) ns, increasing
    measurement: Floats  # [q rad, dq rad/s, torque of the last interval N m] (N, 3 n)
    passed_over: int  # number of states that the law did not use

    @property
    def time(self) -> Floats:
        """Time since the first state (N,) [s], as the controller counts it."""
        return np.asarray((self.stamp - self.stamp[0]) * 1e-9)

    @property
    def duration(self) -> float:
        """Time from the first state to the last [s]."""
        return float(self.time[-1]) if self.stamp.size else 0.0


def law_states(content: Content, joints: Sequence[str]) -> States:
    """Return the states with telemetry of the law; all of them if the bag has no telemetry.

    `joints` are the names in the bag.

    Raises:
        UnreadableMessageError: a state cannot be decoded, or a joint is not in it.
    """
    stamp, values = decode_joint_states(content.topics[JOINT_STATES], joints)
    kept = stamp > np.maximum.accumulate(np.concatenate([[-1], stamp[:-1]]))
    sampled = sampled_stamps(content)
    if sampled is not None:
        kept &= np.isin(stamp, sampled)
        kept &= stamp < np.append(np.setdiff1d(sampled, stamp), np.iinfo(np.int64).max)[0]
    measurement = values[kept].reshape(-1, 3 * len(joints))
    return States(stamp[kept], measurement, int(np.count_nonzero(~kept)))


def sampled_stamps(content: Content) -> Stamps | None:
    """Stamps of the states with telemetry of the law; one topic may have what another lost."""
    stamps = [
        decode_joint_states(content.topics[topic], (), ())[0]
        for topic in (TRACKING_ERROR, REFERENCE, LEARNING)
        if topic in content.topics
    ]
    return np.unique(np.concatenate(stamps)) if stamps else None


class Arrivals(NamedTuple):
    """Every joint-state message of a bag, readable or not."""

    stamp: list[int]  # of each, ns; 0 for an unreadable message
    measurement: Floats  # (N, 3 n) as in `States`
    errors: Mapping[int, MessageError]  # why a message is unreadable, by its number


def arrivals(
    content: Content, joints: Sequence[str], required: Sequence[str], until: int
) -> Arrivals:
    """Decode every joint state that was received before `until` [ns].

    Raises:
        UnreadableMessageError: not one of them can be read.
    """
    recorded = content.topics[JOINT_STATES]
    count = bisect_left(recorded.received, until)
    recorded = replace(recorded, received=recorded.received[:count], raw=recorded.raw[:count])
    errors: dict[int, MessageError] = {}
    stamps, values = decode_joint_states(recorded, joints, required, errors)
    if len(errors) == count:
        raise UnreadableMessageError(recorded.name, 0, errors[0])
    return Arrivals(stamps.tolist(), values.reshape(count, -1), errors)
