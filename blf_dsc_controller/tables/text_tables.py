# SPDX-License-Identifier: Apache-2.0
"""CSV and other text as tables: any separator, decimal commas, headers as people write them.

The names are those of the last line before the numbers with as many cells, which may be
a comment, and under which may be a line of units.  Without such a line, columns are
numbers.  What the tools of ROS print is recognised: `rostopic echo -p`, in which the
names of the joints are cells, and `ros2 topic echo --csv`, which has no header.

The file is read block by block, and only the columns that are asked for are kept.
"""

from __future__ import annotations

import csv
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE, getincrementaldecoder
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import compress, islice, zip_longest
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.tables.columns import is_time

_DELIMITERS = (';', '\t', ',')
_COMMENTS = ('#', '%')
_HEAD = 200  # lines, in which the numbers begin
_LONGEST = 1 << 20  # characters of a line
_BLOCK = 4096  # lines that are read at once
_DECIMAL_COMMA = re.compile(r'[+-]?\d*,\d+(?:[eE][+-]?\d+)?')
# 1.234,5 or 1,234.5 or 1 234,5, where a number must not be taken for a smaller one
_GROUPED = re.compile(
    r"""[+-]?\d{1,3}(?:([., '’\u00a0\u202f])\d{3})(?:\1\d{3})*[.,]\d+"""
)
_PACKED = {
    b'\x1f\x8b': 'gzip',
    b'PK\x03\x04': 'a zip archive or a spreadsheet',
    b'BZh': 'bzip2',
    b'\xfd7zXZ': 'xz',
    b'\x28\xb5\x2f\xfd': 'zstandard',
    b'\x89HDF': 'HDF5',
    b'PAR1': 'parquet',
}
_NUMBERED = re.compile(r'(.*)name\D?\d+\D?')
_FIELDS = ('position', 'velocity', 'effort')
_MINUS = '\u2212'  # of typesetting
_STAMP = 2  # cells of the stamp in `ros2 topic echo --csv`


class TextTable(NamedTuple):
    """A table in a text file."""

    path: Path
    names: tuple[str, ...]
    first: int  # line with numbers, from 0
    layout: _Layout

    def read(self, columns: Sequence[str]) -> Floats:
        """Return some columns (N, k); cells that are no numbers are NaN.

        Raises:
            BlfDscError: a line has another number of cells.
        """
        at = [self.names.index(name) for name in columns]
        with _opened(self.path) as stream:
            lines = _lines(stream, self.path)
            numbered = enumerate(lines, 1)
            rows = [
                self.layout.numbers(self.path, block, len(self.names), at)
                for block in _blocks(islice(numbered, self.first, None))
            ]
        return np.concatenate([np.zeros((0, len(at))), *rows])


class _Layout(NamedTuple):
    """How the cells of a line are separated; empty: by white space."""

    delimiter: str

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line."""
        if not self.delimiter:
            return line.split()
        try:
            cells = next(csv.reader([line], delimiter=self.delimiter), [])
        except csv.Error:  # of lines that are no text
            cells = line.split(self.delimiter)
        return [cell.strip() for cell in cells]

    def number(self, cell: str) -> float:
        """Return a cell as a number, NaN if it is none."""
        try:
            return float(self._with_points(cell))
        except ValueError:
            return float('nan')

    def numbers(
        self,
        path: Path,
        block: Sequence[tuple[int, str]],
        width: int,
        at: Sequence[int],
    ) -> Floats:
        """Return some columns (k, m) of numbered lines with so many cells."""
        mark = self.delimiter or None
        if all(len(line.split(mark)) == width for _, line in block):
            lines = [self._with_points(line) for _, line in block]
            with suppress(ValueError):  # cells that are empty or text
                return np.loadtxt(lines, delimiter=mark, usecols=at, ndmin=2)
        found = []
        for number, line in block:
            cells = self.cells(line)
            if len(cells) == width:
                _check_groups(path, number, [cells[k] for k in at])
                found.append([self.number(cells[k]) for k in at])
            elif number != block[-1][0]:  # a file may end within a line
                raise BlfDscError(
                    f'{path}, line {number}: got {len(cells)} cells, but the first lines have '
                    f'{width}: correct or remove it'
                )
        return np.array(found).reshape(-1, len(at))

    def _with_points(self, text: str) -> str:
        """Return numbers with decimal points instead of commas."""
        return text if self.delimiter == ',' else text.replace(',', '.')


def _check_groups(path: Path, number: int, cells: Sequence[str]) -> None:
    """Raise BlfDscError if numbers of a line have separators of thousands."""
    grouped = next(filter(_GROUPED.fullmatch, cells), None)
    if grouped:
        raise BlfDscError(
            f'{path}, line {number}: {grouped!r} has a separator of thousands: write numbers '
            'without it'
        )


def text_table(path: Path) -> TextTable:
    """Return a table in a text file.

    Raises:
        BlfDscError: it cannot be read, or has no numbers.
    """
    with _opened(path) as stream:
        head = list(islice(_lines(stream, path), _HEAD))
    first = next((k for k, line in enumerate(head) if _has_numbers(line)), None)
    if first is None:
        for number, line in enumerate(head, 1):
            _check_groups(path, number, _layout_of(line).cells(line))
        if not head:
            raise BlfDscError(f'{path} is empty: it has neither names nor numbers')
        raise BlfDscError(
            f'{path} has no numbers in its first {len(head)} lines, so it is no table: a '
            'row begins with a number, and dates and lists in cells are not read'
        )
    layout = _layout_of(head[first])
    cells = layout.cells(head[first])
    names = _ros2_names(cells) or _header(head[:first], layout, cells)
    rows = [layout.cells(line) for line in head[first:] if line.strip()]
    names = _named_once(names, rows)
    return TextTable(path, tuple(names), first, layout)


def _named_once(names: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the names, with numbers instead of those that several columns have.

    The first of times that are copies, as of two tables side by side, keeps its name.
    """
    columns = list(zip_longest(*rows))
    found = list(names)
    for name in (each for each, count in Counter(names).items() if count > 1):
        same = [k for k, each in enumerate(names) if each == name]
        are_copies = len({columns[k] for k in same}) == 1
        for k in same[1:] if are_copies and is_time(name) else same:
            found[k] = str(k)
    return found


