# SPDX-License-Identifier: Apache-2.0
"""The arm of bags and tables: they are read, joined and identified."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.from_bag import motion_of_bag
from blf_dsc_controller.identification.from_table import motion_of_table
from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.identify import (
    READING,
    identify_arm,
    tell_nobody,
)
from blf_dsc_controller.identification.motion import recording_of
from blf_dsc_controller.identification.problem import Effort
from blf_dsc_controller.identification.recording import Recording, joined
from blf_dsc_controller.tables.table_files import TABLES

_BAGS = ('.mcap', '.db3', '.bag', '.yaml')


def identify_bag(
    path: Path | Sequence[Path],
    robot: Robot,
    namespace: str = '',
    names: NameMap = NO_NAMES,
    effort: Effort = 'torque',
    gains: Sequence[float] = (),
    loaded: Path | None = None,
    *,
    pick_up: bool = False,
    begin: Callable[[str], None] = tell_nobody,
) -> Identified:
    """Identify the arm of one or several bags or tables from its URDF.

    Path, namespace and names are as for `read_run`.  `effort` says what the efforts
    are: the whole torque, the torque without that of gravity, or the commanded torque
    instead of them; `gains` [N m/A] turn currents into torques, and if there are none,
    signs are found.  A load is identified if there is a bag in which the arm is
    `loaded`, or if it does `pick_up` one.  `begin` is called with each of STAGES when
    it begins.

    Raises:
        BlfDscError: a bag or the URDF cannot be read, or there are no torques of the arm, too
            little of it, or no motion; or they are currents, and there are no gains.
    """
    begin(READING)
    paths = [path] if isinstance(path, Path) else [*path]
    joints: tuple[str, ...] = ()
    if robot.tip:
        joints = tuple(joint.name for joint in robot.chain(()).joints)
    recordings: list[Recording] = []
    for each in [*paths, *([loaded] if loaded else [])]:
        found = read_recording(
            each, robot.text, joints, namespace, names, commanded=effort == 'command'
        )
        recordings.append(found)
        joints = found.joints
    recording, begins = joined(*recordings)
    picked_up = float('nan') if pick_up else None
    if loaded:
        picked_up = begins[-1]
    if len(gains):
        recording = _with_gains(recording, gains)
    elif any(each.currents for each in recordings):
        raise BlfDscError(
            f'{recording.source}: these are currents or percentages, from which no mass in kg can '
            f'be told: give --gains [N m/A or N m/%] of {", ".join(recording.joints)}; 1 for each '
            'if they are torques'
        )
    return identify_arm(
        recording, robot, effort, picked_up, find_signs=not len(gains), begin=begin
    )


def _with_gains(recording: Recording, gains: Sequence[float]) -> Recording:
    """Return the recording with torques that are its efforts times the gains.

    Raises:
        BlfDscError: there is not one for each joint, or one is 0.
    """
    joints = recording.joints
    if len(gains) != len(joints):
        found = f'{len(joints)} joints: {", ".join(joints)}'
        raise BlfDscError(f'got {len(gains)} gains for {found}')
    for joint, gain in zip(joints, gains, strict=True):
        if gain == 0.0 or not math.isfinite(gain):
            raise BlfDscError(
                f'got a gain of {gain:g} for {joint}: give its torque per current, 1 if it is a '
                'torque'
            )
    return recording._replace(torque=recording.torque * np.array(gains))


def read_recording(
    path: Path,
    text: str,
    joints: Sequence[str] = (),
    namespace: str = '',
    names: NameMap = NO_NAMES,
    *,
    commanded: bool = False,
) -> Recording:
    """Read a recording of the arm of a URDF (its text) from a bag or a table.

    `joints` are the arm's, from its base to its tip; none: see `motion_of_bag`,
    `motion_of_table`.  `names` are those that differ in the file.  `commanded`: commands of
    a bag are read instead of efforts.

    Raises:
        BlfDscError: the file cannot be read, or does not hold positions and torques of the arm.
    """
    tree = Tree.of(text)
    if path.suffix.lower() in TABLES:
        return recording_of(motion_of_table(path, tree, joints, names), tree)
    _check_file(path)
    motion = motion_of_bag(path, tree, joints, namespace, names, commanded=commanded)
    return recording_of(motion, tree)


def _check_file(path: Path) -> None:
    """Raise BlfDscError if this is neither a table nor what may be a bag."""
    if path.is_file() and path.suffix.lower() not in _BAGS:
        raise BlfDscError(
            f'{path}: got {path.suffix or "no suffix"}, but bags and tables end with '
            f'{", ".join((*_BAGS[:-1], *TABLES))}: unpack it, or write it as CSV'
        )
    if path.is_dir() and not any(path.glob('*.yaml')):
        tables = sorted(each for each in path.iterdir() if each.suffix in TABLES)
        if tables:
            raise BlfDscError(
                f'{path} is a folder of tables: give the files, as {tables[0]}'
            )
