# SPDX-License-Identifier: Apache-2.0
"""The folder of a study: its configuration, and a file of results for each finished chunk of runs.

    study.yaml       the whole configuration, a file that `blf_dsc monte-carlo --config` accepts
    versions.json    the versions that computed the results
    runs/            Parquet files, named after the first and the last run in them

Files of results are written atomically, so a study that was killed resumes with the runs that have
none.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import blf_dsc_controller
from blf_dsc_controller.compiled.jit import cache_folder
from blf_dsc_controller.errors import BlfDscError, MissingExtraError
from blf_dsc_controller.monte_carlo.runs import Columns
from blf_dsc_controller.monte_carlo.study import Study, load_study, write_study
from blf_dsc_controller.simulation.loop import run_loop

_STUDY = 'study.yaml'
_VERSIONS = 'versions.json'
_RUNS = 'runs'
_PART = re.compile(r'runs-(\d+)-(\d+)\.parquet')


class Span(NamedTuple):
    """Runs `first` to `first + runs - 1`."""

    first: int
    runs: int


def require_pyarrow() -> Any:
    """Return pyarrow with its Parquet module; raises MissingExtraError if it is not installed."""
    try:
        import pyarrow as pa
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError('pyarrow', 'monte-carlo', 'keeping the results') from None
    return pa


def versions() -> dict[str, str]:
    """Return the versions on which the numbers depend besides the configuration."""
    return {
        'blf_dsc_controller': blf_dsc_controller.__version__,
        'kernels': cache_folder(run_loop).name,
        'numpy': np.__version__,
    }


def differences(there: Mapping[str, object], here: Mapping[str, object]) -> str:
    """Return lines for a message, one for each value that differs; empty if none does."""
    names = [*there, *(name for name in here if name not in there)]
    pairs = ((name, there.get(name, 'nothing'), here.get(name, 'nothing')) for name in names)
    return ''.join(
        f'\n  - {name}: there {old}, here {new}'
        for name, old, new in pairs
        if old != new and (old == old or new == new)  # noqa: PLR0124 - NaN equals NaN here
    )


class Store:
    """The folder of a study, with the `study` that its results belong to.

    Raises BlfDscError if the folder holds no study.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            self._versions = json.loads((folder / _VERSIONS).read_text(encoding='utf-8'))
            if not (folder / _STUDY).is_file():
                raise FileNotFoundError
        except (OSError, ValueError):
            raise BlfDscError(
                f'{folder} exists already and holds no study: choose another folder'
                if os.path.lexists(folder)
                else f'{folder} does not exist: it should be the folder of a study'
            ) from None
        self.study = load_study(folder / _STUDY)

    @classmethod
    def create_or_open(cls, folder: Path, study: Study) -> Store:
        """Create the folder of a study, or open it to resume.

        Raises BlfDscError if it holds no study, another one, or the same by another version.
        """
        if not os.path.lexists(folder):
            _create(folder, study)
        store = cls(folder)
        different = differences(store._versions, versions())
        different = different or differences(store.study.flat(), study.flat())
        if different:
            raise BlfDscError(
                f'{folder} holds another study, which is neither resumed nor overwritten: '
                f'choose another folder, or make them equal:{different}'
            )
        return store

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from writing to the folder; the lock ends with its process.

        Removes unfinished files of an earlier process. Raises BlfDscError if it is locked already.
        """
        with (self.folder / _STUDY).open(encoding='utf-8') as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BlfDscError(
                    f'another monte-carlo is running in {self.folder}: wait for it, or end it'
                ) from None
            for unfinished in (self.folder / _RUNS).glob('.runs-*'):
                unfinished.unlink()
            yield

    def keep(self, span: Span, columns: Columns) -> None:
        """Write the results of a span of runs atomically, even if the process is killed."""
        pa = require_pyarrow()
        last = span.first + span.runs - 1
        path = self.folder / _RUNS / f'runs-{span.first:09d}-{last:09d}.parquet'
        unfinished = path.with_name(f'.{path.name}.{os.getpid()}')
        with unfinished.open('wb') as file:
            pa.parquet.write_table(pa.table(columns), file)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)

    def done(self) -> list[Span]:
        """Return the runs that have results, in order."""
        found = (_PART.fullmatch(path.name) for path in (self.folder / _RUNS).iterdir())
        bounds = sorted((int(one[1]), int(one[2])) for one in found if one)
        return [Span(first, last - first + 1) for first, last in bounds]

    def missing(self, size: int) -> list[Span]:
        """Return the runs without results, in chunks of at most `size`."""
        edges = [Span(0, 0), *self.done(), Span(self.study.settings.runs, 0)]
        return [
            Span(first, min(size, after.first - first))
            for before, after in pairwise(edges)
            for first in range(before.first + before.runs, after.first, size)
        ]

    def results(self) -> Columns:
        """Read all results, one row per run, in order.

        Raises BlfDscError if there are none yet, or if a file is damaged.
        """
        pa = require_pyarrow()
        paths = sorted(
            path for path in (self.folder / _RUNS).iterdir() if _PART.fullmatch(path.name)
        )
        if not paths:
            raise BlfDscError(f'{self.folder} has no results yet')
        tables = []
        for path in paths:
            problem = ''
            try:
                tables.append(pa.parquet.read_table(path))
                if tables[-1].column_names != tables[0].column_names:
                    problem = f'its columns are not those of {paths[0].name}'
            except (OSError, pa.ArrowException) as error:
                problem = str(error)
            if problem:
                raise BlfDscError(
                    f'{path} cannot be read ({problem}): remove it and start the study again '
                    'to recompute these runs'
                )
        whole = pa.concat_tables(tables).sort_by('run')
        return {name: np.asarray(whole[name].to_numpy()) for name in whole.column_names}


def _create(folder: Path, study: Study) -> None:
    """Create the folder atomically."""
    unfinished = folder.with_name(f'.{folder.name}.{os.getpid()}')
    shutil.rmtree(unfinished, ignore_errors=True)
    (unfinished / _RUNS).mkdir(parents=True)
    write_study(study, unfinished / _STUDY)
    text = json.dumps(versions(), indent=2) + '\n'
    (unfinished / _VERSIONS).write_text(text, encoding='utf-8')
    unfinished.rename(folder)
