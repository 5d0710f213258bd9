# SPDX-License-Identifier: Apache-2.0
"""Run as one table with a row per joint state, for spreadsheets, pandas and MATLAB."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from blf_dsc_controller.bags.reader import RecordedRun
from blf_dsc_controller.errors import BlfDscError, MissingExtraError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.run import Run

_FIELDS = {  # fields of a run with a column per joint: unit
    'position': 'rad',
    'velocity': 'rad/s',
    'effort': 'N m',
    'torque': 'N m',
    'reference': 'rad',
    'reference_velocity': 'rad/s',
    'error': 'rad',
    'xi2': 'rad/s',
    'bound': 'rad',
    'torque_limit': 'N m',
}
_VALUES = {  # prefix of names in the vectors: unit
    **dict.fromkeys((topics.DISTURBANCE, 'bias ', 'coulomb ', 'sin ', 'cos '), 'N m'),
    'viscous ': 'N m s/rad',
    topics.POSITION: 'rad',
    topics.VELOCITY: 'rad/s',
    topics.DISTANCE: 'rad',
    topics.LYAPUNOV: 'J',
    **dict.fromkeys((topics.RATIO, topics.LATCHED, topics.MODEL_CHANGES, topics.LATE_STEPS), '1'),
    **dict.fromkeys((topics.COMPUTE_TIME, topics.LATENCY, topics.LATENESS), 's'),
}
_ROWS = 1 << 14
_PARAMETER = 'kg m^2'  # of arms without a URDF


class Column(NamedTuple):
    """Values (N,), NaN where unknown, and their unit, empty if they have none."""

    values: NDArray[Any]
    unit: str


def table(run: RecordedRun, rows: slice = slice(None)) -> dict[str, Column]:
    """Return some rows of every series of a run by name, aligned to the stamps of its joint states.

    `stamp` and `received` are integers, all others floats. Values published with each sample
    are in the row of its stamp; those published less often (truth, timing, monitor) are held until
    the next message.
    """
    stamp = run.stamp[rows]
    columns = {
        'stamp': Column(stamp, 'ns'),
        'received': Column(run.received[rows], 'ns'),
        'time': Column(run.time_of(stamp), 's'),
    }
    for field, unit in _FIELDS.items():
        values = run.at(field, rows) if run.holds(field) else None
        if values is not None:
            for i, joint in enumerate(run.joints):
                columns[f'{field} {joint}'] = Column(values[:, i], unit)
    for topic in ('learning', 'truth', 'timing', 'monitor'):
        series = getattr(run, topic)
        if series is not None:
            values = (series.exact if topic == 'learning' else series.held)(stamp)
            for j, name in enumerate(series.names):
                columns[f'{topic} {name}'] = Column(values[:, j], _unit(name, run))
    return columns


def _unit(name: str, run: Run) -> str:
    """Return the unit of a named value; parameters of a URDF have their own."""
    if name == topics.LAMBDA_MIN:
        return '' if run.arm is not None else 's^-4'
    if run.arm is not None and name in run.arm.units:
        return run.arm.units[name] or '1'
    known = [unit for beginning, unit in _VALUES.items() if name.startswith(beginning)]
    return known[0] if known else '' if run.arm is not None else _PARAMETER


def export(run: RecordedRun, path: Path) -> int:
    """Write the table as CSV or Parquet, by the suffix of `path`; return the number of columns.

    It is written block by block: a run may be larger than memory. Numbers are read back exactly.
    Units are field metadata in Parquet; those of a CSV are in the data package beside it (see
    `described`).

    Raises:
        BlfDscError: the suffix is neither .csv nor .parquet.
        MissingExtraError: pyarrow is not installed.
    """
    if path.suffix not in ('.csv', '.parquet'):
        raise BlfDscError(
            f'{path} ends in neither .csv nor .parquet: the file extension selects the format'
        )
    blocks = (slice(begin, begin + _ROWS) for begin in range(0, run.stamp.size, _ROWS))
    tables = (table(run, rows) for rows in blocks)
    return (_write_csv if path.suffix == '.csv' else _write_parquet)(tables, path)


def described(path: Path) -> Path:
    """Return the path of a CSV's Frictionless data package: columns' names, types and units."""
    return path.with_suffix('.datapackage.json')


def _write_csv(tables: Iterator[dict[str, Column]], path: Path) -> int:
    fields: list[dict[str, str]] = []
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        for block in tables:
            if not fields:
                writer.writerow(block)
                for name, (values, unit) in block.items():
                    type_ = 'integer' if values.dtype.kind == 'i' else 'number'
                    fields.append({'name': name, 'type': type_} | ({'unit': unit} if unit else {}))
            writer.writerows(zip(*(values.tolist() for values, _ in block.values()), strict=True))
    resource = {
        'name': 'run',
        'path': path.name,
        'profile': 'tabular-data-resource',
        'schema': {'fields': fields, 'missingValues': ['', 'nan']},
    }
    text = json.dumps({'profile': 'tabular-data-package', 'resources': [resource]}, indent=1)
    described(path).write_text(text + '\n', encoding='utf-8')
    return len(fields)


def _write_parquet(tables: Iterator[dict[str, Column]], path: Path) -> int:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise MissingExtraError('pyarrow', 'parquet', 'writing Parquet') from None
    first = next(tables)
    schema = pa.schema(
        pa.field(name, pa.from_numpy_dtype(values.dtype), metadata={'unit': unit} if unit else None)
        for name, (values, unit) in first.items()
    )
    with parquet.ParquetWriter(path, schema) as writer:
        for block in chain([first], tables):
            arrays = [pa.array(values) for values, _ in block.values()]
            writer.write_table(pa.table(arrays, schema=schema))
    return len(schema)
