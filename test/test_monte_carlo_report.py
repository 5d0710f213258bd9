# SPDX-License-Identifier: Apache-2.0
"""The report states how many runs kept the bound, and its worst runs can be reproduced."""

from __future__ import annotations

import html
import json
import re
import shlex

import matplotlib.image
import numpy as np
import pytest
from monte_carlo_case import LOOP, RUNS, STUDY, study, whole

from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.cli.run import make_folder
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.report import (
    influence,
    plant_of_run,
    reproduce,
    summarize,
    worst_first,
    write_report,
)
from blf_dsc_controller.studies.runs import Span, Store


@pytest.fixture(scope='module')
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp('study')
    created = Store.create_or_open(folder / 'my study', study(folder))
    created.keep(Span(0, RUNS), whole(created.study))
    return created


def test_runs_are_sorted_worst_first_with_diverged_runs_before_all_others(store):
    results = store.results()
    ratio = np.linspace(0.1, 0.5, RUNS)
    results['max_error_ratio.joint1'] = ratio
    results['max_error_ratio.joint2'] = ratio[::-1].copy()
    outcome = results['outcome'].astype(object)
    outcome[:] = 'kept'
    outcome[5] = 'diverged'
    results['outcome'] = outcome
    # The worse of both joints counts: ends before the middle, ties in the order of the runs.
    assert worst_first(store.study, results)[:5].tolist() == [5, 0, 23, 1, 22]
    summary = summarize(store.study, results)
    assert [entry['run'] for entry in summary['worst'][:3]] == [5, 0, 23]
    assert summary['outcomes'] == {'kept': 23, 'violated': 0, 'diverged': 1, 'rejected': 0}
    assert summary['kept']['fraction'] == 23 / 24
    # (23 + z^2 / 2 -+ z sqrt(23 / 24 + z^2 / 4)) / (24 + z^2), z = 1.959964, Wilson (1927)
    assert summary['kept']['low'] == pytest.approx(0.797582, abs=1e-6)
    assert summary['kept']['high'] == pytest.approx(0.992607, abs=1e-6)


def test_influence_detects_that_both_ends_are_bad(store):
    """The start does not correlate with the error, bad near both ends, yet explains all of it."""
    rng = np.random.default_rng(3)
    runs = 2000
    results = {variation.column: rng.random(runs) for variation in store.study.variations}
    start = rng.uniform(-1.0, 1.0, runs)
    results['plant.initial.error.joint1'] = start
    results['outcome'] = np.full(runs, 'kept')
    results['max_error_ratio.joint1'] = np.abs(start)
    results['max_error_ratio.joint2'] = np.zeros(runs)
    explained = influence(store.study, results)
    assert next(iter(explained)) == 'initial.error.joint1'
    # Ten groups of equal size, five pairs: all but 1/25 of the variance, whatever the scale.
    assert explained.pop('initial.error.joint1') == pytest.approx(0.96, abs=0.01)
    assert max(explained.values()) < 0.02


def test_report_is_written(store):
    summary, written = write_report(store)
    assert [path.name for path in written] == [
        'report.html',
        'distributions.png',
        'influence.png',
        'summary.json',
    ]
    assert json.loads((store.folder / 'summary.json').read_text()) == summary
    results = store.results()
    kept = int((results['outcome'] == 'kept').sum())
    text = (store.folder / 'report.html').read_text()
    assert f'({kept} of 24; 95 % confidence:' in text
    assert text.count('src="data:image/png;base64,') == 2
    for picture in ('distributions.png', 'influence.png'):
        assert matplotlib.image.imread(store.folder / picture).shape[1] > 1200


