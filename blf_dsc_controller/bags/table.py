# SPDX-License-Identifier: Apache-2.0
"""A run as a table, and as CSV or Parquet: for spreadsheets, pandas and MATLAB."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import import_extra
from blf_dsc_controller.messages import topics
from blf_dsc_controller.run import Run
from blf_dsc_controller.writing import writing

_ARRAYS = {  # of a run, with a column per joint: unit
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
    'load_friction ': '1',
    topics.POSITION: 'rad',
    topics.VELOCITY: 'rad/s',
    topics.DISTANCE: 'rad',
    **dict.fromkeys(
        (topics.RATIO, topics.LATCHED, topics.MODEL_CHANGES, topics.LATE_STEPS), '1'
    ),
    **dict.fromkeys((topics.COMPUTE_TIME, topics.LATENCY, topics.LATENESS), 's'),
    **dict.fromkeys(topics.CONTACT, '1'),
    **dict.fromkeys(topics.TOOL[:2], 'm'),
    **dict.fromkeys(topics.TOOL[2:], 'rad'),
    'load mass': 'kg',
    'load ': 'm',
}
_ROWS = 1 << 14  # of a block that is written at once
_PARAMETER = 'kg m^2'  # of arms without a URDF


def table(run: Run, rows: slice = slice(None)) -> dict[str, NDArray[Any]]:
    """Return some rows of every series of a run by name and unit.

    They are aligned to the stamps of its joint states. `stamp` and `received` are
    integers, all others floats, NaN where unknown, as is the reference's velocity
    between its messages. Named values (monitor, external, truth, timing) are held until
    the next message.
    """
    stamp = run.stamp[rows]
    columns: dict[str, NDArray[Any]] = {
        'stamp [ns]': stamp,
        'received [ns]': run.received[rows],
        'time [s]': run.time_of(stamp),
    }
    for field, unit in _ARRAYS.items():
        values = getattr(run, field)
        if values is not None:
            for joint, column in zip(run.joints, values[rows].T, strict=True):
                columns[f'{field} {joint} [{run.units(joint).of(unit)}]'] = column
    for topic in ('monitor', 'external', 'truth', 'timing'):
        series = getattr(run, topic)
        if series is not None:
            held = series.held(stamp, series.names)
            for name, column in zip(series.names, held.T, strict=True):
                unit = 'N m' if topic == 'external' else _unit(name, run)
                joint = name.removesuffix(topics.INTERVAL).rpartition(' ')[2]
                columns[f'{topic} {name} [{run.units(joint).of(unit)}]'] = column
    return columns


def _unit(name: str, run: Run) -> str:
    """Return the unit of a named value; parameters of a URDF have their own."""
    if run.arm is not None and name in run.arm.units:
        return run.arm.units[name] or '1'
    if name == topics.LAMBDA_MIN and run.arm is None:
        return 's^-4'
    known = [unit for beginning, unit in _VALUES.items() if name.startswith(beginning)]
    return known[0] if known else '1' if run.arm is not None else _PARAMETER


def check_format(path: Path) -> None:
    """Raise BlfDscError if the suffix of a table is neither .csv nor .parquet."""
    if path.suffix not in ('.csv', '.parquet'):
        raise BlfDscError(
            f'{path} ends in neither .csv nor .parquet: the file extension selects the format'
        )


def export(run: Run, path: Path) -> int:
    """Write the table as CSV or Parquet, by suffix; return the number of columns.

    It is written block by block: a run may be larger than memory. Numbers are read back
    exactly.

    Raises:
        BlfDscError: the suffix is neither .csv nor .parquet.
        MissingExtraError: pyarrow is not installed.
    """
    check_format(path)
    blocks = (slice(begin, begin + _ROWS) for begin in range(0, run.stamp.size, _ROWS))
    with writing(path) as part:
        (_write_csv if path.suffix == '.csv' else _write_parquet)(
            (table(run, rows) for rows in blocks), part
        )
    return len(table(run, slice(1)))


def _write_csv(tables: Iterator[dict[str, NDArray[Any]]], path: Path) -> None:
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        for k, block in enumerate(tables):
            if k == 0:
                writer.writerow(block)
            writer.writerows(
                zip(*(values.tolist() for values in block.values()), strict=True)
            )


def _write_parquet(tables: Iterator[dict[str, NDArray[Any]]], path: Path) -> None:
    pa = import_extra('pyarrow', 'parquet', 'writing Parquet')
    parquet = import_extra('pyarrow.parquet', 'parquet', 'writing Parquet')
    first = pa.table(next(tables))
    with parquet.ParquetWriter(path, first.schema) as writer:
        writer.write_table(first)
        for block in tables:
            writer.write_table(pa.table(block))
