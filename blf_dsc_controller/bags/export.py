# SPDX-License-Identifier: Apache-2.0
"""A run as one table, a row for each joint state: for spreadsheets, pandas, MATLAB."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from blf_dsc_controller.errors import BlfDscError, MissingExtraError
from blf_dsc_controller.run import Run

Table = dict[str, Any]
"""Columns (N,) by name; `stamp` [ns] is of integers, all else of floats, NaN where unknown."""


def table(run: Run) -> Table:
    """Every series of a run aligned on the stamps of its joint states.

    Values published with each sample are in the row of its stamp; those published less often
    (truth, timing, monitor) are held until the next message.
    """
    columns: Table = {'stamp': run.stamp, 'time': run.time}
    fields = ('position', 'velocity', 'torque', 'reference', 'error', 'bound', 'torque_limit')
    for field in fields:
        values = getattr(run, field)
        for i, joint in enumerate(run.joints if values is not None else ()):
            columns[f'{field} {joint}'] = values[:, i]
    for topic in ('learning', 'truth', 'timing', 'monitor'):
        series = getattr(run, topic)
        if series is not None:
            values = (series.exact if topic == 'learning' else series.held)(run.stamp)
            columns |= {f'{topic} {name}': values[:, j] for j, name in enumerate(series.names)}
    return columns


def export(run: Run, path: Path) -> int:
    """Write the table as CSV or Parquet, by the ending of `path`; return the number of columns.

    Numbers read back equal.

    Raises:
        BlfDscError: the ending is neither .csv nor .parquet.
        MissingExtraError: pyarrow is not installed.
    """
    columns = table(run)
    if path.suffix == '.csv':
        with path.open('w', encoding='utf-8', newline='') as stream:
            writer = csv.writer(stream)
            writer.writerow(columns)
            writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
    elif path.suffix == '.parquet':
        try:
            import pyarrow as pa
            from pyarrow import parquet
        except ImportError:
            raise MissingExtraError('pyarrow', 'parquet', 'writing Parquet') from None
        parquet.write_table(pa.table(columns), path)
    else:
        raise BlfDscError(
            f'{path} ends in neither .csv nor .parquet: name the file such that it tells its format'
        )
    return len(columns)
