# SPDX-License-Identifier: Apache-2.0
"""Results depend neither on the engine that computes them nor on lost workers."""

from __future__ import annotations

import os
import signal
from concurrent.futures import BrokenExecutor, Executor
from contextlib import contextmanager, nullcontext

import numpy as np
import pytest
from monte_carlo_case import RUNS, same, study, whole

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.studies import runs as engines
from blf_dsc_controller.studies.runs import RETRIES, Span, chunk_size, compute, warm_up


@pytest.fixture(scope='module')
def a_study(tmp_path_factory):
    prepared = study(tmp_path_factory.mktemp('study'))
    warm_up(prepared)
    return prepared


@pytest.fixture(scope='module')
def undisturbed(a_study):
    return whole(a_study)


def spans(size):
    return [Span(first, min(size, RUNS - first)) for first in range(0, RUNS, size)]


def joined(parts):
    """Results of all chunks in the order of the runs."""
    assert sorted(parts) == sorted(set(parts))
    chunks = [parts[span] for span in sorted(parts)]
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}


def results_of(a_study, engine, size, warn=pytest.fail):
    parts = {}
    compute(a_study, spans(size), engine, parts.__setitem__, warn)
    return joined(parts)


def local_dask():
    pytest.importorskip('distributed', reason='the extra dask is not installed')
    return engines.dask(2)


@pytest.mark.parametrize(
    ('make', 'size'),
    [
        (lambda: engines.threads(3), 1),
        (lambda: engines.threads(1), 5),
        (lambda: engines.processes(1), RUNS),
        (lambda: engines.processes(2), 4),
        (local_dask, 5),
    ],
    ids=['threads', 'thread', 'process', 'processes', 'dask'],
)
def test_every_engine_gives_the_same_results(a_study, undisturbed, make, size):
    assert same(results_of(a_study, make(), size), undisturbed)


def losing_workers(engine, kills):
    """Let the engine lose a worker to SIGKILL when the first chunk of each pool is done."""
    pools, hit = [], []

    @contextmanager
    def start():
        with engine.open() as executor:
            pools.append(executor)
            yield executor

    def kill():
        if len(pools) <= kills and pools[-1] not in hit:
            hit.append(pools[-1])
            os.kill(next(iter(pools[-1]._processes)), signal.SIGKILL)

    return engine._replace(open=start), kill


def test_killed_worker_loses_no_results(a_study, undisturbed):
    engine, kill = losing_workers(engines.processes(2), kills=1)
    parts, warnings = {}, []

    def keep(span, columns):
        assert span not in parts
        parts[span] = columns
        kill()

    compute(a_study, spans(1), engine, keep, warnings.append)
    assert same(joined(parts), undisturbed)
    assert len(warnings) == 1
    assert 'a worker was lost' in warnings[0]


class Broken(Executor):
    """Workers that cannot even be started."""

    def submit(self, *_args, **_keywords):
        raise BrokenExecutor('out of memory')


def test_study_is_given_up_when_workers_are_always_lost(a_study):
    warnings = []
    engine = engines.Engine(lambda: nullcontext(Broken()), 2)
    with pytest.raises(BlfDscError, match=r'out of memory.* 24 chunks are left'):
        compute(a_study, spans(1), engine, pytest.fail, warnings.append)
    assert len(warnings) == RETRIES


def test_error_in_a_run_is_not_taken_for_a_lost_worker(a_study):
    with pytest.raises(ZeroDivisionError):
        compute(a_study, spans(1), engines.threads(2), lambda *_: 1 / 0, pytest.fail)


@pytest.mark.parametrize(('runs', 'workers'), [(1, 8), (10_000, 2), (10**8, 64)])
def test_chunks_are_few_but_enough_for_all_workers(runs, workers):
    size = chunk_size(runs, workers)
    assert 1 <= size <= 1000  # a crash costs about ten seconds of work
    assert runs / size >= min(runs, 20 * workers)
