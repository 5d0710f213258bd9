# SPDX-License-Identifier: Apache-2.0
"""The joint states of a bag that the law used."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blf_dsc_controller.bags.content import Content
from blf_dsc_controller.bags.topic_messages import JointStates
from blf_dsc_controller.messages.topics import JOINT_STATES, LEARNING, REFERENCE, TRACKING_ERROR
from blf_dsc_controller.run import Stamps


def law_states(content: Content, joints: Sequence[str]) -> JointStates:
    """Return the states with telemetry of the law, or all whose stamps increase if there is none.

    `joints` are the names in the bag.

    Raises:
        UnreadableMessageError: a state cannot be decoded, or a joint is not in it.
    """
    states = content.topics[JOINT_STATES].joint_states(joints)
    stamp = states.stamp
    kept = stamp > np.maximum.accumulate(np.concatenate([[-1], stamp[:-1]]))
    sampled = sampled_stamps(content)
    if sampled is not None:
        kept &= np.isin(stamp, sampled)
        kept &= stamp < np.append(np.setdiff1d(sampled, stamp), np.iinfo(np.int64).max)[0]
    return states.select(kept)


def sampled_stamps(content: Content) -> Stamps | None:
    """Return the stamps of states with telemetry of the law; a topic may hold what another lost."""
    stamps = [
        content.topics[topic].joint_states((), ()).stamp
        for topic in (TRACKING_ERROR, REFERENCE, LEARNING)
        if topic in content.topics
    ]
    return np.unique(np.concatenate(stamps)) if stamps else None
