# SPDX-License-Identifier: Apache-2.0
"""Engines give the same results in any order, also after a kill.

The report can be reproduced.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from test_monte_carlo_study import LOOP, RUNS, STUDY, study, whole, write

from blf_dsc_controller import BlfDscError, load_loop, read_run, run_chunk, simulate
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.cli.result_folder import make_folder
from blf_dsc_controller.studies import runs as engines
from blf_dsc_controller.studies.report import format_report
from blf_dsc_controller.studies.reproduction import reproduce
from blf_dsc_controller.studies.runs import Store, compute, warm_up
from blf_dsc_controller.studies.summary import summarize


@pytest.fixture(scope='module')
def a_study(tmp_path_factory):
    prepared = study(tmp_path_factory.mktemp('study'))
    warm_up(prepared)
    return prepared


@pytest.fixture(scope='module')
def undisturbed(a_study):
    return whole(a_study)


def chunks(size):
    return [range(first, min(first + size, RUNS)) for first in range(0, RUNS, size)]


@contextmanager
def local_dask():
    distributed = pytest.importorskip(
        'distributed', reason='the extra dask is not installed'
    )
    cluster = distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None)
    with cluster, engines.dask(cluster.scheduler_address) as executor:
        yield executor


@pytest.mark.parametrize('make', [lambda: engines.processes(2), local_dask])
def test_every_executor_gives_the_same_results(a_study, undisturbed, make):
    with make() as executor:
        parts = dict(compute(a_study, chunks(5), executor))
    found = [parts[runs] for runs in chunks(5)]
    joined = {name: np.concatenate([part[name] for part in found]) for name in found[0]}
    np.testing.assert_equal(joined, undisturbed)


def test_killed_worker_is_named_and_what_was_kept_is_complete(a_study, undisturbed):
    parts = {}
    lost = pytest.raises(
        BlfDscError, match=r'a worker was lost .* The same command resumes'
    )
    with engines.processes(2) as executor, lost:
        for runs, columns in compute(a_study, chunks(1), executor):
            if not parts:
                os.kill(next(iter(executor._processes)), signal.SIGKILL)
            parts[runs] = columns
    assert 1 <= len(parts) < RUNS
    for runs, columns in parts.items():
        assert (
            columns['rms_error_rad.joint1']
            == undisturbed['rms_error_rad.joint1'][runs.start]
        )


def test_error_in_a_run_is_not_taken_for_a_lost_worker(a_study):
    broken = replace(a_study, variations=None)
    with ThreadPoolExecutor(2) as executor, pytest.raises(TypeError):
        list(compute(broken, chunks(1), executor))


@pytest.fixture
def store(tmp_path):
    return Store.create_or_open(tmp_path / 'out', study(tmp_path))


def filled(store, *runs):
    for run in runs:
        store.keep(range(run, run + 1), run_chunk(store.study, run, 1))
    return store


@pytest.fixture(scope='module')
def whole_store(tmp_path_factory):
    folder = tmp_path_factory.mktemp('study')
    return filled(
        Store.create_or_open(folder / 'my study', study(folder)), *reversed(range(RUNS))
    )


def stamps(folder):
    return {path.name: path.stat().st_mtime_ns for path in (folder / 'runs').iterdir()}


def test_killed_study_resumes(tmp_path, capsys):
    loop = LOOP.replace('duration: 0.3', 'duration: 3.0')
    path = write(tmp_path, loop + STUDY)
    out = tmp_path / 'out'
    command = [
        sys.executable,
        '-m',
        'blf_dsc_controller',
        'monte-carlo',
        '--config',
        path,
    ]
    command += ['--out', out, '--workers', '2']
    # What a killed process leaves goes with the logs of the suite.
    environment = {**os.environ, 'TMPDIR': os.environ['ROS_LOG_DIR']}
    with subprocess.Popen(command, stderr=subprocess.PIPE, env=environment) as process:
        while len(list(out.glob('runs/r*'))) < 3:
            assert process.poll() is None
            time.sleep(0.01)
        process.kill()
        # to the end of the pipe: its workers have ended too
        process.communicate(timeout=300.0)
    min(out.glob('runs/r*')).unlink()  # what is missing need not be at the end
    before = {
        name: stamp for name, stamp in stamps(out).items() if name.startswith('r')
    }
    assert 2 <= len(before) < RUNS
    (out / 'runs' / '.runs-000000023-000000023.parquet').write_bytes(b'half a fi')

    resumed = subprocess.run(command, capture_output=True, text=True, check=True)
    assert f'{len(before)} of 24 runs are done already' in resumed.stderr
    after = stamps(out)
    assert not [name for name in after if name.startswith('.')]
    assert before.items() <= after.items()
    assert len(after) == RUNS
    assert main([*map(str, command[3:])]) == 0
    assert stamps(out) == after  # nothing is computed again
    assert 'of the runs kept the bound' in capsys.readouterr().out
    opened = Store(out)
    np.testing.assert_equal(opened.results(), whole(opened.study))


@pytest.mark.parametrize(('runs', 'chunks'), [(1, 1), (1001, 201), (10**6, 1000)])
def test_chunks_are_few_and_hold_each_run_once(tmp_path, runs, chunks):
    missing = Store.create_or_open(
        tmp_path / 'out', study(tmp_path, runs=runs)
    ).missing()
    assert len(missing) == chunks
    assert [0, *(chunk.stop for chunk in missing)] == [
        *(chunk.start for chunk in missing),
        runs,
    ]


def test_other_study_or_version_is_rejected_and_the_difference_is_named(
    tmp_path, store, monkeypatch
):
    for before, after, difference in (
        (
            'm2: uniform(0.3',
            'm2: uniform(0.2',
            r'arm.m2: there uniform\(0.3, 0.7\), here uniform',
        ),
        ('arm.m2', 'arm.m1', r'arm.m2: there uniform\(0.3, 0.7\), here nothing'),
        ('duration: 0.75', 'duration: 0.8', r'duration: there 0.75, here 0.8'),
        ('window: 0.1', 'window: 0.12', r'learning.window: there 0.1, here 0.12'),
    ):
        other = study(tmp_path, (LOOP + STUDY).replace(before, after, 1))
        with pytest.raises(BlfDscError, match=difference):
            Store.create_or_open(store.folder, other)
    assert Store(store.folder).study == study(tmp_path)
    now = engines.versions()
    monkeypatch.setattr(engines, 'versions', lambda: now | {'kernels': 'of tomorrow'})
    with pytest.raises(BlfDscError, match=r'kernels: there .*, here of tomorrow'):
        Store.create_or_open(store.folder, store.study)


def test_folder_without_a_study_is_left_alone(tmp_path, capsys):
    out = tmp_path / 'thesis'
    out.mkdir()
    (out / 'chapter1.txt').write_text('In the beginning')
    assert (
        main(['monte-carlo', '--config', str(write(tmp_path)), '--out', str(out)]) == 1
    )
    assert 'holds no study: choose another folder' in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ['chapter1.txt']


def test_damaged_file_is_named(store):
    filled(store, 0)
    (part,) = (store.folder / 'runs').iterdir()
    part.write_bytes(part.read_bytes()[:-20])
    with pytest.raises(BlfDscError, match=f'cannot be read .*{part.name}.*remove'):
        store.results()


def test_runs_are_sorted_worst_first_with_diverged_runs_before_all_others(whole_store):
    results = whole_store.results()
    ratio = np.linspace(0.1, 0.5, RUNS)
    results['max_error_ratio.joint1'] = ratio
    results['max_error_ratio.joint2'] = ratio[::-1].copy()
    outcome = results['outcome'].astype(object)
    outcome[:] = 'kept'
    outcome[5] = 'diverged'
    results['outcome'] = outcome
    # The worse of both joints counts: ends before the middle, ties in the order of the
    # runs.
    summary = summarize(whole_store.study, results)
    assert [entry['run'] for entry in summary['worst'][:5]] == [5, 0, 23, 1, 22]
    assert summary['outcomes'] == {
        'kept': 23,
        'violated': 0,
        'diverged': 1,
        'rejected': 0,
    }
    assert summary['kept']['fraction'] == 23 / 24
    # (23 + z^2 / 2 -+ z sqrt(23 / 24 + z^2 / 4)) / (24 + z^2), z = 1.959964, Wilson
    # (1927)
    assert summary['kept']['low'] == pytest.approx(0.797582, abs=1e-6)
    assert summary['kept']['high'] == pytest.approx(0.992607, abs=1e-6)


def test_command_of_the_report_reproduces_the_worst_run(
    whole_store, tmp_path, monkeypatch, capsys
):
    resumed = [
        '--config',
        str(whole_store.folder / 'study.yaml'),
        '--out',
        str(whole_store.folder),
    ]
    assert main(['monte-carlo', *resumed]) == 0
    kept = int((whole_store.results()['outcome'] == 'kept').sum())
    printed = capsys.readouterr().out
    assert (
        f'{100 * kept / 24:.4g} % of the runs kept the bound (95 % confidence: '
        in printed
    )
    summary = json.loads((whole_store.folder / 'summary.json').read_text())
    assert summary == summarize(whole_store.study, whole_store.results())
    (command,) = re.findall(r'blf_dsc (monte-carlo --reproduce .*)', printed)
    monkeypatch.chdir(tmp_path)
    arguments = shlex.split(command)
    assert int(arguments[3]) == summary['worst'][0]['run']
    assert main(arguments) == 0
    run = int(arguments[3])
    out = tmp_path / arguments[5]
    results = whole_store.results()
    bag = read_run(out / 'bag')
    peak = np.abs(bag.error).max(axis=0) / 0.002
    expected = [results[f'max_error_ratio.joint{i}'][run] for i in (1, 2)]
    # The order of operations is not the same as in the kernel.
    np.testing.assert_allclose(peak, expected, rtol=1e-15)
    # The run can also be repeated from its configuration.
    loop = load_loop(out / 'config.yaml')
    again = simulate(loop.controller, loop.plant, supervised=False)
    np.testing.assert_array_equal(again.measurements[:, :2], bag.position)
    # An existing folder is not overwritten, and there are no more runs.
    assert main(arguments) == 1
    assert main(['monte-carlo', '--reproduce', 'nowhere', '1']) == 1
    assert not (tmp_path / 'nowhere-run-1').exists()
    for missing in ('24', 'one'):
        assert main([*arguments[:3], missing]) == 1
        assert f'has no run {missing}' in capsys.readouterr().err


def test_run_that_differs_from_its_stored_results_is_reported(whole_store, tmp_path):
    folder = tmp_path / 'tampered'
    other = Store.create_or_open(folder, whole_store.study)
    results = whole_store.results()
    results['max_error_ratio.joint2'] = np.nextafter(
        results['max_error_ratio.joint2'], 2.0
    )
    other.keep(range(RUNS), results)
    (tmp_path / 'run').mkdir()
    with pytest.raises(
        BlfDscError, match=r'run 4 differs .*\n.*max_error_ratio.joint2'
    ):
        reproduce(other, '4', tmp_path / 'run')


@pytest.mark.usefixtures('blank_pictures')
def test_pairs_are_compared_and_exceptions_are_reproduced(tmp_path, capsys):
    text = STUDY.replace('seed: 7', 'seed: 7\n    pairs: true')
    a_study = study(tmp_path, LOOP + text, runs=4)
    store = Store.create_or_open(tmp_path / 'pairs', a_study)
    results = whole(a_study)
    store.keep(range(4), results)
    reproduce(store, '2', make_folder(tmp_path / 'run'))
    for name in ('', 'without_learning', 'other_noise'):
        assert (tmp_path / 'run' / name / 'bag').is_dir()
        law = load_loop(tmp_path / 'run' / name / 'config.yaml').controller
        assert law.learning.enabled is not bool(name)

    results['outcome'] = np.array(['kept', 'violated', 'kept', 'violated'])
    results['without.outcome'] = np.array(['kept', 'kept', 'violated', 'violated'])
    results['noise.outcome'] = np.array(['violated', 'violated', 'kept', 'kept'])
    results['noise.first_violation_s'] = np.array([0.1, 0.25, np.nan, np.nan])
    results['without.first_violation_s'] = np.array([np.nan, np.nan, 0.25, 0.25])
    for joint in ('joint1', 'joint2'):
        results[f'settled_error_ratio.{joint}'] = np.array([0.3, 1.2, 0.9, 9.0])
        results[f'without.settled_error_ratio.{joint}'] = np.array([0.2, 0.4, 1.1, 1.0])
    pairs = summarize(a_study, results)['pairs']
    assert pairs['kept'] == {'with': 2, 'without': 2}
    assert (pairs['broken_only_with'], pairs['broken_only_without']) == ([1], [2])
    assert pairs['above'] == [1, 0]  # run 3 breaks the bound either way
    assert pairs['factor']['max'] == pytest.approx(3.0)
    noise = pairs['noise']  # noise breaks run 0 before learning would begin
    assert (noise['broken_only_with'], noise['broken_only_without']) == ([1], [2, 3])
    results['outcome'][1] = 'diverged'
    assert summarize(a_study, results)['pairs']['factor']['max'] is None
    lost = results | {
        f'{law}outcome': np.full(4, 'diverged') for law in ('', 'without.')
    }
    assert summarize(a_study, lost)['pairs']['factor']['median'] is None

    store.keep(range(4), results)
    printed = format_report(summarize(a_study, store.results()), store.folder)
    assert 'broken only with / only without: 1 / 1' in printed
    assert 'bound broken only with learning: 1' in printed
    assert 'error above 1.3 times that without: 1, 0' in printed
    assert (
        main(['monte-carlo', '--report', str(store.folder), '--out', str(tmp_path)])
        == 0
    )
    table = (tmp_path / 'changes.md').read_text()
    assert capsys.readouterr().out == table
    assert '| pairs | 4 | 2 / 2 | 1 / 1 | ' in table
    assert ' | 0.00 % | 1 / 2, ' in table


def test_studies_without_pairs_are_not_put_side_by_side(whole_store, tmp_path, capsys):
    assert (
        main(
            ['monte-carlo', '--report', str(whole_store.folder), '--out', str(tmp_path)]
        )
        == 1
    )
    assert 'holds no pairs: its study needs pairs: true' in capsys.readouterr().err
