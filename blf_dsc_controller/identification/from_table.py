# SPDX-License-Identifier: Apache-2.0
"""Recordings from tables: CSV and text with or without a header, npz, and mat.

A table needs the time, and a position and a torque of each joint.  Which columns they
are is found from their names, or given: `time=t`, `q=pos_*`, `tau=6:12` (columns 6 to
11), `time=100Hz` if no column has the time.  The columns of npz and mat files are their
vectors, and those of matrices, in which each is named after its matrix with its index.

Velocities are not read: `windows` computes them from the positions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.recording import Recording, resampled
from blf_dsc_controller.run import Floats

_CURRENTS = {'current', 'currents'}
_WORDS = {
    'time': {'t', 'time', 'times', 'timestamp', 'stamp', 'secs', 'seconds'},
    'q': {'q', 'pos', 'position', 'positions', 'angle', 'angles', 'jointposition'},
    'tau': {
        *('tau', 'torque', 'torques', 'effort', 'efforts', 'force', 'trq'),
        *('jointtorque', *_CURRENTS),
    },
}
_SIDES = {
    *('d', 'des', 'desired', 'target', 'ref', 'reference', 'cmd', 'command'),
    *('ext', 'external', 'error', 'err', 'offset'),
}
_UNITS = {'ns': 1e-9, 'us': 1e-6, 'ms': 1e-3}
_RATE = re.compile(r'([\d.]+)\s*Hz', re.IGNORECASE)
_RANGE = re.compile(r'(\d+):(\d+)')
_DELIMITERS = (',', ';', '\t')
_LEAST = 2  # rows

Table = Mapping[str, Floats]
"""Columns (N,) by name."""


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
    many of them as the table has.  `names.joints` may have `time`, `q` and `tau`, as
    above, and the joints' names.

    Raises:
        BlfDscError: the file cannot be read, or its columns are not found.
    """
    table = _TABLES[path.suffix.lower()](path)
    if min((column.size for column in table.values()), default=0) < _LEAST:
        raise BlfDscError(f'{path} has fewer than {_LEAST} rows of numbers')
    arm = tuple(joints) or Tree.of(text).trunk()
    given = dict(names.joints)
    wanted = {kind: given.pop(kind, '') for kind in _WORDS}
    chosen = _chosen(path, table, wanted, NameMap(joints=given).joints_of(arm), planned)
    n = len(chosen.q)
    if joints and n != len(arm):
        raise BlfDscError(
            f'{path} has the positions of {n} joints ({", ".join(chosen.q)}), but from base to '
            f'tip there are {len(arm)}: {", ".join(arm)}'
        )
    time = _time(path, table, wanted['time'], chosen.q[0])
    stamp = np.round(1e9 * time).astype(np.int64)
    q = _stacked(table, chosen.q)
    torque = np.zeros_like(q) if planned else _stacked(table, chosen.tau)
    source = f'{path.name}: {chosen.text}'
    recording = resampled(arm[:n], stamp, q, torque, source)
    return recording._replace(currents=chosen.has_currents)


class _Chosen(NamedTuple):
    """Columns of the positions and torques; a planned motion has no torques."""

    q: list[str]
    tau: list[str]
    has_currents: bool  # by the names of the torques

    @property
    def text(self) -> str:
        """The columns, as they are reported."""
        positions = f'positions {self.q[0]!r} to {self.q[-1]!r}'
        if not self.tau:
            return positions
        return f'{positions}, torques {self.tau[0]!r} to {self.tau[-1]!r}'


def _chosen(
    path: Path,
    table: Table,
    wanted: Mapping[str, str],
    joints: Sequence[str],
    planned: bool,  # noqa: FBT001 - of `read_table`
) -> _Chosen:
    """Return the columns of the joints, which have these names in the table."""
    q = _columns(path, table, 'q', wanted['q'], joints)
    if planned:
        return _Chosen(q, [], has_currents=False)
    tau = _columns(path, table, 'tau', wanted['tau'], joints)
    if len(tau) != len(q):
        raise BlfDscError(
            f'{path} has {len(q)} positions ({", ".join(q)}) and {len(tau)} torques '
            f'({", ".join(tau)}): choose as many, as in --map tau=tau_*'
        )
    words = set().union(*(_meaning(name, joints) for name in tau))
    return _Chosen(q, tau, has_currents=bool(words & _CURRENTS))


def _stacked(table: Table, columns: Sequence[str]) -> Floats:
    return np.column_stack([table[name] for name in columns])


def _columns(
    path: Path, table: Table, kind: str, given: str, joints: Sequence[str]
) -> list[str]:
    """Return the columns of the positions or torques, in the order of the joints."""
    if given:
        found = _matching(table, given)
    else:
        words = _WORDS[kind]
        found = [name for name in table if words & _meaning(name, joints)]
    named = [_of_joint(found, joint) for joint in joints]
    if all(named):
        return [name for name in named if name]
    if found and len(found) <= len(joints):
        return found
    raise BlfDscError(
        f'{path}: which columns are {kind} of {", ".join(joints)} is not clear. Its columns are '
        f'{_listed(list(table))}: choose them, as in --map {kind}={kind}_* or --map {kind}=1:7 '
        '(columns 1 to 6, the first is 0)'
    )


