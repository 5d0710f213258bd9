# SPDX-License-Identifier: Apache-2.0
"""The paper's study: its numbers, its claims, its report; and what the pages say about it."""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from paper_case import P, configured, run

from blf_dsc_controller.analysis.metrics import measure
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import known_names, load_loop, locate
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies import paper as claims
from blf_dsc_controller.studies import tuning as tune
from blf_dsc_controller.studies.paper import CASES, FAILS, HOLDS, ONLY_IF, case_name


def test_every_law_is_tuned_with_the_same_effort():
    """Same optimiser, seed and budget; one range per shared gain; as many for both of Fig. 2."""
    ranges = {}
    for task in tune.TASKS.values():
        for gain in task.gains:
            key = gain.name, gain.joint
            assert ranges.setdefault(key, (gain.least, gain.most)) == (gain.least, gain.most)
        values = [tune.value_at(k / 10.0) for k in range(len(task.gains))]
        found = tune.parameters_at(ControllerConfig(), task.gains, values)
        assert found['feedback.gain'] == (1.0, 1.26)  # of each joint; 10^0.1 to three digits
        assert found['learning.adaptation_gain'] == (1.58,) * 3
    assert len(tune.TASKS['proposed'].gains) == len(tune.TASKS['comparison'].gains)


@pytest.mark.parametrize('name', tune.TASKS)
def test_committed_gains_beat_the_middle_of_their_ranges(name):
    """By at least a decade of the search's objective, whose value is stated in their file."""
    task = tune.TASKS[name]
    preset = {'proposed': 'paper_tuned'}.get(name, name)
    middle = np.array([np.log10(gain.least * gain.most) / 2.0 for gain in task.gains])
    loops = tune.loops_of(task)
    bare, tuned = task._replace(gains=()), load_loop(preset).controller
    best = tune.objective(np.array([]), bare, [loop._replace(controller=tuned) for loop in loops])
    assert best < tune.objective(middle, task, loops) - 1.0
    stated = re.search(r'objective (-?[\d.]+)', locate(preset).read_text(encoding='utf-8'))
    assert best == pytest.approx(float(stated.group(1)), abs=0.01)


@pytest.fixture(scope='module')
def report(tmp_path_factory):
    """The report of the whole study, run once: about 20 s on two cores."""
    out = tmp_path_factory.mktemp('study') / 'report'
    with (out.parent / 'printed.txt').open('w') as file, contextlib.redirect_stdout(file):
        assert main(['paper', '--out', str(out)]) == 0
    return out


@pytest.fixture(scope='module')
def found(report):
    return json.loads((report / 'results.json').read_text(encoding='utf-8'))


def test_claims_and_laws_are_printed_and_figures_drawn(report, found):
    printed = (report.parent / 'printed.txt').read_text()
    for claim in found['claims']:
        assert f'{claim["says"]}\n' in printed
        assert f'{claim["measured"]}\n' in printed
    assert 'recommended' in printed
    assert len(list(report.glob('*.png'))) == 5


def test_verdicts_follow_from_the_runs_of_the_report(found):
    """Those verdicts about which the mathematics leaves no doubt."""
    verdicts = {row['says']: row['verdict'] for row in found['claims']}
    assert len(verdicts) >= 11
    assert verdicts['The reference does not fully excite the system.'] == FAILS
    assert verdicts['With everything known V decreases for all time.'] == ONLY_IF
    assert verdicts['It is superior in tracking and in estimation.'] == ONLY_IF
    assert verdicts['The proposed controller always stays within the boundaries.'] == HOLDS
    # w = 1 N m/rad is a spring with 2 mN m at 2 mrad, and the push is 8 N m.
    assert found['metrics']['paper_pushed']['max_error_ratio'] > 1.0
    assert found['metrics']['recommended_pushed']['max_error_ratio'] < 0.5
    for row in found['claims']:
        assert bool(row['condition']) or row['verdict'] != ONLY_IF


def test_saved_configurations_are_those_that_ran(report, found):
    """Running one case of a sweep again from its file reproduces the number in the report."""
    name = case_name('delay', 'comparison', 1.0)
    loop = load_loop(report / 'configurations' / f'{name.replace(" ", "_")}.yaml')
    again = measure(simulate(loop.controller, loop.plant, supervised=False).run())
    metrics = found['metrics']
    assert metrics[name]['max_error_ratio'] == again.max_error_ratio
    assert loop.plant.actuator.delay == 1
    assert len(list((report / 'configurations').iterdir())) == len(metrics) == len(CASES)


