# SPDX-License-Identifier: Apache-2.0
"""A motion as a file has it, a bag or a table: what is checked of it, and its even samples.

Positions in degrees are told from those in rad by how far and how fast the joints would
turn.  In degrees, a joint seems 57 times as fast: one that moves with 6 % of its speed
limit seems to exceed it three times.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.bad_values import (
    extremes,
    stand_ins,
    unrecorded,
)
from blf_dsc_controller.identification.recording import (
    GAP,
    LONGEST_PERIOD,
    TURN,
    Flags,
    Indices,
    Recording,
    interpolated,
)
from blf_dsc_controller.run import Floats, Stamps

_JITTER = 1.2  # times `LONGEST_PERIOD`, median that is accepted
_LEAST_PERIOD = 1e-5  # s, likewise
_FEWEST = 10  # states
_SPARSE = 100.0  # times the intervals between states: longest bag
_BEYOND = 2.0  # times what a joint reaches, and at least turns: no angle in rad
_FAST = 3.0  # times its limit: no speed of most joints in rad/s
_SHARE = 0.9  # of the time, in which joints are slower than the speed that is compared
_FASTEST = 10.0  # rad/s, largest limit of a joint, also where none is stated
_STILL = 0.01  # rad/s
_STEP = 0.05  # s, over which speeds are means
_SHORTEST = 1.0  # s, motion whose speeds are looked at


class Group(NamedTuple):
    """Values (N, n) of one kind as a file has them, and how it names them."""

    values: Floats
    names: Sequence[str]
    factors: Floats  # (n,) to rad, N m, or m, N

    @property
    def scaled(self) -> Floats:
        """The values in rad, N m, or m, N."""
        if (self.factors == 1.0).all():
            return self.values  # as in `Motion.select`
        return self.values * self.factors


class Motion(NamedTuple):
    """N states of n joints as a file has them; unknown values are NaN."""

    path: Path
    joints: Sequence[str]
    stamp: Stamps  # (N,) ns
    q: Group
    tau: Group
    theta: Group | None  # of the motors
    unit: str  # `q=` and the columns, to which a unit can be added; empty: it was given
    others: str  # what to do to get other torques
    source: str  # of the torques: a topic, or columns of a table
    said: Sequence[str] = ()  # of what is odd
    currents: bool = False  # by the names or units of the torques

    def select(self, rows: Flags) -> Motion:
        """Return the states of some rows (N,)."""
        if rows.all():
            return self  # a long motion is not copied
        theta = self.theta
        return self._replace(
            stamp=self.stamp[rows],
            q=self.q._replace(values=self.q.values[rows]),
            tau=self.tau._replace(values=self.tau.values[rows]),
            theta=theta and theta._replace(values=theta.values[rows]),
        )


def recording_of(motion: Motion, tree: Tree) -> Recording:
    """Return the sound states of a motion as a recording, in rad and N m.

    It is sampled evenly, interpolated over uneven stamps and up to two lost states.  Positions
    of joints that turn may be wrapped to one turn.

    Raises:
        BlfDscError: positions or torques cannot be what they are said to be, or there are
            too few.
    """
    sound = checked(motion, tree)
    joints = tuple(sound.joints)
    turning = tree.turning(joints)
    stamp = sound.stamp
    groups = [
        each.scaled for each in (sound.q, sound.tau, sound.theta) if each is not None
    ]
    order = _order(stamp, groups)
    if not np.array_equal(order, np.arange(stamp.size)):
        stamp = stamp[order]
        groups = [each[order] for each in groups]
    q, torque, *motors = groups
    source = '; '.join([sound.source, *sound.said])
    time, even, period, gap = _grid_of(stamp)
    turns = _turns(q, turning)
    if turns.any():
        q = q + TURN * turns
        names = ', '.join(np.array(joints)[turns.any(axis=0)])
        source = f'{source} (positions of {names} are wrapped: full turns added)'
    twist = None
    if motors:
        twist = interpolated(even, time, _twist(q, motors[0], turning))
    q, torque = (interpolated(even, time, each) for each in (q, torque))
    return Recording(joints, period, q, torque, gap, source, sound.currents, twist)


def _order(stamp: Stamps, groups: Sequence[Floats]) -> Indices:
    """Return the rows in which all values are known, each stamp once, in their order."""
    known = [np.isfinite(each).all(axis=1) for each in groups]
    order = np.flatnonzero(np.all(known, axis=0))
    return order[np.unique(stamp[order], return_index=True)[1]]


def _turns(q: Floats, turning: Flags) -> Floats:
    """Return the full turns (N, n) that the encoders of joints have left out.

    From one state to the next, a joint turns by less than half a turn.  A larger step is
    the end of the encoder's range.
    """
    turns = np.diff(q, axis=0, prepend=q[:1])
    turns /= -TURN
    np.round(turns, out=turns)
    turns *= turning
    return np.cumsum(turns, axis=0, out=turns)


def _grid_of(stamp: Stamps) -> tuple[Floats, Floats, float, Flags]:
    """Return the times [s] of states at these stamps, which increase, and even ones.

    Also the period of the latter [s], and whether nothing was recorded at each.

    Raises:
        BlfDscError: there are too few, or they cannot be of one clock.
    """
    if stamp.size < _FEWEST:
        raise BlfDscError(
            f'there are {stamp.size} joint state(s) with a position, a torque and a unique '
            'stamp; hundreds are needed'
        )
    time = (stamp - stamp[0]) * 1e-9
    intervals = np.diff(time)
    period = float(np.median(intervals))
    if period > _JITTER * LONGEST_PERIOD:
        raise BlfDscError(
            f'the joint states are {period:.3g} s apart; at least one in {LONGEST_PERIOD:g} s is '
            f'needed: record them at {1.0 / LONGEST_PERIOD:.0f} Hz or more'
        )
    if period < _LEAST_PERIOD or time[-1] > _SPARSE * period * time.size:
        raise BlfDscError(
            f'{time.size} joint states are {period:.3g} s apart, but the last one comes '
            f'{time[-1]:.3g} s after the first: are their stamps of one clock? Cut the recording '
            'where they jump'
        )
    even = np.arange(0.0, time[-1], period)
    gap = (intervals > GAP * period)[np.searchsorted(time, even, side='right') - 1]
    return time, even, period, gap


def _twist(links: Floats, motors: Floats, turning: Flags) -> Floats:
    """Return motors minus links (N, n), without what their zeros differ by, and full turns."""
    twist = motors - links
    twist -= np.median(twist, axis=0)
    twist -= TURN * np.round(twist / TURN) * turning
    return twist


def checked(motion: Motion, tree: Tree) -> Motion:
    """Return the sound rows of a motion, with what to say of the others.

    Raises:
        BlfDscError: positions or torques cannot be what they are said to be.
    """
    missing = np.zeros(motion.stamp.size, dtype=bool)
    said = list(motion.said)
    for group in (motion.q, motion.tau, motion.theta):
        if group is not None:
            _check_known(motion, group)
            rows, found = stand_ins(group.values, group.names)
            missing |= rows
            said += [f'{each}, read as missing' for each in found]
    known = motion.select(~missing)
    if motion.unit:
        _check_angles(known, tree)
        _check_speeds(known, tree)
    _check_torques(known)
    zeros = unrecorded(motion.tau.values)
    if zeros.any():
        said.append(f'torques are exactly 0 in {zeros.sum()} row(s), read as missing')
    return motion.select(~(missing | zeros))._replace(said=said)


def _check_known(motion: Motion, group: Group) -> None:
    """Raise BlfDscError if a column has no numbers."""
    least, most = extremes(group.values)
    empty = np.flatnonzero(least > most)
    if empty.size:
        raise BlfDscError(
            f'{motion.path}: {group.names[int(empty[0])]} has no numbers: {motion.others}'
        )


def _check_angles(motion: Motion, tree: Tree) -> None:
    """Raise BlfDscError if positions are far beyond what the joints can reach."""
    reach = np.where(tree.turning(motion.joints), tree.reaches(motion.joints), np.inf)
    least, most = extremes(motion.q.values)
    found = np.maximum(-least, most) * motion.q.factors
    beyond = np.flatnonzero(found > _BEYOND * np.maximum(reach, TURN))
    if beyond.size:
        k = int(beyond[0])
        raise BlfDscError(
            f'{motion.path}: {motion.q.names[k]} goes to {found[k]:.3g} rad, but '
            f'{motion.joints[k]} turns by at most {reach[k]:.3g} rad. {_units(motion)}'
        )


def _check_speeds(motion: Motion, tree: Tree) -> None:
    """Raise BlfDscError if most joints that turn are far faster than they can be."""
    speed = _speeds(motion)
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


def _speeds(motion: Motion) -> Floats:
    """Return the speed (n,) that each joint exceeds in the rest of the time [rad/s, m/s]."""
    rows = np.argsort(motion.stamp, kind='stable')
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
    return np.quantile(known, _SHARE, axis=0)


def _check_torques(motion: Motion) -> None:
    """Raise BlfDscError if torques are the same in all rows, or the positions."""
    q, tau = motion.q.values, motion.tau.values
    least, most = extremes(q)
    if (least == most).all():
        return  # so are the torques of an arm that does not move
    least, most = extremes(tau)
    same = np.flatnonzero(least == most).tolist()
    if same:
        listed = ', '.join(motion.tau.names[k] for k in same)
        moved = ', '.join(motion.joints[k] for k in same)
        raise BlfDscError(
            f'{motion.path}: {listed}: {least[same[0]]:g} in all rows, so the torque of '
            f'{moved} was not recorded there: {motion.others}'
        )
    unknown = ~(np.isfinite(q) & np.isfinite(tau))
    copied = np.flatnonzero(((q == tau) | unknown).all(axis=0))
    if copied.size:
        k = int(copied[0])
        raise BlfDscError(
            f'{motion.path}: {motion.tau.names[k]} is {motion.q.names[k]} in all rows, so it is '
            f'no torque: {motion.others}'
        )
