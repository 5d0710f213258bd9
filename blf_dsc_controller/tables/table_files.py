# SPDX-License-Identifier: Apache-2.0
"""Files of tables: names of columns, and values that are read when they are asked for.

The columns of npz, mat and HDF5 files are their vectors, and the columns of their matrices, each
named after its matrix and its index.  Only the longest columns are kept.  Lists in the cells
of Parquet and Feather files are rows of such matrices.

Files are not trusted: what they unpack to has a limit.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from os import SEEK_CUR
from pathlib import Path
from struct import Struct
from typing import Any
from zipfile import ZipFile

import numpy as np

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import import_extra
from blf_dsc_controller.run import Floats
from blf_dsc_controller.tables.text_tables import TextTable, text_table

_MOST = 1 << 28  # bytes that an array, or a mat file, may have, unpacked
_BYTES = 8  # of a number
_MOST_ARRAYS = 10_000
_TAG = Struct('<II')  # type and bytes of an element of a mat file
_HEADER = 128  # bytes of a mat file
_COMPRESSED = 15  # type of an element
_WITH_COMPRESSION, _HDF5 = 1, 2  # major versions of mat files
_AT_ONCE = 1 << 20  # bytes


def open_table(path: Path) -> Table:
    """Return the table of a file with one of the suffixes of `TABLES`.

    Raises:
        BlfDscError: it cannot be read as such.
    """
    with _named_errors(path):
        _check_regular(path)
        return _TABLES[path.suffix.lower()](path)


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    """Raise each error as a BlfDscError: libraries raise nearly anything on damaged files."""
    try:
        yield
    except BlfDscError:
        raise
    except Exception as error:
        text = getattr(error, 'strerror', '') or str(error)
        reason = ' '.join(text.split()) or type(error).__name__
        kind = path.suffix.lower()[1:]
        raise BlfDscError(f'{path} cannot be read as {kind}: {reason}') from error


def _check_regular(path: Path) -> None:
    """Raise BlfDscError if there is something else than a file."""
    if path.exists() and not path.is_file():
        raise BlfDscError(f'{path} is not a regular file, so it is no table')


class _Arrays:
    """Columns of arrays, of which each is loaded when it is asked for.

    Attributes:
        names: of the columns.
    """

    def __init__(
        self,
        path: Path,
        shapes: Mapping[str, tuple[int, ...]],
        load: Callable[[str], Any],
    ) -> None:
        """Take the shapes of arrays by name; others than vectors and matrices are left out."""
        self._path = path
        self._load = load
        self._columns: dict[str, tuple[str, int]] = {}
        squeezed = {
            name: [n for n in shape if n != 1] for name, shape in shapes.items()
        }
        vectors = {name: n for name, n in squeezed.items() if 0 < len(n) <= 2}
        longest = max((max(n) for n in vectors.values()), default=0)
        for name, n in vectors.items():
            if max(n) == longest:
                columns = [name]
                if len(n) > 1:
                    columns = [f'{name}_{k}' for k in range(min(n))]
                self._columns |= {each: (name, k) for k, each in enumerate(columns)}
        self.names = tuple(self._columns)

    def read(self, columns: Sequence[str]) -> Floats:
        """Return some columns (N, k)."""
        loaded: dict[str, Floats] = {}
        found = []
        for column in columns:
            name, k = self._columns[column]
            if name not in loaded:
                with _named_errors(self._path):
                    loaded[name] = _upright(self._load(name))
            found.append(loaded[name][:, k])
        return np.column_stack(found)


Table = TextTable | _Arrays
"""Columns of one length, by name."""


def _upright(values: Any) -> Floats:
    """Return a vector or matrix as columns (N, k), of which N is the larger."""
    found = np.atleast_2d(np.squeeze(np.asarray(values)))
    if found.shape[0] < found.shape[1]:
        found = found.T
    return found.astype(np.float64, copy=False)


def _npz(path: Path) -> _Arrays:
    shapes: dict[str, tuple[int, ...]] = {}
    with ZipFile(path) as archive:
        members = [name for name in archive.namelist() if name.endswith('.npy')]
        for member in members[:_MOST_ARRAYS]:
            with archive.open(member) as stream:
                shape, kind = _header_of_npy(stream)
            if kind in 'fiu':
                shapes[member.removesuffix('.npy')] = shape

    def load(name: str) -> Any:
        _check_size(path, _size_of(shapes[name]))
        with np.load(path) as archive:
            return archive[name]

    return _Arrays(path, shapes, load)


def _header_of_npy(stream: Any) -> tuple[tuple[int, ...], str]:
    """Return the shape of an array, and the kind of its numbers."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_2_0
    if version == (1, 0):
        read = np.lib.format.read_array_header_1_0
    shape, _, dtype = read(stream)
    return shape, dtype.kind


