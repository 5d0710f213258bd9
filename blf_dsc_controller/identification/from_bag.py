# SPDX-License-Identifier: Apache-2.0
"""Recordings from bags."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.bags.content import Content, NameMap, read_content
from blf_dsc_controller.bags.reader import applied_torque, single_run
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import JointStates
from blf_dsc_controller.identification.bad_values import stand_ins
from blf_dsc_controller.identification.motion import Group, Motion, checked
from blf_dsc_controller.identification.recording import GAP, interpolated
from blf_dsc_controller.messages.topics import JOINT_STATES, MOTOR_STATES
from blf_dsc_controller.run import Floats, Stamps
from blf_dsc_controller.tables.columns import Column, beginning
from blf_dsc_controller.tables.units import factor_of, is_of_drive

_BRACKETED = re.compile(r'\s*\[\s*([^\[\]]+?)\s*\]\s*')
_OF_EFFORTS = 'record measured efforts, or take the commands: --effort command'
_OF_COMMANDS = 'record measured efforts'


def motion_of_bag(
    path: Path,
    tree: Tree,
    joints: Sequence[str],
    namespace: str,
    names: NameMap,
    *,
    commanded: bool,
) -> Motion:
    """Read joint states with efforts, or else (or if `commanded`) commanded torques, from any bag.

    `joints` are the arm's, from its base to its tip, by default all in the bag up to
    where the arm branches; `namespace` and `names` are as for `read_run`;
    `names.joints` may have `theta`, the topic of the motors' positions, by default
    `motor_states` beside the joint states, and `q` and `tau`, units in brackets.

    Raises:
        BlfDscError: the bag cannot be read, has no torques or too few states, or has the joints
            of no arm.
    """
    names, units = _split(path, names)
    content = read_content(path, namespace, names)
    messages = content.topics[JOINT_STATES]
    named = messages.name_lists()
    joints = tuple(joints) or _arm_joints(tree, set().union(*named), names)
    theirs = content.joints_of(joints)
    groups = _groups(theirs, named)
    bag = _Bag(content, dict(zip(theirs, joints, strict=True)), units)
    source = f'effort of {messages.name}'
    stamp = messages.joint_states(groups[0], ('position',)).stamp
    if stamp.size > 1 and (stamp == stamp[0]).all():
        messages.is_stamped = False
        source += ' (without stamps: by the times of reception)'
    states = [single_run(content, group).states for group in groups]
    parts = [bag.motion(each, each, source, _OF_EFFORTS) for each in states]
    if len(groups) == 1:
        (motion,) = parts
        if commanded or not np.nan_to_num(motion.tau.values).any():
            motion = _of_commands(bag, states[0])
    elif commanded:
        raise BagError(
            f'{path}: the joints come in {len(groups)} messages, to which commands cannot be '
            'assigned: leave out --effort command'
        )
    else:
        motion = _together([checked(part, tree) for part in parts], joints)
    return _with_motors(motion, content, theirs)


class _Bag(NamedTuple):
    """A bag, its joints, and the units of their values."""

    content: Content
    joints: Mapping[str, str]  # of the URDF, by their names in the bag
    units: Mapping[str, Column]

    def motion(
        self, states: JointStates, efforts: JointStates, source: str, others: str
    ) -> Motion:
        """Return the motion of states, with efforts at them; see `Motion`."""

        def group(each: JointStates, field: int, what: str, kind: str) -> Group:
            return Group(
                np.asarray(each.field(field)),
                [f'the {what} of {name}' for name in states.names],
                np.full(len(states.names), self.units[kind].factor),
            )

        return Motion(
            path=self.content.path,
            joints=[self.joints[name] for name in states.names],
            stamp=states.stamp,
            q=group(states, 0, 'position', 'q'),
            tau=group(efforts, 2, 'effort', 'tau'),
            theta=None,
            unit='' if self.units['q'].name else 'q=',
            others=others,
            source=source,
            currents=is_of_drive(self.units['tau'].name),
        )


def _of_commands(bag: _Bag, states: JointStates) -> Motion:
    """Return the motion of states with commanded torques."""
    source, efforts = applied_torque(bag.content, states)
    motion = bag.motion(states, efforts, source, _OF_COMMANDS)
    if not np.nan_to_num(motion.tau.values).any():
        raise BagError(
            f'{motion.path}: all torques in the {source} are zero: record measured efforts'
        )
    return motion


def _split(path: Path, names: NameMap) -> tuple[NameMap, dict[str, Column]]:
    """Return names of the bag, and units of q and tau, if given.

    `names.joints` is what `--map` gives, such as `q=[deg]` and `theta=motors` among the
    joints; the latter is the topic of the motors.  A unit is a `Column`, whose name is
    empty if none was given: rad or N m.

    Raises:
        BlfDscError: a unit is not known.
    """
    topics, joints = dict(names.topics), dict(names.joints)
    if motors := joints.pop('theta', ''):
        topics[MOTOR_STATES.leaf] = '/' + motors.lstrip('/')
    units = {'q': Column('', 1.0), 'tau': Column('', 1.0)}
    for kind in units:
        if given := _BRACKETED.fullmatch(joints.get(kind, '')):
            units[kind] = Column(given[1], factor_of(path, given[1], kind))
            del joints[kind]
    return NameMap(topics, joints), units


def _with_motors(motion: Motion, content: Content, joints: Sequence[str]) -> Motion:
    """Return the motion with the positions of its motors, if the bag has these.

    They are on the topic that is given, or on `motor_states` beside the joint states.
    """
    given = content.names.topics.get(MOTOR_STATES.leaf)
    messages = content.topics.get(MOTOR_STATES)
    if messages is None:
        if given:
            raise BagError(f'{content.path} holds no message of {given}')
        return motion
    if not given and not any({*joints} <= {*each} for each in messages.name_lists()):
        return motion
    other = replace(content, topics={**content.topics, JOINT_STATES: messages})
    states = single_run(other, joints).states
    values = np.asarray(states.field(0))
    missing, _ = stand_ins(values, joints)
    theta = _at(motion.stamp, states.stamp[~missing], values[~missing])
    return motion._replace(
        theta=motion.q._replace(values=theta),
        source=f'{motion.source}, positions of motors of {messages.name}',
    )


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
        listed = ', '.join(sorted(set().union(*named)))
        raise BagError(
            f'no message has {", ".join(left)} (the bag names {listed}): give the names '
            f'of these joints there, as in --map {left[0]}=ITS_NAME, or a --tip before them'
        )
    return [joints] if left else groups


def _together(parts: Sequence[Motion], joints: Sequence[str]) -> Motion:
    """Return the motion of all joints at the stamps of the first part.

    Values of others are interpolated; they are NaN before, after and in gaps.
    """
    first = parts[0]
    named = [name for part in parts for name in part.joints]
    order = [named.index(name) for name in joints]
    groups = []
    for kind in ('q', 'tau'):
        of_parts: list[Group] = [getattr(part, kind) for part in parts]
        values = [
            _at(first.stamp, part.stamp, own.values)
            for part, own in zip(parts, of_parts, strict=True)
        ]
        names = [name for own in of_parts for name in own.names]
        factors = np.concatenate([own.factors for own in of_parts])
        groups.append(
            Group(np.hstack(values)[:, order], [names[k] for k in order], factors)
        )
    said = [each for part in parts for each in part.said]
    return first._replace(joints=joints, q=groups[0], tau=groups[1], said=said)


def _at(stamp: Stamps, own: Stamps, values: Floats) -> Floats:
    """Return values (k, n) at their stamps (k,) at other ones (N,); NaN where unknown."""
    if own.size < 2:
        return np.full((stamp.size, values.shape[1]), np.nan)
    after = np.clip(np.searchsorted(own, stamp), 1, own.size - 1)
    pause = own[after] - own[after - 1]
    is_unknown = pause > GAP * np.median(np.diff(own))
    is_unknown |= (stamp < own[0]) | (stamp > own[-1])
    found = interpolated((stamp - own[0]) * 1e-9, (own - own[0]) * 1e-9, values)
    found[is_unknown] = np.nan
    return found


def _arm_joints(tree: Tree, in_bag: set[str], names: NameMap) -> tuple[str, ...]:
    """Return the joints of the arm: from the root of the URDF to the last that the bag has."""
    ours = in_bag | {our for our, their in names.joints.items() if their in in_bag}
    trunk = tree.trunk()
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
