# SPDX-License-Identifier: Apache-2.0
"""Studies by their command: the same results whoever computes them, also after a kill.

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
from pathlib import Path

import numpy as np
import pytest
from test_monte_carlo_study import LOOP, RUNS, STUDY, study, whole, write

from blf_dsc_controller import load_loop, read_run, simulate
from blf_dsc_controller.cli.main import main

pa = pytest.importorskip('pyarrow', reason='the extra studies is not installed')
pytest.importorskip('pyarrow.parquet')


def parts(folder):
    """Return the files of the results of a study."""
    return sorted((folder / 'runs').glob('runs-*'))


def results(folder):
    """Return the columns of a study's results, in the order of the runs."""
    table = pa.parquet.read_table(folder / 'runs').sort_by('run')
    return {name: np.asarray(table[name].to_numpy()) for name in table.column_names}


def rewrite(folder, columns):
    """Replace columns (RUNS,) of a study's results."""
    whole = results(folder) | columns
    for path in parts(folder):
        runs = pa.parquet.read_table(path)['run'].to_numpy()
        some = {name: values[runs] for name, values in whole.items()}
        pa.parquet.write_table(pa.table(some), path)


def command(folder, *options):
    """Return the arguments of the study in a folder, to start or to resume it."""
    out = folder / 'my study'
    config = out / 'study.yaml' if out.exists() else folder / 'study.yaml'
    return ['monte-carlo', '--config', str(config), '--out', str(out), *options]


def summary(folder):
    """Summarise the results of a study as its command does."""
    assert main(command(folder)) == 0
    return json.loads((folder / 'my study/summary.json').read_text())


@pytest.fixture(scope='module')
def undisturbed(tmp_path_factory):
    return whole(study(tmp_path_factory.mktemp('study')))


@pytest.fixture
def done(tmp_path):
    """The folder of a study of four runs."""
    write(tmp_path)
    assert main(command(tmp_path, '--runs', '4', '--workers', '1')) == 0
    return tmp_path