def _of_joint(columns: Sequence[str], joint: str) -> str | None:
    """Return the column of a joint, which has its name; None if there is not exactly one."""
    own = [name for name in columns if re.search(rf'(?<!\w){re.escape(joint)}', name)]
    own = own or [name for name in columns if joint in name]
    return own[0] if len(own) == 1 else None


def _matching(table: Table, given: str) -> list[str]:
    """Return the columns by a range of numbers, or a pattern of names."""
    names = list(table)
    numbers = _RANGE.fullmatch(given)
    if numbers:
        return names[int(numbers[1]) : int(numbers[2])]
    return [name for name in names if fnmatchcase(name, given)]


def _meaning(column: str, joints: Sequence[str]) -> set[str]:
    """Return the words of a column's name besides a joint's; none if it is not measured."""
    for joint in sorted(joints, key=len, reverse=True):
        column = column.replace(joint, ' ')
    words = set(
        re.findall('[a-z]+', re.sub('([a-z])([A-Z])', r'\1 \2', column).lower())
    )
    return set() if words & _SIDES else words


def _time(path: Path, table: Table, given: str, example: str) -> Floats:
    """Return the time (N,) [s]."""
    rate = _RATE.fullmatch(given)
    if rate:
        return np.arange(table[example].size) / float(rate[1])
    if given:
        found = _matching(table, given)
    else:
        found = [name for name in table if _WORDS['time'] & _meaning(name, ())]
    if len(found) != 1:
        raise BlfDscError(
            f'{path}: which column is the time is not clear. Its columns are '
            f'{_listed(list(table))}: choose it, as in --map time=t, or give the rate of the rows, '
            'as in --map time=100Hz'
        )
    unit = next((_UNITS[word] for word in found[0].split('_') if word in _UNITS), 1.0)
    return np.asarray((table[found[0]] - table[found[0]][0]) * unit)


def _read_csv(path: Path) -> Table:
    """Read a CSV or text file; the columns of one without a header are numbers."""
    try:
        lines = path.read_text(encoding='utf-8-sig').splitlines()
    except (OSError, ValueError) as error:
        raise BlfDscError(f'{path} cannot be read: {error}') from error
    lines = [line for line in lines if line.strip() and not line.startswith('#')]
    first = lines[0] if lines else ''
    delimiter = next((mark for mark in _DELIMITERS if mark in first), None)
    words = [word.strip().strip('"') for word in first.split(delimiter)]
    has_header = not all(_is_number(word) for word in words)
    if not has_header:
        words = [str(k) for k in range(len(words))]
    if len(set(words)) < len(words):
        raise BlfDscError(f'{path}: two columns have one name: {_listed(words)}')
    try:
        values = np.genfromtxt(lines[has_header:], delimiter=delimiter, ndmin=2)
    except ValueError as error:
        raise BlfDscError(f'{path} is no table of numbers: {error}') from error
    if values.shape[1] != len(words):
        raise BlfDscError(
            f'{path} has {len(words)} columns in its first line, and {values.shape[1]} below'
        )
    return dict(zip(words, values.T, strict=True))


def _read_npz(path: Path) -> Table:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return _flat(dict(arrays))
    except (OSError, ValueError) as error:
        raise BlfDscError(f'{path} cannot be read as npz: {error}') from error


def _read_mat(path: Path) -> Table:
    from scipy.io import loadmat

    try:
        return _flat(loadmat(path, simplify_cells=True))
    except NotImplementedError as error:
        raise BlfDscError(
            f"{path} is HDF5: write it again by MATLAB's save('FILE', '-v7')"
        ) from error
    except (OSError, ValueError, TypeError) as error:
        raise BlfDscError(f'{path} cannot be read as mat: {error}') from error


def _flat(arrays: Mapping[str, Any], prefix: str = '') -> dict[str, Floats]:
    """Return the longest columns of arrays, which may be in structures."""
    found: dict[str, Floats] = {}
    for name, value in arrays.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f'{prefix}{name}_')
            continue
        values = np.squeeze(np.asarray(value))
        if values.dtype.kind not in 'fiu' or values.ndim not in {1, 2}:
            continue
        if values.ndim == 1:
            found[prefix + name] = values.astype(float)
            continue
        if values.shape[0] < values.shape[1]:
            values = values.T
        for k, column in enumerate(values.T):
            found[f'{prefix}{name}_{k}'] = column.astype(float)
    longest = max((column.size for column in found.values()), default=0)
    return {name: each for name, each in found.items() if each.size == longest}


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _listed(names: Sequence[str]) -> str:
    return ', '.join(names)


_TABLES: dict[str, Callable[[Path], Table]] = {
    '.csv': _read_csv,
    '.txt': _read_csv,
    '.npz': _read_npz,
    '.mat': _read_mat,
}

TABLES = tuple(_TABLES)
"""Suffixes of tables."""
