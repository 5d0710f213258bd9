# SPDX-License-Identifier: Apache-2.0
"""Recordings from any file: bags, and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.from_bag import read_bag
from blf_dsc_controller.identification.from_table import read_table
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

    `joints` are the arm's, from its base to its tip; none: see `read_bag`,
    `read_table`.  `names` are those that differ in the file.  `commanded`: commands of
    a bag are read instead of efforts.

    Raises:
        BlfDscError: the file cannot be read, or does not hold positions and torques of the arm.
    """
    if path.suffix.lower() in TABLES:
        return read_table(path, text, joints, names)
    _check_file(path)
    return read_bag(path, text, joints, namespace, names, commanded)


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