def _check_size(path: Path, size: int) -> None:
    """Raise BlfDscError if so many bytes would be unpacked that they may be an attack."""
    if size > _MOST:
        raise BlfDscError(
            f'{path} unpacks to {size / 1e9:.2g} GB or more; at most {_MOST / 1e9:.2g} GB of an '
            'array are read: write it as several files, all of which can be given'
        )


def _mat(path: Path) -> _Arrays:
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import matfile_version

    major, _ = matfile_version(path)
    if major == _HDF5:
        return _hdf5(path)
    if major == _WITH_COMPRESSION:
        for size in _unpacked_sizes(path):
            _check_size(path, size)
    for _, shape, _ in whosmat(path):
        _check_size(path, _size_of(shape))
    arrays = dict(_numbers_in(loadmat(path, simplify_cells=True)))
    shapes = {name: values.shape for name, values in arrays.items()}
    return _Arrays(path, shapes, arrays.__getitem__)


def _hdf5(path: Path) -> _Arrays:
    """Return the data sets of numbers, in groups or not; none that are in other files."""
    h5py = import_extra('h5py', 'hdf5', f'reading {path.name}')
    places: dict[str, str] = {}
    shapes: dict[str, tuple[int, ...]] = {}

    def note(place: str, item: Any) -> None:
        is_here = isinstance(item, h5py.Dataset) and not (
            item.external or item.is_virtual
        )
        if (
            is_here
            and item.dtype.kind in 'fiu'
            and item.shape
            and len(shapes) < _MOST_ARRAYS
        ):
            name = place.replace('/', '_')
            name = place if name in places else name
            places[name], shapes[name] = place, item.shape

    with h5py.File(path) as file:
        file.visititems(note)

    def load(name: str) -> Any:
        _check_size(path, _size_of(shapes[name]))
        with h5py.File(path) as file:
            return file[places[name]][()]

    return _Arrays(path, shapes, load)


def _size_of(shape: tuple[int, ...]) -> int:
    """Return the bytes of an array of floats."""
    return prod(shape) * _BYTES


def _unpacked_sizes(path: Path) -> Iterator[int]:
    """Yield, ever larger, how many bytes the compressed elements of a file unpack to."""
    size = 0
    with path.open('rb') as stream:
        stream.seek(_HEADER)
        while len(tag := stream.read(_TAG.size)) == _TAG.size:
            kind, length = _TAG.unpack(tag)
            if kind != _COMPRESSED:
                stream.seek(length, SEEK_CUR)
                continue
            unpack = zlib.decompressobj()
            packed = stream.read(min(length, _MOST))
            while packed and not unpack.eof:
                size += len(unpack.decompress(packed, _AT_ONCE))
                packed = unpack.unconsumed_tail
                yield size


def _numbers_in(
    content: Mapping[str, Any], prefix: str = ''
) -> Iterator[tuple[str, Any]]:
    """Yield the arrays of numbers of a mat file, which may be in structures."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _numbers_in(value, f'{prefix}{name}_')
            continue
        values = np.asarray(value)
        if values.dtype.kind in 'fiu':
            yield prefix + name, values


def _arrow(path: Path) -> _Arrays:
    arrow = import_extra('pyarrow', 'parquet', f'reading {path.name}')
    dataset = import_extra('pyarrow.dataset', 'parquet', f'reading {path.name}')
    table = dataset.dataset(path, format=path.suffix.lower()[1:])
    rows = table.count_rows()

    def load(name: str) -> Any:
        _check_size(path, _size_of(shapes[name]))
        column = table.to_table(columns=[name]).column(0).combine_chunks()
        if len(shapes[name]) > 1:
            column = column.flatten()
        return column.to_numpy(zero_copy_only=False).reshape(shapes[name])

    shapes: dict[str, tuple[int, ...]] = {}
    for field in table.schema:
        number = getattr(field.type, 'value_type', field.type)
        if not (arrow.types.is_floating(number) or arrow.types.is_integer(number)):
            continue
        shapes[field.name] = (rows,)
        if number != field.type:
            first = table.head(1, columns=[field.name]).column(0)
            shapes[field.name] = rows, len(first[0])
    return _Arrays(path, shapes, load)


_TABLES: dict[str, Callable[[Path], Table]] = {
    '.csv': text_table,
    '.tsv': text_table,
    '.txt': text_table,
    '.npz': _npz,
    '.mat': _mat,
    '.h5': _hdf5,
    '.hdf5': _hdf5,
    '.parquet': _arrow,
    '.feather': _arrow,
}

TABLES = tuple(_TABLES)
"""Suffixes of tables."""
