# SPDX-License-Identifier: Apache-2.0
"""Recordings from bags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.bags.content import NO_NAMES, NameMap, read_content
from blf_dsc_controller.bags.reader import applied_torque, single_run
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import Values
from blf_dsc_controller.identification.on_disk import blocks_of
from blf_dsc_controller.identification.recording import Recording, resampled
from blf_dsc_controller.messages.topics import JOINT_STATES


def read_bag(
    path: Path,
    text: str,
    joints: Sequence[str] = (),
    namespace: str = '',
    names: NameMap = NO_NAMES,
    commanded: bool = False,  # noqa: FBT001, FBT002 - the last of a list
) -> Recording:
    """Read joint states with efforts, or else (or if `commanded`) commanded torques, from any bag.

    `text` is the URDF; `joints` are the arm's, from its base to its tip, by default all
    in the bag up to where the arm branches; `namespace` and `names` are as for
    `read_run`.

    Raises:
        BlfDscError: the bag cannot be read, has no torques or too few states, or has the joints
            of no arm.
    """
    content = read_content(path, namespace, names)
    named = content.topics[JOINT_STATES].name_lists()
    joints = tuple(joints) or _arm_joints(text, set().union(*named), names)
    theirs = names.joints_of(joints)
    states, _, _ = single_run(content, theirs)
    torque = states.field(2)
    source = f'effort of {content.topics[JOINT_STATES].name}'
    if commanded or not _any(torque, states.size):
        source, applied = applied_torque(content, states)
        torque = applied.field(2)
        if not _any(torque, states.size):
            raise BagError(
                f'{path}: all torques in the {source} are zero: record measured efforts'
            )
    return resampled(joints, states.stamp, states.field(0), torque, source)


def _any(values: Values, size: int) -> bool:
    """Return whether one of the values in so many rows is known and not zero."""
    return any(np.nan_to_num(values[rows]).any() for rows in blocks_of(size))


def _arm_joints(text: str, in_bag: set[str], names: NameMap) -> tuple[str, ...]:
    """Return the joints of the arm: from the root of the URDF to the last that the bag has."""
    ours = in_bag | {our for our, their in names.joints.items() if their in in_bag}
    arm = Tree.of(text).trunk()
    while arm and arm[-1] not in ours:
        arm = arm[:-1]
    if not arm:
        raise BagError(
            f'the bag has no joint of the URDF; it names {", ".join(sorted(in_bag))}: choose an '
            "arm with --tip, or give the bag's names, as in --map joint1=shoulder"
        )
    return arm
