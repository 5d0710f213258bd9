# SPDX-License-Identifier: Apache-2.0
"""The folder of a study: what it is, and a file of results for each chunk of runs that is done.

    study.yaml       the whole configuration, a file that `monte_carlo --config` takes
    versions.json    what computed it
    runs/            Parquet files, named after the first and the last run in them

A file of results appears whole or not at all, so a study that was killed goes on with the runs
that have none.
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
from typing import NamedTuple

import numpy as np

import blf_dsc_controller
from blf_dsc_controller.compiled.jit import cache_folder
from blf_dsc_controller.monte_carlo.chunk import Columns
from blf_dsc_controller.monte_carlo.errors import (
    NoResultsError,
    NotAStudyError,
    OtherStudyError,
    StudyInUseError,
)
from blf_dsc_controller.monte_carlo.study import Study
from blf_dsc_controller.monte_carlo.study_file import load_study, write_study
from blf_dsc_controller.monte_carlo.table import read_tables, write_table

_STUDY = 'study.yaml'
_VERSIONS = 'versions.json'
_RUNS = 'runs'
_PART = re.compile(r'runs-(\d+)-(\d+)\.parquet')


class Span(NamedTuple):
    """Runs `first` to `first + runs - 1`."""

    first: int
    runs: int


def versions() -> dict[str, str]:
    """What the numbers depend on beside the configuration."""
    return {
        'blf_dsc_controller': blf_dsc_controller.__version__,
        'kernels': cache_folder().name,
        'numpy': np.__version__,
    }


class Store:
    """The folder of a study that is there.

    Attributes:
        folder: of the study.
        study: that its results belong to.
    """

    def __init__(self, folder: Path) -> None:
        """Open a study; NotAStudyError where there is none."""
        self.folder = folder
        if not (folder / _STUDY).is_file():
            raise NotAStudyError(folder)
        self.study = load_study(folder / _STUDY)

    @classmethod
    def create_or_open(cls, folder: Path, study: Study) -> Store:
        """Make the folder of a study, or open it where it is there, to go on.

        Raises:
            NotAStudyError: there is something else of that name.
            OtherStudyError: there is another study, or the same by another version.
        """
        if not os.path.lexists(folder):
            _create(folder, study)
        if not (folder / _STUDY).is_file():
            raise NotAStudyError(folder)
        differences = _differences(version_of(folder), versions())
        if differences:
            raise OtherStudyError(folder, differences)
        store = cls(folder)
        differences = _differences(store.study.flat(), study.flat())
        if differences:
            raise OtherStudyError(folder, differences)
        return store

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from writing into the folder; a lock ends with its process.

        Raises StudyInUseError where another process has it. What an earlier one has left
        unfinished is removed.
        """
        with (self.folder / _STUDY).open(encoding='utf-8') as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StudyInUseError(self.folder) from None
            for unfinished in (self.folder / _RUNS).glob('.runs-*'):
                unfinished.unlink()
            yield

    def keep(self, span: Span, columns: Columns) -> None:
        """Write the results of some runs."""
        last = span.first + span.runs - 1
        write_table(columns, self.folder / _RUNS / f'runs-{span.first:09d}-{last:09d}.parquet')

    def done(self) -> list[Span]:
        """Runs that have results, in their order."""
        found = (_PART.fullmatch(path.name) for path in (self.folder / _RUNS).iterdir())
        bounds = sorted((int(one[1]), int(one[2])) for one in found if one)
        return [Span(first, last - first + 1) for first, last in bounds]

    def missing(self, size: int) -> list[Span]:
        """Runs that have none, in chunks of at most `size`."""
        edges = [Span(0, 0), *self.done(), Span(self.study.settings.runs, 0)]
        return [
            Span(first, min(size, after.first - first))
            for before, after in pairwise(edges)
            for first in range(before.first + before.runs, after.first, size)
        ]

    def results(self) -> Columns:
        """Read all there is, a row for each run, in their order."""
        paths = sorted(
            path for path in (self.folder / _RUNS).iterdir() if _PART.fullmatch(path.name)
        )
        if not paths:
            raise NoResultsError(self.folder, 'results yet')
        return read_tables(paths)


def version_of(folder: Path) -> dict[str, str]:
    """What a study was begun with."""
    try:
        told: dict[str, str] = json.loads((folder / _VERSIONS).read_text(encoding='utf-8'))
    except (OSError, ValueError):
        raise NotAStudyError(folder) from None
    return told


def _create(folder: Path, study: Study) -> None:
    """Make the folder as a whole or not at all."""
    unfinished = folder.with_name(f'.{folder.name}.{os.getpid()}')
    shutil.rmtree(unfinished, ignore_errors=True)
    (unfinished / _RUNS).mkdir(parents=True)
    write_study(study, unfinished / _STUDY)
    told = json.dumps(versions(), indent=2) + '\n'
    (unfinished / _VERSIONS).write_text(told, encoding='utf-8')
    unfinished.rename(folder)


def _differences(
    there: Mapping[str, object], here: Mapping[str, object]
) -> dict[str, tuple[object, object]]:
    names = [*there, *(name for name in here if name not in there)]
    return {
        name: (there.get(name, 'nothing'), here.get(name, 'nothing'))
        for name in names
        if there.get(name) != here.get(name)
    }