@pytest.mark.usefixtures('blank_pictures')
def test_commands_in_the_report_reproduce_the_worst_runs(store, tmp_path, monkeypatch):
    write_report(store)
    page = html.unescape((store.folder / 'report.html').read_text())
    commands = re.findall(r'>blf_dsc (monte-carlo --reproduce .*?)<', page)
    assert len(commands) == 10
    monkeypatch.chdir(tmp_path)
    arguments = shlex.split(commands[0])
    assert main(arguments) == 0
    run, out = int(arguments[3]), tmp_path / arguments[5]
    written = {path.name for path in out.iterdir()}
    assert {'bag', 'config.yaml', 'summary.json', 'tracking.png', 'parameters.png'} <= written
    results = store.results()
    bag = read_run(out / 'bag')
    peak = np.abs(bag.error).max(axis=0) / 0.002
    expected = [results[f'max_error_ratio.joint{i}'][run] for i in (1, 2)]
    # The order of operations is not the same as in the kernel.
    np.testing.assert_allclose(peak, expected, rtol=1e-15)
    # The run can also be repeated from its configuration.
    loop = load_loop(out / 'config.yaml')
    assert loop.plant == plant_of_run(store.study, run)
    again = simulate(loop.controller, loop.plant, supervised=False)
    np.testing.assert_array_equal(again.measurements[:, :2], bag.position)
    # An existing folder is not overwritten.
    assert main(arguments) == 1


@pytest.mark.usefixtures('blank_pictures')
def test_run_that_differs_from_its_stored_results_is_reported(store, tmp_path):
    folder = tmp_path / 'tampered'
    other = Store.create_or_open(folder, store.study)
    results = store.results()
    results['max_error_ratio.joint2'] = np.nextafter(results['max_error_ratio.joint2'], 2.0)
    other.keep(Span(0, RUNS), results)
    (tmp_path / 'run').mkdir()
    with pytest.raises(BlfDscError, match=r'run 4 differs .*\n.*max_error_ratio.joint2'):
        reproduce(other, 4, tmp_path / 'run')


@pytest.mark.usefixtures('blank_pictures')
def test_pairs_are_compared_and_exceptions_are_reproduced(tmp_path, capsys):
    text = STUDY.replace('seed: 7', 'seed: 7\n    pairs: true')
    a_study = study(tmp_path, LOOP + text, runs=4)
    results = whole(a_study)
    truth = results | {name: results[name].copy() for name in results}
    results['outcome'] = np.array(['kept', 'violated', 'kept', 'violated'])
    results['without.outcome'] = np.array(['kept', 'kept', 'violated', 'violated'])
    for joint in ('joint1', 'joint2'):
        results[f'settled_error_ratio.{joint}'] = np.array([0.3, 1.2, 0.9, 9.0])
        results[f'without.settled_error_ratio.{joint}'] = np.array([0.2, 0.4, 1.1, 1.0])
    pairs = summarize(a_study, results)['pairs']
    assert pairs['kept'] == {'with': 2, 'without': 2}
    assert (pairs['broken_only_with'], pairs['broken_only_without']) == ([1], [2])
    assert pairs['above'] == [1, 0]  # run 3 breaks the bound either way
    assert pairs['factor']['max'] == pytest.approx(3.0)
    results['outcome'][1] = 'diverged'
    assert summarize(a_study, results)['pairs']['factor']['max'] is None

    store = Store.create_or_open(tmp_path / 'pairs', a_study)
    store.keep(Span(0, 4), truth)
    reproduce(store, 2, make_folder(tmp_path / 'run'))
    for folder in (tmp_path / 'run', tmp_path / 'run/without_learning'):
        assert (folder / 'bag').is_dir()
    assert load_loop(tmp_path / 'run/without_learning/config.yaml').controller.learning.weight == 0
    store.keep(Span(0, 4), results)
    assert main(['monte-carlo', '--report', str(tmp_path / 'pairs')]) == 0
    assert '1 broke it only with learning, 1 only without' in capsys.readouterr().out
    page = html.unescape((tmp_path / 'pairs/report.html').read_text())
    assert 'breaks the bound only with learning' in page
    assert 'largest error more than 1.3 times' in page


def test_missing_run_is_reported(store, tmp_path, capsys):
    out = str(tmp_path / 'run')
    assert main(['monte-carlo', '--reproduce', str(store.folder), '24', '--out', out]) == 1
    assert 'has no run 24' in capsys.readouterr().err