def test_exponential_fit_distinguishes_exponential_from_algebraic_decay():
    time = np.arange(1001) * 0.02
    latched = time >= 2.0
    exponential = np.exp(-np.maximum(time - 2.0, 0.0))  # from the latch on
    algebraic = 1.0 / (1.0 + time) ** 3
    fits = [claims._exponential_fit(time, error, latched) for error in (exponential, algebraic)]
    assert fits[0] > 0.999
    assert fits[1] < fits[0]


ROOT = Path(__file__).resolve().parents[1]
PAGES = {name: (ROOT / 'doc' / f'{name}.md').read_text() for name in ('theory', 'errata', 'tuning')}
TESTS = ''.join(path.read_text() for path in (ROOT / 'test').glob('test_*.py'))


@pytest.mark.parametrize('page', PAGES)
def test_every_test_and_preset_named_on_a_page_exists(page):
    text = PAGES[page]
    for name in re.findall(r'`(test_\w+)`', text):
        assert f'def {name}' in TESTS, name
    for path in re.findall(r'`?(test/test_\w+\.py)', text):
        assert (ROOT / path).is_file(), path
    for preset in re.findall(r'--config (\w+)', text):
        assert locate(preset).is_file()


def test_every_erratum_and_every_test_of_one_has_a_row():
    rows = [int(number) for number in re.findall(r'^\| (\d+)', PAGES['errata'], re.MULTILINE)]
    assert rows == list(range(1, 27))
    tested = {int(number) for number in re.findall(r'def test_erratum_(\d+)_', TESTS)}
    assert tested <= set(rows)
    for line in PAGES['errata'].splitlines():
        if re.match(r'\| \d', line):
            assert '`test_' in line, line


def test_every_parameter_named_on_the_tuning_page_exists():
    names = re.findall(r'`((?:\w+\.)+\w+)`', PAGES['tuning'])
    groups = {name.split('.')[0] for name in known_names()}
    wanted = [name for name in names if name.split('.')[0] in groups]
    assert len(wanted) > 15
    assert set(wanted) <= known_names()


def test_table_of_the_laws_matches_the_presets(found):
    """Columns as `make paper` writes them: joint1 / joint2. README has some of the rows."""
    row = r'^\| `(\w+)`[^|]*\| ([\d.]+) / ([\d.]+) \| ([\d.]+) / ([\d.]+) \| ([\d.]+)?'
    page = (ROOT / 'doc' / 'comparison.md').read_text()
    rows = re.findall(row, page, re.MULTILINE)
    short = re.findall(row, (ROOT / 'README.md').read_text(), re.MULTILINE)
    assert short
    assert set(short) <= set(rows)
    assert len(rows) == 7
    for preset, *errors, parameter_error in rows:
        metrics = found['metrics'][preset]
        values = 1e3 * np.array(metrics['max_error'] + metrics['rms_error'])
        np.testing.assert_allclose(values, np.array(errors, float), rtol=0.01)
        if parameter_error:
            percent = 100 * metrics['final_parameter_error']
            assert percent == pytest.approx(float(parameter_error), rel=0.1)


def error_at_phase(preset, phase):
    """Relative parameter error after a minute, with this phase of the disturbance's sinusoid."""
    arm = {'disturbance.phase': [phase, phase]}
    return run(configured(preset, 60.0, arm=arm)).parameter_error[-1]


def test_parameter_error_depends_on_the_phase_of_the_disturbance_as_documented():
    """0.1 cos t N m on both joints looks like 0.1 / 0.6 kg m^2 of the second parameter."""
    assert error_at_phase('recommended', np.pi / 2) == pytest.approx(
        0.1 / 0.6 / np.linalg.norm(P), abs=1e-3
    )
    assert error_at_phase('recommended', 17.0) == pytest.approx(0.143, abs=5e-4)
    for phase in (0.0, np.pi / 2, 17.0):
        assert error_at_phase('two_tone', phase) < 5e-5
        assert 0.004 < error_at_phase('excitation', phase) < 0.008
    for page in ('README.md', 'doc/theory.md', 'doc/comparison.md'):
        text = ' '.join((ROOT / page).read_text().split())
        assert '14.8 %' in text
        assert 'below 0.005 %' in text


def test_numbers_on_the_pages_match_the_runs():
    assert 'a fifth is left' in ' '.join(PAGES['theory'].split())
    errors = [
        run(configured('recommended', 60.0, {'learning.weight': weight})).parameter_error[-1]
        for weight in (100.0, 500.0)
    ]
    assert errors[0] / errors[1] == pytest.approx(5.0, abs=0.5)

    assert '7 % at 5 s instead of 0.01 % at 2π' in PAGES['tuning']
    window = run(configured('recommended', 30.0, {'learning.window': 5.0}))
    assert window.error_at(30.0) == pytest.approx(0.07, abs=0.015)
