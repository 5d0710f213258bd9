# SPDX-License-Identifier: Apache-2.0
"""Recordings from tables: CSV and text with or without a header, npz, mat, and Parquet.

A table needs the time, and a position and a torque of each joint: see `columns`.  It
may have the positions of the motors, too.
Velocities are not read: `windows` computes them from the positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.bad_values import stand_ins
from blf_dsc_controller.identification.motion import Group, Motion
from blf_dsc_controller.identification.recording import LONGEST_PERIOD
from blf_dsc_controller.run import LATEST, Floats, Stamps
from blf_dsc_controller.tables.columns import (
    KINDS,
    Column,
    Columns,
    choose_columns,
    pattern_of,
)
from blf_dsc_controller.tables.table_files import Table, open_table
from blf_dsc_controller.tables.units import split_unit

_EXPORTED = ('stamp [ns]', 'received [ns]', 'time [s]')
_LEAST = 2  # rows
_BETWEEN = 1.0  # s, least pause between runs in one table
_MOST_RUNS = 100
_BACK = 10.0  # intervals that the time falls back where another run begins
# s since 1970, of stamps whose unit is not named: years 2001 to 2096
_EPOCH = (1e9, 4e9)
_SMALLER = {'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}


def motion_of_table(
    path: Path, tree: Tree, joints: Sequence[str], names: NameMap
) -> Motion:
    """Read the motion of the arm of a URDF from a table.

    `joints` are the arm's, by default all from the root to where it branches, or as
    many of them as the table has.  `names.joints` may have `time`, `q`, `tau` and
    `theta`, as for `choose_columns`, and the joints' names.

    Raises:
        BlfDscError: the file cannot be read, or its columns are not found.
    """
    table = open_table(path)
    others = dict(names.joints)
    exported = _exported(table)
    given = {kind: others.pop(kind, exported.get(kind, '')) for kind in KINDS}
    trunk = tuple(joints) or tree.trunk() or tree.only_chain()
    theirs = NameMap(joints=others).joints_of(trunk)
    columns = choose_columns(path, table.names, given, theirs)
    if joints:
        _check_count(path, columns, trunk)
    groups = _groups(path, table, columns)
    time, said = _seconds(path, columns, groups.pop('time'))
    _check_rows(path, time, groups['q'].values)
    stamp, runs = _one_clock(path, time)
    if runs > 1:
        said.append(f'the time starts again {runs - 1} times: read as {runs} runs')
    pattern = pattern_of(table.names, [column.name for column in columns.q])
    motion = Motion(
        path=path,
        joints=trunk[: len(columns.q)],
        stamp=stamp,
        groups={kind: each for kind, each in groups.items() if len(each.names)},
        unit='' if split_unit(given['q'], 'q').unit else f'q={pattern}',
        others='choose the columns that have it, as in --map tau=effort_*',
        source=f'{path.name}: {columns.text}',
        said=said,
        currents=columns.has_currents,
    )
    return motion.select(np.isfinite(time))


def _exported(table: Table) -> dict[str, str]:
    """Return what is chosen of a table of `blf_dsc export`; nothing of another one."""
    if table.names[: len(_EXPORTED)] != _EXPORTED:
        return {}
    efforts = table.read([name for name in table.names if name.startswith('effort ')])
    tau = 'effort *' if np.nan_to_num(efforts).any() else 'torque *'
    return {'time': _EXPORTED[0], 'q': 'position *', 'tau': tau}


def _check_count(path: Path, columns: Columns, arm: Sequence[str]) -> None:
    """Raise BlfDscError if there are not as many positions as joints of the arm."""
    if len(columns.q) != len(arm):
        listed = ', '.join(column.name for column in columns.q)
        raise BlfDscError(
            f'{path} has the positions of {len(columns.q)} joints ({listed}), but from base to '
            f'tip there are {len(arm)}: {", ".join(arm)}'
        )


def _check_rows(path: Path, time: Floats, q: Floats) -> None:
    """Raise BlfDscError if most rows have the time of others, at other positions."""
    same = np.diff(time) == 0.0
    moved = same & (np.diff(q, axis=0) != 0.0).any(axis=1)
    if 2 * moved.sum() > time.size:
        raise BlfDscError(
            f'{path}: {moved.sum()} rows have the time of the row before, but other positions. '
            'A row must have all joints at a time: is there one for each joint?'
        )


def _groups(path: Path, table: Table, columns: Columns) -> dict[str, Group]:
    """Return the values of each of KINDS as they stand in a table.

    Raises:
        BlfDscError: there are hardly any.
    """
    chosen = columns.time, columns.q, columns.tau, columns.theta
    values = table.read([column.name for group in chosen for column in group])
    if len(values) < _LEAST:
        raise BlfDscError(f'{path} has fewer than {_LEAST} rows of numbers')
    ends = np.cumsum([len(group) for group in chosen])[:-1]
    return {
        kind: Group(
            part,
            [repr(column.name) for column in group],
            np.array([column.factor for column in group]),
        )
        for kind, part, group in zip(
            KINDS, np.split(values, ends, axis=1), chosen, strict=True
        )
    }


def _seconds(path: Path, columns: Columns, time: Group) -> tuple[Floats, list[str]]:
    """Return the time (N,) [s], NaN where it is unknown, and what to say of it."""
    if columns.rate:
        return np.arange(len(time.values)) / columns.rate, []
    missing, said = stand_ins(time.values, time.names)
    scaled = time.scaled
    scaled[missing] = np.nan
    known = np.isfinite(scaled).all(axis=1)
    if not known.any():
        raise BlfDscError(
            f'{path}: {time.names[0]} has no numbers: choose another column, as in --map time=t'
        )
    first = scaled[known][0]
    seconds = np.sum(scaled - first, axis=1)
    seconds *= _unnamed_unit(path, columns.time, first, seconds)
    return seconds, [f'{each}, read as missing' for each in said]


def _unnamed_unit(
    path: Path, columns: Sequence[Column], first: Floats, time: Floats
) -> float:
    """Return the factor of a time without a unit, by which stamps are of this century.

    Raises:
        BlfDscError: it is no time in seconds, but would be one in another unit.
    """
    if len(columns) > 1 or columns[0].factor != 1.0:
        return 1.0
    for factor in _SMALLER.values():
        if _EPOCH[0] < first.item() * factor < _EPOCH[1]:
            return factor
    period = float(np.nanmedian(np.abs(np.diff(time))))
    for unit, factor in _SMALLER.items():
        if period > 1.0 and period * factor <= LONGEST_PERIOD:
            name = columns[0].name
            raise BlfDscError(
                f'{path}: the rows are {period:.3g} s apart by {name!r}. If it is in {unit}: '
                f"--map 'time={name}[{unit}]'"
            )
    return 1.0


def _one_clock(path: Path, time: Floats) -> tuple[Stamps, int]:
    """Return stamps (N,) [ns] of times that may start again, and the number of runs.

    Rows that are hardly out of order are left to be sorted.

    Raises:
        BlfDscError: they fall back all the time.
    """
    stamps = np.zeros(time.size, dtype=np.int64)
    known = np.flatnonzero(np.isfinite(time))
    steps = np.diff(time[known])
    if not steps.size:
        return stamps, 1
    interval = float(np.median(np.abs(steps)))
    starts = np.flatnonzero(steps < -_BACK * interval) + 1
    if starts.size > _MOST_RUNS:
        raise BlfDscError(
            f'{path}: the time falls back {starts.size} times: is its column the time, and are '
            'these the rows of one recording?'
        )
    pause = max(_BETWEEN, _BACK * interval)
    continued = time[known].copy()
    for start in starts:
        continued[start:] += continued[:start].max() + pause - continued[start]
    if continued.max() > LATEST:
        raise BlfDscError(
            f'{path}: the time reaches {continued.max():.3g} s: is its column the time?'
        )
    stamps[known] = np.round(1e9 * continued).astype(np.int64)
    return stamps, starts.size + 1
