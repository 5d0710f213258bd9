# SPDX-License-Identifier: Apache-2.0
"""A run as one table, a row for each joint state: for spreadsheets, pandas, MATLAB."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.bags.errors import UnknownFormatError
from blf_dsc_controller.errors import MissingExtraError
from blf_dsc_controller.run import Floats, Run, Series

Table = dict[str, Any]
"""Columns (N,) by name; `stamp` [ns] is of integers, all else of floats, NaN where unknown."""


def table(run: Run) -> Table:
    """Every series of a run aligned on the stamps of its joint states.

    What is published with each sample stands in the row of its stamp; what is published less often
    (truth, timing, monitor) is held until it is told again.
    """
    columns: Table = {'stamp': run.stamp, 'time': run.time}
    fields: dict[str, Floats | None] = {
        'position': run.position,
        'velocity': run.velocity,
        'torque': run.torque,
        'reference': run.reference,
        'error': run.error,
        'bound': run.bound,
        'torque_limit': run.torque_limit,
    }
    for field, values in fields.items():
        for i, joint in enumerate(run.joints if values is not None else ()):
            columns[f'{field} {joint}'] = np.asarray(values)[:, i]
    if run.learning is not None:
        columns |= _named('learning', run.learning, run.learning.exact(run.stamp))
    for topic, series in (('truth', run.truth), ('timing', run.timing), ('monitor', run.monitor)):
        if series is not None:
            columns |= _named(topic, series, series.held(run.stamp))
    return columns


def export(run: Run, path: Path) -> int:
    """Write the table as CSV or Parquet, by the ending of `path`; return the number of columns.

    Numbers are written such that they read back equal.

    Raises:
        UnknownFormatError: the ending is neither .csv nor .parquet.
        MissingExtraError: pyarrow is not installed.
    """
    columns = table(run)
    if path.suffix == '.csv':
        _write_csv(columns, path)
    elif path.suffix == '.parquet':
        _write_parquet(columns, path)
    else:
        raise UnknownFormatError(path)
    return len(columns)


def _named(topic: str, series: Series, values: Floats) -> Table:
    return {f'{topic} {name}': values[:, j] for j, name in enumerate(series.names)}


def _write_csv(columns: Table, path: Path) -> None:
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def _write_parquet(columns: Table, path: Path) -> None:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise MissingExtraError('pyarrow', 'parquet', 'writing Parquet') from None
    parquet.write_table(pa.table(columns), path)
