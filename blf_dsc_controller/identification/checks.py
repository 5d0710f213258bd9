# SPDX-License-Identifier: Apache-2.0
"""What is checked of a motion as a file has it, a bag or a table, before it is resampled.

Positions in degrees are told from those in rad by how far and how fast the joints would
turn.  In degrees, a joint seems 57 times as fast: one that moves with 6 % of its speed
limit seems to exceed it three times.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.bad_values import (
    Column,
    extremes,
    stand_ins,
    unrecorded,
)
from blf_dsc_controller.identification.on_disk import blocks_of
from blf_dsc_controller.identification.turns import TURN
from blf_dsc_controller.run import Floats, Stamps

_BEYOND = 2.0  # times what a joint reaches, and at least turns: no angle in rad
_FAST = 3.0  # times its limit: no speed of most joints in rad/s
_SHARE = 0.9  # of the time, in which joints are slower than the speed that is compared
_FASTEST = 10.0  # rad/s, largest limit of a joint, also where none is stated
_STILL = 0.01  # rad/s
_STEP = 0.05  # s, over which speeds are means
_SHORTEST = 1.0  # s, motion whose speeds are looked at


class Group(NamedTuple):
    """Values (N, n) of one kind as a file has them, and how it names them."""

    values: Column
    names: Sequence[str]
    factors: Floats  # (n,) to rad, N m, or m, N


class Motion(NamedTuple):
    """N states of n joints as a file has them."""

    path: Path
    joints: Sequence[str]
    stamp: Stamps  # (N,) ns
    q: Group
    tau: Group
    theta: Group | None  # of the motors
    unit: str  # `q=` and the columns, to which a unit can be added; empty: it was given
    others: str  # what to do to get other torques


class Sound(NamedTuple):
    """Which rows (N,) have all values, and what to say of the others."""

    rows: NDArray[np.bool_]
    said: list[str]


def checked(motion: Motion, tree: Tree) -> Sound:
    """Return which rows of a motion are sound.

    Raises:
        BlfDscError: positions or torques cannot be what they are said to be.
    """
    size = motion.stamp.size
    missing = np.zeros(size, dtype=bool)
    said = []
    for group in (motion.q, motion.tau, motion.theta):
        if group is not None:
            _check_known(motion, group)
            rows, found = stand_ins(group.values, size, group.names)
            missing |= rows
            said += [f'{each}, read as missing' for each in found]
    if motion.unit:
        _check_angles(motion, ~missing, tree)
        _check_speeds(motion, ~missing, tree)
    _check_torques(motion, motion.tau, ~missing)
    zeros = unrecorded(motion.tau.values, size)
    if zeros.any():
        said.append(f'torques are exactly 0 in {zeros.sum()} row(s), read as missing')
    missing |= zeros
    return Sound(~missing, said)


def _check_known(motion: Motion, group: Group) -> None:
    """Raise BlfDscError if a column has no numbers."""
    known = extremes(group.values, np.ones(motion.stamp.size, dtype=bool))
    empty = np.flatnonzero(known.least > known.most)
    if empty.size:
        raise BlfDscError(
            f'{motion.path}: {group.names[int(empty[0])]} has no numbers: {motion.others}'
        )


def _check_angles(motion: Motion, rows: NDArray[np.bool_], tree: Tree) -> None:
    """Raise BlfDscError if positions are far beyond what the joints can reach."""
    reach = np.where(tree.turning(motion.joints), tree.reaches(motion.joints), np.inf)
    found = extremes(motion.q.values, rows).largest * motion.q.factors
    beyond = np.flatnonzero(found > _BEYOND * np.maximum(reach, TURN))
    if beyond.size:
        k = int(beyond[0])
        raise BlfDscError(
            f'{motion.path}: {motion.q.names[k]} goes to {found[k]:.3g} rad, but '
            f'{motion.joints[k]} turns by at most {reach[k]:.3g} rad. {_units(motion)}'
        )


def _check_speeds(motion: Motion, rows: NDArray[np.bool_], tree: Tree) -> None:
    """Raise BlfDscError if most joints that turn are far faster than they can be."""
    speed = _speeds(motion, np.flatnonzero(rows))
    limit = np.minimum(tree.velocities(motion.joints), _FASTEST)
    moving = np.flatnonzero(tree.turning(motion.joints) & (speed > _STILL))
    ratio = speed[moving] / limit[moving]
    if moving.size and np.median(ratio) > _FAST:
        k = int(moving[np.argmax(ratio)])
        raise BlfDscError(
            f'{motion.path}: {motion.q.names[k]} is faster than {speed[k]:.3g} rad/s in a tenth of '
            f'the time, but {motion.joints[k]} reaches {limit[k]:.3g} rad/s, and so it is with '
            f'most joints. {_units(motion)}'
        )


def _units(motion: Motion) -> str:
    return (
        f"If it is in degrees: --map '{motion.unit}[deg]'; if it is in rad nevertheless: --map "
        f"'{motion.unit}[rad]'"
    )


def _speeds(motion: Motion, rows: NDArray[np.intp]) -> Floats:
    """Return the speed (n,) that each joint exceeds in the rest of the time [rad/s, m/s]."""
    rows = rows[np.argsort(motion.stamp[rows], kind='stable')]
    time = (motion.stamp[rows] - motion.stamp[rows[:1]]) * 1e-9
    if time.size < 2 or time[-1] < _SHORTEST:
        return np.zeros(len(motion.joints))
    at = np.flatnonzero(np.diff(np.floor(time / _STEP), prepend=-1.0))
    q = motion.q.values[rows[at]] * motion.q.factors
    steps = np.diff(q, axis=0)
    steps -= TURN * np.round(steps / TURN)  # of positions that wrap
    steps = np.abs(steps) / np.diff(time[at])[:, None]
    known = steps[np.isfinite(steps).all(axis=1)]
    if not len(known):
        return np.zeros(len(motion.joints))
    return np.asarray(np.quantile(known, _SHARE, axis=0))


def _check_torques(motion: Motion, tau: Group, rows: NDArray[np.bool_]) -> None:
    """Raise BlfDscError if torques are the same in all rows, or the positions."""
    if extremes(motion.q.values, rows).are_same.all():
        return  # so are the torques of an arm that does not move
    found = extremes(tau.values, rows)
    same = [int(k) for k in np.flatnonzero(found.are_same)]
    if same:
        listed = ', '.join(tau.names[k] for k in same)
        moved = ', '.join(motion.joints[k] for k in same)
        raise BlfDscError(
            f'{motion.path}: {listed}: {found.least[same[0]]:g} in all rows, so the torque of '
            f'{moved} was not recorded there: {motion.others}'
        )
    copied = np.flatnonzero(_are_positions(motion, tau))
    if copied.size:
        k = int(copied[0])
        raise BlfDscError(
            f'{motion.path}: {tau.names[k]} is {motion.q.names[k]} in all rows, so it is no '
            f'torque: {motion.others}'
        )


def _are_positions(motion: Motion, tau: Group) -> NDArray[np.bool_]:
    """Return which torques (n,) are the positions of their joints in all rows."""
    found = np.ones(len(motion.joints), dtype=bool)
    for at in blocks_of(motion.stamp.size):
        q, torque = motion.q.values[at], tau.values[at]
        unknown = ~(np.isfinite(q) & np.isfinite(torque))
        found &= ((q == torque) | unknown).all(axis=0)
        if not found.any():
            break
    return found
