# SPDX-License-Identifier: Apache-2.0
"""Input of the identification: positions and torques of an arm's joints, evenly sampled.

Velocities are not read: those of a driver lag behind its positions, usually by an unknown time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.urdf import chain_joints, moving_joints
from blf_dsc_controller.bags.content import NO_NAMES, NameMap, read_content
from blf_dsc_controller.bags.reader import one_run
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.torque import applied_torque
from blf_dsc_controller.messages.topics import JOINT_STATES
from blf_dsc_controller.run import Floats, Stamps

_SLOWEST = 0.02  # s between states
_GAP = 3.0  # intervals between two states


class Recording(NamedTuple):
    """N samples of n joints, a period apart."""

    joints: tuple[str, ...]
    period: float  # s
    q: Floats  # (N, n) rad, or m
    torque: Floats  # (N, n) N m, or N
    gap: NDArray[np.bool_]  # (N,) whether nothing was recorded here
    source: str  # topic of the torques


def read_recording(
    path: Path,
    text: str,
    joints: Sequence[str] = (),
    namespace: str = '',
    names: NameMap = NO_NAMES,
    commanded: bool = False,  # noqa: FBT001, FBT002 - the last of a list
) -> Recording:
    """Read joint states with efforts, or else (or if `commanded`) commanded torques, from any bag.

    `text` is the URDF; `joints` are the arm's, from its base to its tip, by default all in the bag
    up to where the arm branches; `namespace` and `names` are as for `what_if`.

    Raises:
        BlfDscError: the bag cannot be read, has no torques or too few states, or has the joints
            of no arm.
    """
    content = read_content(path, namespace, names)
    named = content.topics[JOINT_STATES].name_lists()
    joints = tuple(joints) or _arm_joints(text, set().union(*named), names)
    theirs = names.joints_of(joints)
    states, _, _ = one_run(content, theirs)
    torque, source = states.field(2), f'effort of {content.topics[JOINT_STATES].name}'
    if commanded or not np.nan_to_num(torque).any():
        applied = applied_torque(content, states)
        torque, source = applied.at(), applied.source
        if not np.nan_to_num(torque).any():
            raise BagError(f'{path}: all torques in the {source} are zero: record measured efforts')
    return _resampled(joints, states.stamp, states.field(0), torque, source)


def _arm_joints(text: str, in_bag: set[str], names: NameMap) -> tuple[str, ...]:
    """Return the joints of the arm: from the root of the URDF as far as the bag has them.

    Where it branches, as into fingers, the arm is the only branch with several joints in the bag.
    """
    ours = in_bag | {our for our, their in names.joints.items() if their in in_bag}
    paths = []
    for joint in moving_joints(text):
        base, tip, _ = chain_joints(text, '', '', (joint,))
        paths.append(chain_joints(text, base, tip, ())[2])
    arm: tuple[str, ...] = ()
    while True:
        beyond = [path for path in paths if path[: len(arm)] == arm and path != arm]
        branches = {path[len(arm)] for path in beyond}
        counts = Counter(path[len(arm)] for path in beyond if path[-1] in ours)
        least = 1 if len(branches) == 1 else 2
        followed = [joint for joint, count in counts.items() if count >= least]
        if len(followed) != 1:
            break
        arm = (*arm, followed[0])
    if not arm:
        found = f'joints of {len(followed)} arms' if followed else 'no joint of the URDF'
        raise BagError(
            f'the bag has {found}; it names {", ".join(sorted(in_bag))}: choose an arm with --tip, '
            "or give the bag's names, as in --map joint1=shoulder"
        )
    return arm


def _resampled(
    joints: tuple[str, ...], stamp: Stamps, q: Floats, torque: Floats, source: str
) -> Recording:
    """Resample evenly, interpolating over uneven stamps and up to two lost states."""
    known = np.isfinite(np.column_stack((q, torque))).all(axis=1)
    stamp, order = np.unique(stamp[known], return_index=True)
    q, torque = q[known][order], torque[known][order]
    if stamp.size < 2:
        raise BagError(
            f'the bag has {stamp.size} joint state(s) with a position, a torque and a unique '
            'stamp; hundreds are needed'
        )
    time = (stamp - stamp[0]) * 1e-9
    intervals = np.diff(time)
    period = float(np.median(intervals))
    if period > _SLOWEST:
        raise BagError(
            f'the joint states are {period:.3g} s apart; at least one in {_SLOWEST:g} s is needed'
        )
    grid = np.arange(0.0, time[-1], period)
    gap = (intervals > _GAP * period)[np.searchsorted(time, grid, side='right') - 1]
    at_grid = [
        np.transpose([np.interp(grid, time, column) for column in values.T])
        for values in (q, torque)
    ]
    return Recording(joints, period, at_grid[0], at_grid[1], gap, source)


def joined(first: Recording, second: Recording) -> tuple[Recording, float]:
    """Return two recordings with a gap between them as one, and the time [s] of the second."""
    times = np.arange(second.q.shape[0]) * second.period
    grid = np.arange(0.0, times[-1], first.period)
    q, torque = (
        np.transpose([np.interp(grid, times, column) for column in values.T])
        for values in (second.q, second.torque)
    )
    gap = np.interp(grid, times, second.gap) > 0.0
    gap[0] = True
    together = first._replace(
        q=np.vstack((first.q, q)),
        torque=np.vstack((first.torque, torque)),
        gap=np.append(first.gap, gap),
        source=f'{first.source}, {second.source}',
    )
    return together, first.q.shape[0] * first.period