def _opened(path: Path) -> TextIO:
    """Open a text file; raise BlfDscError if it is packed."""
    with path.open('rb') as raw:
        begin = raw.read(_LONGEST)
    for magic, packed in _PACKED.items():
        if begin.startswith(magic):
            raise BlfDscError(
                f'{path} is {packed}, not text: unpack it, or write it as CSV'
            )
    return path.open(encoding=_encoding_of(begin))


def _encoding_of(begin: bytes) -> str:
    """Return the encoding of a text that begins so: of spreadsheets, it may be any."""
    if begin.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return 'utf-16'
    try:
        getincrementaldecoder('utf-8')().decode(begin)
    except UnicodeDecodeError:
        return 'latin-1'
    return 'utf-8-sig'


def _lines(stream: TextIO, path: Path) -> Iterator[str]:
    """Yield the lines of a file."""
    try:
        while line := stream.readline(_LONGEST):
            if len(line) == _LONGEST:
                raise BlfDscError(f'{path} has a line of a million characters or more')
            yield line.rstrip('\n').replace(_MINUS, '-')
    except ValueError as error:
        raise BlfDscError(f'{path} cannot be read as text: {error}') from error


def _blocks(
    numbered: Iterator[tuple[int, str]],
) -> Iterator[list[tuple[int, str]]]:
    """Yield lines with their numbers, many at once, without comments and empty ones."""
    wanted = (
        each
        for each in numbered
        if each[1].strip() and not each[1].startswith(_COMMENTS)
    )
    while block := list(islice(wanted, _BLOCK)):
        yield block


def _layout_of(line: str) -> _Layout:
    """Return how the cells of the first line with numbers are separated."""
    words = line.split()
    if len(words) > 1 and all(map(_DECIMAL_COMMA.fullmatch, words)):
        return _Layout('')  # `1,5 2,5`: the commas are in the numbers
    return _Layout(next((mark for mark in _DELIMITERS if mark in line), ''))


def _has_numbers(line: str) -> bool:
    """Return whether most cells of a line, and its first one, are numbers or empty."""
    if not line.strip() or line.startswith(_COMMENTS):
        return False
    layout = _layout_of(line)
    cells = [cell.strip('"') for cell in layout.cells(line)]
    numbers = [bool(cell) and np.isfinite(layout.number(cell)) for cell in cells]
    return numbers[0] and 2 * sum(numbers) >= len([cell for cell in cells if cell])


def _header(before: Sequence[str], layout: _Layout, cells: Sequence[str]) -> list[str]:
    """Return the names of the columns, above whose first cells there are these lines."""
    fitting: list[list[str]] = []
    for line in reversed(before):
        if not line.strip():
            continue
        words = layout.cells(line.lstrip('#% \t'))
        # a separator may end the lines of the numbers only, or of the names only
        if len(words) == len(cells) - 1 and not cells[-1]:
            words.append('')
        elif len(words) == len(cells) + 1 and not words[-1]:
            words.pop()
        if len(words) != len(cells):
            break
        fitting.insert(0, [word.strip('"') for word in words])
    if not fitting:
        return [str(k) for k in range(len(cells))]
    names = fitting[0]
    if len(fitting) > 1:
        units = [word.strip('[](){} ') for word in fitting[1]]
        names = [
            f'{name} [{unit}]' if unit else name
            for name, unit in zip(names, units, strict=True)
        ]
    return _with_joints(names, cells)


def _with_joints(names: list[str], cells: Sequence[str]) -> list[str]:
    """Return names in which numbers are replaced by the joints, if cells name these.

    `field.name0` is such a cell, for `field.position0`.
    """
    found = list(names)
    for name, joint in zip(names, cells, strict=True):
        numbered = _NUMBERED.fullmatch(name)
        if numbered:
            prefix = numbered[1]
            for field in _FIELDS:
                value = name.replace(f'{prefix}name', f'{prefix}{field}')
                if value in names:
                    found[names.index(value)] = f'{prefix}{field} {joint}'
    return found


def _ros2_names(cells: Sequence[str]) -> list[str]:
    """Return the names of the cells of `ros2 topic echo --csv`; none if it is another table."""
    words = [not re.fullmatch(r'[-+.\deE]*|nan|-?inf', cell) for cell in cells]
    if len(cells) <= _STAMP or not any(words[_STAMP:]):
        return []
    is_stamp = all(cell.isdigit() for cell in cells[:_STAMP])
    joints = list(compress(cells[_STAMP + 1 :], words[_STAMP + 1 :]))
    first = _STAMP + 1 + len(joints)
    fields, rest = divmod(len(cells) - first, max(len(joints), 1))
    if not is_stamp or not joints or rest or fields != len(_FIELDS):
        return []
    names = ['stamp.sec', 'stamp.nanosec', 'frame_id']
    names += [f'name {joint}' for joint in joints]
    return names + [f'{field} {joint}' for field in _FIELDS for joint in joints]