def test_dask_gives_the_same_results(undisturbed, tmp_path):
    distributed = pytest.importorskip(
        'distributed', reason='the extra dask is not installed'
    )
    write(tmp_path)
    with distributed.LocalCluster(
        2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        assert main(command(tmp_path, '--dask', cluster.scheduler_address)) == 0
    np.testing.assert_equal(results(tmp_path / 'my study'), undisturbed)


def stamps(folder):
    return {path.name: path.stat().st_mtime_ns for path in parts(folder)}


def workers_of(process):
    """Return the processes that compute for a command: those of its fork server."""
    children = Path(f'/proc/{process.pid}/task/{process.pid}/children')
    found = []
    for child in children.read_text().split():
        theirs = Path(f'/proc/{child}/task/{child}/children').read_text().split()
        found += map(int, theirs)
    return found


@pytest.mark.parametrize('victim', ['worker', 'command'])
def test_killed_study_resumes(victim, tmp_path, capsys):
    write(tmp_path, LOOP.replace('duration: 0.75', 'duration: 3.0') + STUDY)
    out = tmp_path / 'my study'
    words = [sys.executable, '-m', 'blf_dsc_controller']
    words += command(tmp_path, '--workers', '2')
    # What a killed process leaves goes with the logs of the suite.
    environment = {**os.environ, 'TMPDIR': os.environ['ROS_LOG_DIR']}
    with subprocess.Popen(
        words, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        while len(parts(out)) < 3:
            assert process.poll() is None
            time.sleep(0.01)
        if victim == 'worker':
            os.kill(workers_of(process)[0], signal.SIGKILL)
        else:
            process.kill()
        # to the end of the pipe: its workers have ended too
        _, said = process.communicate(timeout=300.0)
    if victim == 'worker':
        assert process.returncode == 1
        assert re.search('a worker was lost .* The same command resumes', said)
    parts(out)[0].unlink()  # what is missing need not be at the end
    before = stamps(out)
    assert 2 <= len(before) < RUNS
    (out / 'runs' / '.runs-000000023-000000023.parquet').write_bytes(b'half a fi')

    assert main(words[3:]) == 0
    printed = capsys.readouterr()
    assert f'{len(before)} of 24 runs are done already' in printed.err
    assert 'of the runs kept the bound' in printed.out
    assert not list((out / 'runs').glob('.*'))
    after = stamps(out)
    assert before.items() <= after.items()
    assert len(after) == RUNS
    assert main(words[3:]) == 0
    assert stamps(out) == after  # nothing is computed again
    slow = study(tmp_path, LOOP.replace('duration: 0.75', 'duration: 3.0') + STUDY)
    np.testing.assert_equal(results(out), whole(slow))


def test_other_study_or_version_is_rejected_and_the_difference_is_named(done, capsys):
    own = command(done)
    capsys.readouterr()
    for before, after, difference in (
        (
            'm2: uniform(0.3',
            'm2: uniform(0.2',
            'arm.m2: there uniform(0.3, 0.7), here uniform',
        ),
        ('arm.m2', 'arm.m1', 'arm.m2: there uniform(0.3, 0.7), here nothing'),
        ('window: 0.1', 'window: 0.12', 'learning.window: there 0.1, here 0.12'),
    ):
        other = write(done, (LOOP + STUDY).replace(before, after, 1))
        assert main([*own[:1], '--config', str(other), '--runs', '4', *own[3:]]) == 1
        assert difference in capsys.readouterr().err
    versions = done / 'my study/versions.json'
    there = json.loads(versions.read_text()) | {'kernels': 'of yesterday'}
    versions.write_text(json.dumps(there))
    assert main(own) == 1
    assert 'kernels: there of yesterday, here ' in capsys.readouterr().err


def test_folder_without_a_study_is_left_alone(tmp_path, capsys):
    out = tmp_path / 'thesis'
    out.mkdir()
    (out / 'chapter1.txt').write_text('In the beginning')
    assert (
        main(['monte-carlo', '--config', str(write(tmp_path)), '--out', str(out)]) == 1
    )
    assert 'holds no study: choose another folder' in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ['chapter1.txt']


def test_damaged_file_is_named(done, capsys):
    part = parts(done / 'my study')[0]
    part.write_bytes(part.read_bytes()[:-20])
    assert main(command(done)) == 1
    assert re.search(
        f'cannot be read .*{part.name}.*remove', capsys.readouterr().err, re.DOTALL
    )


def test_runs_are_sorted_worst_first_with_diverged_runs_before_all_others(done):
    """Wilson's interval (1927) of three in four is 0.3006 to 0.9544."""
    rewrite(
        done / 'my study',
        {
            'max_error_ratio.joint1': np.array([0.1, 0.2, 0.3, 0.4]),
            'max_error_ratio.joint2': np.array([0.4, 0.2, 0.1, 0.1]),
            'outcome': np.array(['kept', 'kept', 'diverged', 'kept']),
        },
    )
    found = summary(done)
    # The worse of both joints counts, ties in the order of the runs.
    assert [entry['run'] for entry in found['worst']] == [2, 0, 3, 1]
    assert found['outcomes'] == {'kept': 3, 'violated': 0, 'diverged': 1, 'rejected': 0}
    assert found['kept'] == pytest.approx(
        {'fraction': 0.75, 'low': 0.300642, 'high': 0.954413}, abs=1e-6
    )


def test_command_of_the_report_reproduces_the_worst_run(
    done, tmp_path, monkeypatch, capsys
):
    capsys.readouterr()
    worst = summary(done)['worst'][0]['run']
    printed = capsys.readouterr().out
    found = results(done / 'my study')
    kept = int((found['outcome'] == 'kept').sum())
    assert f'{100 * kept / 4:.4g} % of the runs kept the bound (95 %' in printed
    (line,) = re.findall(r'blf_dsc (monte-carlo --reproduce .*)', printed)
    monkeypatch.chdir(tmp_path)
    arguments = shlex.split(line)
    assert int(arguments[3]) == worst
    assert main(arguments) == 0
    out = tmp_path / arguments[5]
    bag = read_run(out / 'bag')
    peak = np.abs(bag.error).max(axis=0) / 0.002
    expected = [found[f'max_error_ratio.joint{i}'][worst] for i in (1, 2)]
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
    for missing in ('4', 'one'):
        assert main([*arguments[:3], missing]) == 1
        assert f'has no run {missing}' in capsys.readouterr().err
    # Nor is one that has other results than the stored ones.
    name = 'max_error_ratio.joint2'
    rewrite(done / 'my study', {name: np.nextafter(found[name], 2.0)})
    assert main([*arguments[:3], '1', '--out', str(tmp_path / 'run')]) == 1
    assert re.search(f'run 1 differs .*\n.*{name}', capsys.readouterr().err)


@pytest.mark.usefixtures('blank_pictures')
def test_pairs_are_compared_and_exceptions_are_reproduced(tmp_path, capsys):
    text = STUDY.replace('seed: 7', 'seed: 7\n    pairs: true')
    write(tmp_path, LOOP + text)
    assert main(command(tmp_path, '--runs', '4', '--workers', '1')) == 0
    out = tmp_path / 'my study'
    words = ['monte-carlo', '--reproduce', str(out), '2', '--out']
    assert main([*words, str(tmp_path / 'run')]) == 0
    for name in ('', 'without_learning', 'other_noise'):
        assert (tmp_path / 'run' / name / 'bag').is_dir()
        law = load_loop(tmp_path / 'run' / name / 'config.yaml').controller
        assert law.learning.enabled is not bool(name)

    made = {
        'outcome': np.array(['kept', 'violated', 'kept', 'violated']),
        'without.outcome': np.array(['kept', 'kept', 'violated', 'violated']),
        'noise.outcome': np.array(['violated', 'violated', 'kept', 'kept']),
        'noise.first_violation_s': np.array([0.1, 0.25, np.nan, np.nan]),
        'without.first_violation_s': np.array([np.nan, np.nan, 0.25, 0.25]),
    }
    for joint in ('joint1', 'joint2'):
        made[f'settled_error_ratio.{joint}'] = np.array([0.3, 1.2, 0.9, 9.0])
        made[f'without.settled_error_ratio.{joint}'] = np.array([0.2, 0.4, 1.1, 1.0])
    rewrite(out, made)
    capsys.readouterr()
    pairs = summary(tmp_path)['pairs']
    printed = capsys.readouterr().out
    assert 'broken only with / only without: 1 / 1' in printed
    assert 'bound broken only with learning: 1' in printed
    assert 'error above 1.3 times that without: 1, 0' in printed
    assert pairs['kept'] == {'with': 2, 'without': 2}
    assert (pairs['broken_only_with'], pairs['broken_only_without']) == ([1], [2])
    assert pairs['above'] == [1, 0]  # run 3 breaks the bound either way
    assert pairs['factor']['max'] == pytest.approx(3.0)
    noise = pairs['noise']  # noise breaks run 0 before learning would begin
    assert (noise['broken_only_with'], noise['broken_only_without']) == ([1], [2, 3])
    assert main(['monte-carlo', '--report', str(out), '--out', str(tmp_path)]) == 0
    table = (tmp_path / 'changes.md').read_text()
    assert capsys.readouterr().out == table
    assert '| my study | 4 | 2 / 2 | 1 / 1 | ' in table

    rewrite(out, {'without.outcome': np.full(4, 'diverged')})
    assert summary(tmp_path)['pairs']['factor'] == dict.fromkeys(
        ('median', 'p99', 'p99.9', 'max')
    )
