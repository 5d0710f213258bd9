# SPDX-License-Identifier: Apache-2.0
"""Recordings from bags."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.reader import applied_torque, single_run
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import JointStates, TopicMessages, Values
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.bad_values import stand_ins
from blf_dsc_controller.identification.checks import Group, Motion, checked
from blf_dsc_controller.identification.columns import beginning
from blf_dsc_controller.identification.on_disk import blocks_of
from blf_dsc_controller.identification.recording import (
    GAP,
    Recording,
    Rows,
    interpolated,
    resampled,
)
from blf_dsc_controller.identification.units import factor_of, is_of_drive
from blf_dsc_controller.messages.topics import JOINT_STATES, MOTOR_STATES
from blf_dsc_controller.run import Floats, Stamps

_BRACKETED = re.compile(r'\s*\[\s*([^\[\]]+?)\s*\]\s*')
_OF_EFFORTS = 'record measured efforts, or take the commands: --effort command'
_OF_COMMANDS = 'record measured efforts'


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
    `read_run`; `names.joints` may have `theta`, the topic of the motors' positions, by
    default `motor_states` beside the joint states, and `q` and `tau`, units in brackets.

    Raises:
        BlfDscError: the bag cannot be read, has no torques or too few states, or has the joints
            of no arm.
    """
    names, units, motors = _split(path, names)
    content = read_content(path, namespace, names)
    messages = content.topics[JOINT_STATES]
    named = messages.name_lists()
    joints = tuple(joints) or _arm_joints(text, set().union(*named), names)
    theirs = content.joints_of(joints)
    groups = _groups(theirs, named)
    source = f'effort of {messages.name}'
    if not _has_stamps(messages, groups[0]):
        messages.is_stamped = False
        source += ' (without stamps: by the times of reception)'
    other = _motor_states(content, theirs, namespace, motors)
    if other is not None:
        source += f', positions of motors of {other.topics[JOINT_STATES].name}'

    file = _File(path, Tree.of(text), dict(zip(theirs, joints, strict=True)), units)
    motion_of = _of_one if len(groups) == 1 else _of_several
    motion = motion_of(file, content, groups, source, commanded=commanded)
    theta = None
    if other is not None:
        theta = units['q'].factor * _motors_at(motion.stamp, other, theirs)
    return _recording_of(file, motion, theta)


class _Motion(NamedTuple):
    """Sound states (N,) of n joints, in the units of the bag."""

    stamp: Stamps
    q: Rows
    torque: Rows
    source: str  # of the torques
    said: list[str]  # of what was left out


def _recording_of(file: _File, motion: _Motion, theta: Floats | None) -> Recording:
    """Return a motion in rad and N m, at even times; theta (N, n) [rad] is of motors."""
    joints = tuple(file.joints.values())
    recording = resampled(
        joints,
        motion.stamp,
        _Scaled(motion.q, file.units['q'].factor),
        _Scaled(motion.torque, file.units['tau'].factor),
        '; '.join([motion.source, *motion.said]),
        file.tree.turning(joints),
        theta,
    )
    return recording._replace(currents=is_of_drive(file.units['tau'].name))


def _of_several(
    file: _File,
    content: Content,
    groups: Sequence[Sequence[str]],
    source: str,
    *,
    commanded: bool,
) -> _Motion:
    """Return the motion of joints that come in several messages, with efforts."""
    if commanded:
        raise BagError(
            f'{file.path}: the joints come in {len(groups)} messages, to which commands cannot be '
            'assigned: leave out --effort command'
        )
    parts = [single_run(content, group).states for group in groups]
    found = [file.sound(part, part, _OF_EFFORTS) for part in parts]
    said = [each for _, remarks in found for each in remarks]
    sound = [part.select(rows) for part, (rows, _) in zip(parts, found, strict=True)]
    return _Motion(*_together(sound, tuple(file.joints)), source, said)


