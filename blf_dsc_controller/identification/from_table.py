# SPDX-License-Identifier: Apache-2.0
"""Recordings from tables: CSV and text with or without a header, npz, and mat.

A table needs the time, and a position and a torque of each joint: see `columns`.  It
may have the positions of the motors, too.
Velocities are not read: `windows` computes them from the positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.columns import (
    KINDS,
    Column,
    Columns,
    choose_columns,
    pattern_of,
)
from blf_dsc_controller.identification.recording import (
    LONGEST_PERIOD,
    Recording,
    resampled,
)
from blf_dsc_controller.identification.table_files import Table, open_table
from blf_dsc_controller.identification.table_values import (
    blank_stand_ins,
    constant,
    unrecorded,
)
from blf_dsc_controller.identification.turns import TURN
from blf_dsc_controller.identification.units import split_unit
from blf_dsc_controller.run import Floats, Stamps

_LEAST = 2  # rows
_BEYOND = 2.0  # times what a joint reaches, and at least turns: no angle in rad
_BETWEEN = 1.0  # s, least pause between runs in one table
_MOST_RUNS = 100
_BACK = 10.0  # intervals that the time falls back where another run begins
# s since 1970, of stamps whose unit is not named: years 2001 to 2096
_EPOCH = (1e9, 4e9)
_SMALLER = {'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}


def read_table(
    path: Path,
    text: str,
    joints: Sequence[str] = (),
    names: NameMap = NO_NAMES,
    *,
    planned: bool = False,
) -> Recording:
    """Read a recording of the arm of a URDF (its text) from a table.

    A `planned` motion has no torques: they are zero.

    `joints` are the arm's, by default all from the root to where it branches, or as
    many of them as the table has.  `names.joints` may have `time`, `q`, `tau` and
    `theta`, as for `choose_columns`, and the joints' names.

    Raises:
        BlfDscError: the file cannot be read, or its columns are not found.
    """
    table = open_table(path)
    tree = Tree.of(text)
    arm = tuple(joints) or tree.trunk()
    others = dict(names.joints)
    given = {kind: others.pop(kind, '') for kind in KINDS}
    theirs = NameMap(joints=others).joints_of(arm)
    columns = choose_columns(path, table.names, given, theirs, planned=planned)
    n = len(columns.q)
    if joints and n != len(arm):
        listed = ', '.join(column.name for column in columns.q)
        raise BlfDscError(
            f'{path} has the positions of {n} joints ({listed}), but from base to '
            f'tip there are {len(arm)}: {", ".join(arm)}'
        )
    time, q, tau, theta, said = _values(path, table, columns)
    q[~np.isfinite(time)] = np.nan
    _check_rows(path, time, q)
    stamp, runs = _one_clock(path, time)
    if runs > 1:
        said.append(f'the time starts again {runs - 1} times: read as {runs} runs')
    turning = tree.turning(arm[:n])
    if not split_unit(given['q'], 'q').unit:
        reach = np.where(turning, tree.reaches(arm[:n]), np.inf)
        _check_angles(path, table.names, arm, q, columns, reach)
    if not planned:
        _check_torques(path, arm, tau, columns)
        dropped = unrecorded(tau)
        tau[dropped] = np.nan
        if dropped.any():
            said.append(
                f'torques are exactly 0 in {dropped.sum()} row(s), read as missing'
            )
    source = '; '.join([f'{path.name}: {columns.text}', *said])
    motors = theta if columns.theta else None
    recording = resampled(arm[:n], stamp, q, tau, source, turning, motors)
    return recording._replace(currents=columns.has_currents)


def _check_rows(path: Path, time: Floats, q: Floats) -> None:
    """Raise BlfDscError if most rows have the time of others, at other positions."""
    same = np.diff(time) == 0.0
    moved = same & (np.diff(q, axis=0) != 0.0).any(axis=1)
    if 2 * moved.sum() > time.size:
        raise BlfDscError(
            f'{path}: {moved.sum()} rows have the time of the row before, but other positions. '
            'A row must have all joints at a time: is there one for each joint?'
        )


def _check_angles(
    path: Path,
    names: Sequence[str],
    joints: Sequence[str],
    q: Floats,
    columns: Columns,
    reach: Floats,
) -> None:
    """Raise BlfDscError if positions are far beyond what the joints can reach (n,) [rad]."""
    largest = np.max(np.abs(q), axis=0, initial=0.0, where=np.isfinite(q))
    beyond = np.flatnonzero(largest > _BEYOND * np.maximum(reach, TURN))
    if beyond.size:
        k = int(beyond[0])
        pattern = pattern_of(names, [column.name for column in columns.q])
        raise BlfDscError(
            f'{path}: {columns.q[k].name!r} goes to {largest[k]:.3g} rad, but {joints[k]} turns by '
            f"at most {reach[k]:.3g} rad. If it is in degrees: --map 'q={pattern}[deg]'; if it "
            f"is in rad nevertheless: --map 'q={pattern}[rad]'"
        )


def _check_torques(
    path: Path, joints: Sequence[str], tau: Floats, columns: Columns
) -> None:
    """Raise BlfDscError if the torques (N, n) of joints are the same in all rows."""
    same = constant(tau)
    if same.size:
        listed = ', '.join(repr(columns.tau[k].name) for k in same)
        moved = ', '.join(joints[k] for k in same)
        value = tau[np.isfinite(tau[:, same[0]]), same[0]][0]
        raise BlfDscError(
            f'{path}: {listed}: {value:g} in all rows, so the torque of {moved} was not recorded '
            'there: choose the columns that have it, as in --map tau=effort_*'
        )


def _values(
    path: Path, table: Table, columns: Columns
) -> tuple[Floats, Floats, Floats, Floats, list[str]]:
    """Return time (N,) [s], positions and torques (N, n), positions of motors, if any, and remarks.

    Raises:
        BlfDscError: there are hardly any.
    """
    groups = columns.time, columns.q, columns.tau, columns.theta
    values = table.read([column.name for group in groups for column in group])
    if len(values) < _LEAST:
        raise BlfDscError(f'{path} has fewer than {_LEAST} rows of numbers')
    ends = np.cumsum([len(group) for group in groups])[:-1]
    said = []
    scaled = []
    for part, group in zip(np.split(values, ends, axis=1), groups, strict=True):
        if group:
            said += blank_stand_ins(part, [column.name for column in group])
        scaled.append(_scaled(part, group))
    time, q, tau, theta = scaled
    _check_known(path, values, [column.name for group in groups for column in group])
    if columns.rate:
        seconds = np.arange(len(values)) / columns.rate
    else:
        first = time[np.isfinite(time).all(axis=1)][:1]
        seconds = np.sum(time - first, axis=1)
        seconds *= _unnamed_unit(path, columns.time, first, seconds)
    return seconds, q, tau if columns.tau else np.zeros_like(q), theta, said


def _check_known(path: Path, values: Floats, names: Sequence[str]) -> None:
    """Raise BlfDscError if a column (N, k) has no numbers."""
    empty = np.flatnonzero(~np.isfinite(values).any(axis=0))
    if empty.size:
        raise BlfDscError(
            f'{path}: {names[int(empty[0])]!r} has no numbers: choose another column, as in '
            '--map tau=effort_*'
        )


def _scaled(values: Floats, columns: Sequence[Column]) -> Floats:
    return np.asarray(values * [column.factor for column in columns])


def _unnamed_unit(
    path: Path, columns: Sequence[Column], first: Floats, time: Floats
) -> float:
    """Return the factor of a time without a unit, by which stamps are of this century.

    Raises:
        BlfDscError: it is no time in seconds, but would be one in another unit.
    """
    if len(columns) > 1 or columns[0].factor != 1.0 or not first.size:
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
    stamps[known] = np.round(1e9 * continued).astype(np.int64)
    return stamps, starts.size + 1
