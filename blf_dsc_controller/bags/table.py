# SPDX-License-Identifier: Apache-2.0
"""Run as one table with a row per joint state, for spreadsheets, pandas and MATLAB."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
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
    topics.DISTURBANCE: 'N m',
    'viscous ': 'N m s/rad',
    **dict.fromkeys(('bias ', 'coulomb ', 'sin ', 'cos '), 'N m'),
    topics.POSITION: 'rad',
    topics.VELOCITY: 'rad/s',
    topics.RATIO: '1',
    topics.DISTANCE: 'rad',
    topics.LYAPUNOV: 'J',
    **dict.fromkeys((topics.LATCHED, topics.MODEL_CHANGES, topics.LATE_STEPS), '1'),
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
        values = run.at(field, rows)
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
    blocks = [slice(begin, begin + _ROWS) for begin in range(0, run.stamp.size, _ROWS)]
    unknown = tuple(f'{field} ' for field in _FIELDS if not _is_known(run, field, blocks))
    tables = (
        {name: one for name, one in table(run, rows).items() if not name.startswith(unknown)}
        for rows in blocks
    )
    return (_write_csv if path.suffix == '.csv' else _write_parquet)(tables, path)


def _is_known(run: RecordedRun, field: str, blocks: Iterable[slice]) -> bool:
    """Return whether any value of a field is known."""
    return any(
        values is not None and not np.isnan(values).all()
        for values in (run.at(field, rows) for rows in blocks)
    )


def described(path: Path) -> Path:
    """Return the path of a CSV's Frictionless data package: columns' names, types and units."""
    return path.with_suffix('.datapackage.json')


def _write_csv(tables: Iterable[dict[str, Column]], path: Path) -> int:
    columns: dict[str, Column] = {}
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        for block in tables:
            if not columns:
                writer.writerow(block)
            columns = block
            writer.writerows(zip(*(one.values.tolist() for one in block.values()), strict=True))
    fields = [
        {
            'name': name,
            'type': 'integer' if one.values.dtype.kind == 'i' else 'number',
            **({'unit': one.unit} if one.unit else {}),
        }
        for name, one in columns.items()
    ]
    resource = {
        'name': 'run',
        'path': path.name,
        'profile': 'tabular-data-resource',
        'schema': {'fields': fields, 'missingValues': ['', 'nan']},
    }
    text = json.dumps({'profile': 'tabular-data-package', 'resources': [resource]}, indent=1)
    described(path).write_text(text + '\n', encoding='utf-8')
    return len(columns)


def _write_parquet(tables: Iterable[dict[str, Column]], path: Path) -> int:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise MissingExtraError('pyarrow', 'parquet', 'writing Parquet') from None
    with ExitStack() as stack:
        schema = writer = None
        for block in tables:
            if writer is None:
                schema = pa.schema(
                    pa.field(
                        name,
                        pa.from_numpy_dtype(one.values.dtype),
                        metadata={'unit': one.unit} if one.unit else None,
                    )
                    for name, one in block.items()
                )
                writer = stack.enter_context(parquet.ParquetWriter(path, schema))
            arrays = [pa.array(one.values) for one in block.values()]
            writer.write_table(pa.table(arrays, schema=schema))
        return 0 if schema is None else len(schema)
