# SPDX-License-Identifier: Apache-2.0
"""Results of runs as Parquet files: one column for each figure, one row for each run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.errors import MissingExtraError
from blf_dsc_controller.monte_carlo.chunk import Columns
from blf_dsc_controller.monte_carlo.errors import UnreadablePartError


def require_pyarrow() -> Any:
    """Return pyarrow with what is used of it; MissingExtraError where it is not installed."""
    try:
        import pyarrow as pa
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError('pyarrow', 'monte-carlo', 'keeping the results') from None
    return pa


def write_table(columns: Columns, path: Path) -> None:
    """Write a file that is there as a whole or not at all, even if the process is killed."""
    pa = require_pyarrow()
    unfinished = path.with_name(f'.{path.name}.{os.getpid()}')
    with unfinished.open('wb') as file:
        pa.parquet.write_table(pa.table(columns), file)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)


def read_tables(paths: Sequence[Path]) -> Columns:
    """Read the rows of all files, in the order of the runs.

    Raises UnreadablePartError for a file that is no Parquet file, or has other columns.
    """
    pa = require_pyarrow()
    tables = []
    for path in paths:
        try:
            tables.append(pa.parquet.read_table(path))
        except (OSError, pa.ArrowException) as error:
            raise UnreadablePartError(path, str(error)) from error
        if tables[-1].column_names != tables[0].column_names:
            raise UnreadablePartError(path, f'its columns are not those of {paths[0].name}')
    whole = pa.concat_tables(tables).sort_by('run')
    return {name: np.asarray(whole[name].to_numpy()) for name in whole.column_names}
