# SPDX-License-Identifier: Apache-2.0
"""Runs of a Monte Carlo study: figures, folder and workers.

The folder of a study:

    study.yaml       the whole configuration, a file that `blf_dsc monte-carlo --config` accepts
    versions.json    the versions that computed the results
    runs/            Parquet files, named after the first and the last run in them

Files of results are written atomically, so a study that was killed resumes with the
runs that have none. The workers are any `concurrent.futures.Executor`: processes of
this machine, or a dask.distributed cluster. Both give the same results.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    ProcessPoolExecutor,
    as_completed,
)
from contextlib import contextmanager
from dataclasses import replace
from math import nan
from multiprocessing import connection
from pathlib import Path
from typing import Any

import numpy as np

import blf_dsc_controller
from blf_dsc_controller.analysis.output import write_json
from blf_dsc_controller.compiled.kernel_cache import cache_folder
from blf_dsc_controller.configuration.nodes import dump
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.errors import BlfDscError, StartError
from blf_dsc_controller.extras import import_extra
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.law.perception import sense
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.law.state import Sample
from blf_dsc_controller.law.step import advance, update
from blf_dsc_controller.messages.journal import Journal
from blf_dsc_controller.reference.approach import MotionError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import Record, new_record, run_alone
from blf_dsc_controller.studies.distributions import Drawn
from blf_dsc_controller.studies.monte_carlo import (
    Study,
    draw,
    load_study,
    plant_with,
    torque_error,
)
from blf_dsc_controller.writing import whole
from sim_plant.elastic import run_elastic_plant
from sim_plant.kernels import run_plant
from sim_plant.plant import plant_of
from sim_plant.settings import parameter_order

KEPT = 'kept'
VIOLATED = 'violated'
DIVERGED = 'diverged'
REJECTED = 'rejected'
OUTCOMES = (KEPT, VIOLATED, DIVERGED, REJECTED)
"""What may become of a run; the controller may reject its start."""

Row = dict[str, Drawn]
Columns = dict[str, np.ndarray]
"""Results by column name, one entry per run."""

_STUDY = 'study.yaml'
_VERSIONS = 'versions.json'
_RUNS = 'runs'
_CHUNKS = 200  # of a study, unless they would be of more than so many runs
_MAX_RUNS_OF_CHUNK = 1000
_LOST = (
    'a worker was lost ({}): is there enough memory? The same command resumes the study, since '
    'finished runs are kept'
)


def run_chunk(study: Study, first: int, count: int) -> Columns:
    """Compute runs `first` to `first + count - 1`.

    All runs share one record of each law, which takes nearly all of the memory. The
    result depends on the arguments alone, and no file is written.
    """
    records = {
        prefix: new_record(controller_of(config), config, study.plant, Journal())
        for prefix, config in study.laws().items()
    }
    rows = [_run(study, run, records) for run in range(first, first + count)]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def warm_up(study: Study) -> None:
    """Compile what the workers run, so that they find it in the cache."""
    plant = replace(study.plant, duration=study.plant.sample_time)
    settings = replace(study.settings, settled_after=0.0)
    run_chunk(replace(study, plant=plant, settings=settings), 0, 1)


def figures_of(study: Study, record: Record, plant: PlantConfig) -> Row:
    """Return the columns of a run from its record; NaN for events that did not happen.

    Nothing counts from the first number on that is not finite.
    """
    law = record.controller.settings
    samples = sample_columns(record.samples, law)
    finite = np.isfinite(record.measurements).all(axis=1)
    finite &= np.isfinite(samples.torque).all(axis=1)
    end = finite.size if finite.all() else int(finite.argmin())
    samples = Sample(*(each[:end] for each in samples))
    effort = np.abs(record.measurements[:end, 2 * law.n :])
    error = np.abs(samples.xi1)
    settled = round(study.settings.settled_after / plant.sample_time)
    return {
        **_events(record, samples, plant),
        **_of_joints(study.plant.joints, error, samples.bound, effort, settled),
        **_learned(study, record, plant, end),
    }


def _events(record: Record, samples: Sample, plant: PlantConfig) -> Row:
    """Return how a run ended, when it left its bound and latched, and how often it saturated."""
    t = record.stamps * 1e-9
    end = len(samples.xi1)
    outside = np.flatnonzero((np.abs(samples.xi1) >= samples.bound).any(axis=1))
    latch = np.flatnonzero(samples.latched)
    outcome = VIOLATED if outside.size else KEPT
    violation = t[outside[0]] if outside.size else nan
    if end < t.size:
        outcome = DIVERGED
        violation = t[outside[0] if outside.size else end]
    limit = record.controller.settings.torque.limit
    motors = np.array(plant.actuator.torque_limit)  # 0: as strong as the law assumes
    limit = np.where(motors > 0.0, np.minimum(limit, motors), limit)
    is_cut = (np.abs(samples.torque) >= limit).any(axis=1)
    return {
        'outcome': outcome,
        'first_violation_s': float(violation),
        'latch_time_s': float(t[latch[0]]) if latch.size else nan,
        'saturated_fraction': float(is_cut.mean()) if is_cut.size else nan,
    }


def _of_joints(
    joints: Sequence[str], error: Floats, bound: Floats, effort: Floats, settled: int
) -> Row:
    """Return errors [rad] and peak torque [N m] of each joint, from |xi1|, k and |tau| (N, n)."""
    row: Row = {}
    for i, joint in enumerate(joints):
        ratio = error[:, i] / bound[:, i]
        late = error[settled:, i]
        rms = float(np.sqrt(np.mean(late**2))) if late.size else nan
        settled_ratio = float(ratio[settled:].max()) if late.size else nan
        row[f'max_error_ratio.{joint}'] = float(ratio.max(initial=0.0))
        row[f'settled_error_ratio.{joint}'] = settled_ratio
        row[f'rms_error_rad.{joint}'] = rms
        row[f'peak_torque_nm.{joint}'] = float(effort[:, i].max(initial=0.0))
    return row


def _learned(study: Study, record: Record, plant: PlantConfig, end: int) -> Row:
    """Return how wrong the parameters are at the end, and their torques on an unseen motion."""
    row: Row = {'parameter_error.end': nan, 'torque_error.end': nan}
    law = record.controller.settings
    order = parameter_order(law.model.parameter_names, plant)
    if order.min() < 0:
        return row
    found = sample_columns(record.samples, law).estimate[-1, : law.p]
    P = record.truths[-1, order]
    if end == record.stamps.size:
        row['parameter_error.end'] = float(
            np.linalg.norm(found - P) / np.linalg.norm(P)
        )
    if study.unseen is not None:
        row['torque_error.end'] = torque_error(study.unseen, found, P)
    return row


def _run(study: Study, run: int, records: dict[str, Record]) -> Row:
    row = draw(study, run)
    for prefix, record in records.items():
        config = plant_with(study, row, prefix)
        plant = plant_of(config)
        record.controller.reset()
        with np.errstate(all='ignore'):  # a run that diverges has figures too
            try:
                run_alone(record, plant, perceives=False)
                found = figures_of(study, record, config)
            except (StartError, MotionError):  # the record is that of the run before
                found = dict.fromkeys(figures_of(study, record, config), nan)
                found |= {'outcome': REJECTED, 'first_violation_s': 0.0}
        row |= {f'{prefix}{name}': value for name, value in found.items()}
    return row


def require_pyarrow() -> Any:
    """Return pyarrow with its Parquet module; raises as `import_extra`."""
    import_extra('pyarrow.parquet', 'monte-carlo', 'keeping the results')
    return import_extra('pyarrow', 'monte-carlo', 'keeping the results')


def versions() -> dict[str, str]:
    """Return what must be equal to resume a study, besides the configuration."""
    return {
        'blf_dsc_controller': blf_dsc_controller.__version__,
        'kernels': ' '.join(
            cache_folder(each).name
            for each in (update, advance, sense, run_plant, run_elastic_plant)
        ),
        'numpy': np.__version__,
        # `missing` goes by the names of the chunks
        'chunks': f'{_CHUNKS} of at most {_MAX_RUNS_OF_CHUNK} runs',
    }


def differences(there: dict[str, Any], here: dict[str, Any]) -> str:
    """Return a line for each value that differs; empty if none does."""
    pairs = {
        name: (there.get(name, 'nothing'), here.get(name, 'nothing'))
        for name in there | here
    }
    return ''.join(
        f'\n  - {name}: there {old}, here {new}'
        for name, (old, new) in pairs.items()
        if old != new and (old == old or new == new)  # noqa: PLR0124 - NaN equals NaN here
    )


class Store:
    """The folder of a study, with the `study` that its results belong to.

    Raises BlfDscError if the folder holds no study.
    """

    def __init__(self, folder: Path, *, runs_law: bool = True) -> None:
        """Open a folder; its results can be read without running a law of a file."""
        if not (folder / _STUDY).is_file():
            raise BlfDscError(f'{folder} holds no study: choose another folder')
        self.folder = folder
        self.study = load_study(folder / _STUDY, runs_law=runs_law)

    @classmethod
    def create_or_open(cls, folder: Path, study: Study) -> Store:
        """Create the folder of a study, or open it to resume.

        Raises BlfDscError if it holds no study, another one, or the same by another
        version.
        """
        if not folder.exists():
            with whole(folder) as part:
                (part / _RUNS).mkdir(parents=True)
                write_json(versions(), part / _VERSIONS)
                dump(part / _STUDY, study.values())
        store = cls(folder)
        there = json.loads((folder / _VERSIONS).read_text(encoding='utf-8'))
        if different := differences(
            there | _flat(store.study), versions() | _flat(study)
        ):
            raise BlfDscError(
                f'{folder} holds another study, which is neither resumed nor overwritten: '
                f'choose another folder, or make them equal:{different}'
            )
        return store

    def keep(self, runs: range, columns: Columns) -> None:
        """Write results of consecutive runs atomically."""
        pa = require_pyarrow()
        path = self._path(runs)
        unfinished = path.with_name(f'.{path.name}')
        with unfinished.open('wb') as file:
            pa.parquet.write_table(pa.table(columns), file)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)

    def missing(self) -> list[range]:
        """Return the chunks of runs without results."""
        runs = self.study.settings.runs
        size = max(1, min(runs // _CHUNKS, _MAX_RUNS_OF_CHUNK))
        chunks = (
            range(first, min(first + size, runs)) for first in range(0, runs, size)
        )
        return [chunk for chunk in chunks if not self._path(chunk).exists()]

    def _path(self, runs: range) -> Path:
        return self.folder / _RUNS / f'runs-{runs.start:09d}-{runs[-1]:09d}.parquet'

    def results(self) -> Columns:
        """Read all results, one row per run, in order.

        Raises BlfDscError if there are none yet, or if a file is damaged.
        """
        pa = require_pyarrow()
        if not any((self.folder / _RUNS).glob('runs-*')):
            raise BlfDscError(f'{self.folder} has no results yet')
        try:
            whole = pa.parquet.read_table(self.folder / _RUNS).sort_by('run')
        except (OSError, pa.ArrowException) as error:
            raise BlfDscError(
                f'the results cannot be read ({error}): remove that file and start the study '
                'again to recompute its runs'
            ) from None
        return {name: np.asarray(whole[name].to_numpy()) for name in whole.column_names}


def _flat(study: Study) -> dict[str, object]:
    nodes = study.values().items()
    return {
        f'{node}.{name}': value
        for node, values in nodes
        for name, value in values.items()
    }


def cores() -> int:
    """Return the number of cores that this process may use."""
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, 'sched_getaffinity')
        else os.cpu_count() or 1
    )


def processes(workers: int) -> Executor:
    """Return processes of this machine, each of which ends with this one."""
    context = multiprocessing.get_context('forkserver')
    # imported once, for all workers
    context.set_forkserver_preload([run_chunk.__module__])
    return ProcessPoolExecutor(workers, context, _end_with_parent)


@contextmanager
def dask(address: str) -> Iterator[Executor]:
    """Use the dask.distributed cluster of the scheduler at this address.

    Dask itself repeats the work of a lost worker, unless it fails repeatedly.
    """
    distributed = import_extra('distributed', 'dask', '--dask')
    with distributed.Client(address) as client:
        try:
            yield client.get_executor(pure=False)
        except distributed.KilledWorker as error:
            raise BlfDscError(_LOST.format(error)) from error


def compute(
    study: Study, chunks: Iterable[range], executor: Executor
) -> Iterator[tuple[range, Columns]]:
    """Compute all `chunks` and yield each with its results as soon as it is done.

    Raises BlfDscError if a worker is lost.
    """
    handed = {}
    try:
        for runs in chunks:
            handed[executor.submit(run_chunk, study, runs.start, len(runs))] = runs
        for future in as_completed(handed):
            yield handed.pop(future), future.result()
    except BrokenExecutor as error:
        raise BlfDscError(_LOST.format(error)) from error
    finally:
        for future in handed:
            future.cancel()


def _end_with_parent() -> None:
    """Leave interrupts to the parent, and exit with it, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