def _of_one(
    file: _File,
    content: Content,
    groups: Sequence[Sequence[str]],
    source: str,
    *,
    commanded: bool,
) -> _Motion:
    """Return the motion of joints that come in one message, with efforts, or else commands."""
    (joints,) = groups
    states = single_run(content, joints).states
    efforts, remedy = states, _OF_EFFORTS
    if commanded or not _any(states.field(2), states.size):
        source, efforts = applied_torque(content, states)
        remedy = _OF_COMMANDS
        if not _any(efforts.field(2), states.size):
            raise BagError(
                f'{file.path}: all torques in the {source} are zero: record measured efforts'
            )
    rows, said = file.sound(states, efforts, remedy)
    states, efforts = states.select(rows), efforts.select(rows)
    return _Motion(states.stamp, states.field(0), efforts.field(2), source, said)


class _Unit(NamedTuple):
    """The unit that positions or torques have in a bag, as it was given; empty: rad or N m."""

    name: str
    factor: float


def _split(path: Path, names: NameMap) -> tuple[NameMap, dict[str, _Unit], str]:
    """Return names of the bag, the units of q and tau, and the topic of the motors, if given.

    `names.joints` is what `--map` gives, such as `q=[deg]` and `theta=motors` among the joints.

    Raises:
        BlfDscError: a unit is not known.
    """
    joints = dict(names.joints)
    motors = joints.pop('theta', '')
    units = {}
    for kind in ('q', 'tau'):
        units[kind] = _Unit('', 1.0)
        if given := _BRACKETED.fullmatch(joints.get(kind, '')):
            units[kind] = _unit(path, given[1], kind)
            del joints[kind]
    return NameMap(names.topics, joints), units, motors


def _unit(path: Path, name: str, kind: str) -> _Unit:
    """Return the unit of q or tau; BlfDscError if it is not known."""
    try:
        return _Unit(name, factor_of(name, kind))
    except BlfDscError as error:
        raise BlfDscError(f'{path}: {error}') from error


class _Scaled(NamedTuple):
    """Values in another unit, read by slices."""

    values: Rows
    factor: float

    def __getitem__(self, rows: Any) -> Any:
        """Return some rows."""
        return self.factor * self.values[rows]


class _File(NamedTuple):
    """A bag, and what its values are checked by."""

    path: Path
    tree: Tree
    joints: Mapping[str, str]  # of the URDF, by their names in the bag
    units: Mapping[str, _Unit]

    def sound(
        self, states: JointStates, efforts: JointStates, others: str
    ) -> tuple[NDArray[np.intp], list[str]]:
        """Return which rows of states, and efforts at them, are sound, and what to say.

        Raises:
            BlfDscError: positions or torques cannot be what they are said to be.
        """
        groups = [
            Group(
                each.field(field),
                [f'the {what} of {name}' for name in states.names],
                np.full(len(states.names), self.units[kind].factor),
            )
            for each, field, what, kind in (
                (states, 0, 'position', 'q'),
                (efforts, 2, 'effort', 'tau'),
            )
        ]
        motion = Motion(
            path=self.path,
            joints=[self.joints[name] for name in states.names],
            stamp=states.stamp,
            q=groups[0],
            tau=groups[1],
            theta=None,
            unit='' if self.units['q'].name else 'q=',
            others=others,
        )
        rows, said = checked(motion, self.tree)
        return np.flatnonzero(rows), said


def _motors_at(stamp: Stamps, content: Content, joints: Sequence[str]) -> Floats:
    """Return the positions of motors (N, n) at these stamps."""
    states = single_run(content, joints).states
    missing, _ = stand_ins(states.field(0), states.size, states.names)
    known = states.select(np.flatnonzero(~missing))
    return np.asarray(_at(stamp, known)[0])


def _motor_states(
    content: Content, joints: Sequence[str], namespace: str, topic: str
) -> Content | None:
    """Return a bag with the states of motors as its joint states; None if it has none of these.

    They are on `topic`, by default on `motor_states` beside the joint states.
    """
    if topic:
        topics = {**content.names.topics, JOINT_STATES.leaf: '/' + topic.lstrip('/')}
        names = NameMap(topics, content.names.joints)
        return read_content(content.path, namespace, names)
    messages = content.topics.get(MOTOR_STATES)
    if messages is None:
        return None
    if not any({*joints} <= {*names} for names in messages.name_lists()):
        return None
    return replace(content, topics={**content.topics, JOINT_STATES: messages})


