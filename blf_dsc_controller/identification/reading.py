# SPDX-License-Identifier: Apache-2.0
"""Recordings from any file: bags, and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.from_bag import motion_of_bag
from blf_dsc_controller.identification.from_table import motion_of_table
from blf_dsc_controller.identification.motion import recording_of
from blf_dsc_controller.identification.recording import Recording
from blf_dsc_controller.identification.table_files import TABLES

_BAGS = ('.mcap', '.db3', '.bag', '.yaml')


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