def _groups(
    joints: tuple[str, ...], named: Sequence[tuple[str, ...]]
) -> list[tuple[str, ...]]:
    """Return the joints as they come in one message, or else in several.

    Raises BagError if several have some of them, and none the others.
    """
    left = list(joints)
    groups: list[tuple[str, ...]] = []
    for names in sorted(named, key=lambda each: -len({*each} & {*joints})):
        group = tuple(name for name in left if name in names)
        if group:
            groups.append(group)
            left = [name for name in left if name not in group]
    if left and len(groups) > 1:
        raise BagError(
            f'no message has {", ".join(left)} (the bag names {_listed(named)}): give the names '
            f'of these joints there, as in --map {left[0]}=ITS_NAME, or a --tip before them'
        )
    return [joints] if left else groups


def _listed(named: Sequence[tuple[str, ...]]) -> str:
    return ', '.join(sorted(set().union(*named)))


def _has_stamps(messages: TopicMessages, joints: Sequence[str]) -> bool:
    """Return whether not all states of these joints have one stamp."""
    stamp = messages.joint_states(joints, ('position',)).stamp
    return stamp.size < 2 or bool((stamp != stamp[0]).any())


def _together(
    parts: Sequence[JointStates], joints: Sequence[str]
) -> tuple[Stamps, Floats, Floats]:
    """Return stamps (N,) of the first states, and all positions and efforts (N, n) there.

    Those of other states are interpolated; they are NaN before, after and in gaps.
    """
    stamp = parts[0].stamp
    values = np.full((2, stamp.size, len(joints)), np.nan)
    for part in parts:
        columns = [joints.index(name) for name in part.names]
        values[:, :, columns] = _at(stamp, part)
    return stamp, values[0], values[1]


def _at(stamp: Stamps, states: JointStates) -> Floats:
    """Return positions and efforts (2, N, n) at other stamps; NaN where they are unknown."""
    own = states.stamp
    values = np.full((2, stamp.size, len(states.names)), np.nan)
    if own.size < 2:
        return values
    after = np.clip(np.searchsorted(own, stamp), 1, own.size - 1)
    pause = own[after] - own[after - 1]
    is_known = (pause <= GAP * np.median(np.diff(own))) & (stamp <= own[-1])
    is_known &= stamp >= own[0]
    seconds = (own - own[0]) * 1e-9
    at = (stamp[is_known] - own[0]) * 1e-9
    for row, field in enumerate((0, 2)):
        found = interpolated(at, seconds, np.asarray(states.field(field)))
        values[row, is_known] = found
    return values


def _any(values: Values, size: int) -> bool:
    """Return whether one of the values in so many rows is known and not zero."""
    return any(np.nan_to_num(values[rows]).any() for rows in blocks_of(size))


def _arm_joints(text: str, in_bag: set[str], names: NameMap) -> tuple[str, ...]:
    """Return the joints of the arm: from the root of the URDF to the last that the bag has."""
    ours = in_bag | {our for our, their in names.joints.items() if their in in_bag}
    trunk = Tree.of(text).trunk()
    arm = trunk
    while arm and arm[-1] not in ours:
        arm = arm[:-1]
    if not arm:
        other = _with_another_prefix(trunk, in_bag)
        remedy = "choose an arm with --tip, or give the bag's names, as in --map joint1=shoulder"
        if other:
            remedy = 'if these are the same joints, give ' + ' '.join(
                f'--map {joint}={name}'
                for joint, name in zip(trunk, other, strict=True)
            )
        raise BagError(
            f'the bag has no joint of the URDF; it names {", ".join(sorted(in_bag))}: {remedy}'
        )
    return arm


def _with_another_prefix(joints: Sequence[str], in_bag: set[str]) -> tuple[str, ...]:
    """Return names of a bag that differ from those of joints only in how all of them begin."""
    for begin in range(len(beginning(joints)) + 1) if joints else ():
        rest = joints[0][begin:]
        for name in sorted(in_bag):
            prefix = name.removesuffix(rest)
            others = tuple(prefix + joint[begin:] for joint in joints)
            if rest and {*others} <= in_bag:
                return others
    return ()
