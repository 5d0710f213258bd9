# SPDX-License-Identifier: Apache-2.0
"""Laws side by side: the paper's claims and what pages say of them; laws on arms from URDFs."""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from paper_case import P, configured, run
from scipy.linalg import expm

from benchmark import tuning
from benchmark.__main__ import main as table
from benchmark.paper import CASES, FAILS, HOLDS, ONLY_IF, case_name
from blf_dsc_controller import (
    PlantConfig,
    change,
    load_loop,
    measure,
    simulate,
)
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import known_names, locate
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.reference import terms
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.studies import laws


@pytest.mark.nightly
@pytest.mark.parametrize('name', tuning.TASKS)
def test_committed_gains_beat_the_middle_of_their_ranges(name):
    """By at least a decade of the search's objective, whose value is stated in their file."""
    task = tuning.TASKS[name]
    preset = {'proposed': 'paper_tuned'}.get(name, name)
    middle = np.array([np.log10(gain.least * gain.most) / 2.0 for gain in task.gains])
    loops = tuning.loops_of(task)
    bare = task._replace(gains=())
    tuned = load_loop(preset).controller
    best = tuning.objective(
        np.array([]), bare, [loop._replace(controller=tuned) for loop in loops]
    )
    assert best < tuning.objective(middle, task, loops) - 1.0
    stated = re.search(
        r'objective (-?[\d.]+)', locate(preset).read_text(encoding='utf-8')
    )
    assert best == pytest.approx(float(stated.group(1)), abs=0.01)


@pytest.fixture(scope='module')
def report(tmp_path_factory):
    """The report of the whole study, run once: about 20 s on two cores."""
    out = tmp_path_factory.mktemp('study') / 'report'
    with (
        (out.parent / 'printed.txt').open('w') as file,
        contextlib.redirect_stdout(file),
    ):
        assert table(['paper', '--out', str(out)]) == 0
    return out


@pytest.fixture(scope='module')
def found(report):
    return json.loads((report / 'results.json').read_text(encoding='utf-8'))


@pytest.mark.nightly
def test_claims_and_laws_are_printed_and_figures_drawn(report, found):
    printed = (report.parent / 'printed.txt').read_text()
    for claim in found['claims']:
        assert f'{claim["says"]}\n' in printed
        assert f'{claim["measured"]}\n' in printed
    assert 'recommended' in printed
    assert len(list(report.glob('*.png'))) == 5


@pytest.mark.nightly
def test_verdicts_follow_from_the_runs_of_the_report(found):
    """Those verdicts about which the mathematics leaves no doubt."""
    verdicts = {row['says']: row['verdict'] for row in found['claims']}
    assert len(verdicts) >= 11
    assert verdicts['The reference does not fully excite the system.'] == FAILS
    assert verdicts['With everything known V decreases for all time.'] == ONLY_IF
    assert verdicts['It is superior in tracking and in estimation.'] == ONLY_IF
    assert (
        verdicts['The proposed controller always stays within the boundaries.'] == HOLDS
    )
    assert verdicts['Tracking and parameter errors converge exponentially.'] == HOLDS
    # w = 1 N m/rad is a spring with 2 mN m at 2 mrad, and the push is 8 N m.
    assert found['metrics']['paper_pushed']['max_error_ratio'] > 1.0
    assert found['metrics']['recommended_pushed']['max_error_ratio'] < 0.5
    for row in found['claims']:
        assert bool(row['condition']) or row['verdict'] != ONLY_IF


@pytest.mark.nightly
def test_saved_configurations_are_those_that_ran(report, found):
    """Running one case of a sweep again from its file reproduces the number in the report."""
    name = case_name('delay', 'comparison', 1.0)
    loop = load_loop(report / 'configurations' / f'{name.replace(" ", "_")}.yaml')
    again = measure(simulate(loop.controller, loop.plant, supervised=False).run())
    metrics = found['metrics']
    assert metrics[name]['max_error_ratio'] == again.max_error_ratio
    assert loop.plant.actuator.delay == 1
    assert (
        len(list((report / 'configurations').iterdir())) == len(metrics) == len(CASES)
    )


ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    name: (ROOT / 'doc' / f'{name}.md').read_text()
    for name in ('theory', 'learning', 'stability', 'errata', 'gains')
}
TESTS = ''.join(path.read_text() for path in (ROOT / 'test').glob('test_*.py'))


@pytest.mark.parametrize('page', PAGES)
def test_every_test_and_preset_named_on_a_page_exists(page):
    text = PAGES[page]
    for name in re.findall(r'`(test_\w+)`', text):
        assert f'def {name}' in TESTS, name
    for path in re.findall(r'`?(test/test_\w+\.py)', text):
        assert (ROOT / path).is_file(), path
    for preset in re.findall(r'--config (\w+)(?![\w.])', text):
        assert locate(preset).is_file()


def test_every_erratum_and_every_test_of_one_has_a_row():
    rows = [
        int(number)
        for number in re.findall(r'^\| (\d+)', PAGES['errata'], re.MULTILINE)
    ]
    assert rows == list(range(1, 27))
    tested = {int(number) for number in re.findall(r'def test_erratum_(\d+)_', TESTS)}
    assert tested <= set(rows)
    for line in PAGES['errata'].splitlines():
        if re.match(r'\| \d', line):
            assert '`test_' in line, line


def test_every_parameter_named_on_the_page_of_gains_exists():
    names = re.findall(r'`((?:\w+\.)+\w+)`', PAGES['gains'])
    groups = {name.split('.')[0] for name in known_names()}
    wanted = [name for name in names if name.split('.')[0] in groups]
    assert len(wanted) > 15
    assert set(wanted) <= known_names()


@pytest.mark.nightly
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
            percent = 100 * metrics['parameter_error']['end']
            assert percent == pytest.approx(float(parameter_error), rel=0.1)


def error_at_phase(preset, phase):
    """Relative parameter error after a minute, with this phase of the disturbance's sinusoid."""
    arm = {'disturbance.phase': [phase, phase]}
    return run(configured(preset, 60.0, arm=arm)).parameter_error[-1]


@pytest.mark.nightly
def test_parameter_error_depends_on_the_phase_of_the_disturbance_as_documented():
    """0.1 cos t N m on both joints looks like 0.1 / 0.6 kg m^2 of the second parameter."""
    assert error_at_phase('recommended', np.pi / 2) == pytest.approx(
        0.1 / 0.6 / np.linalg.norm(P), abs=1e-3
    )
    assert error_at_phase('recommended', 17.0) == pytest.approx(0.143, abs=5e-4)
    for phase in (0.0, np.pi / 2, 17.0):
        assert error_at_phase('two_tone', phase) < 5e-5
        assert 0.004 < error_at_phase('excitation', phase) < 0.008
    for page in ('README.md', 'doc/stability.md', 'doc/comparison.md'):
        text = ' '.join((ROOT / page).read_text().split())
        assert '14.8 %' in text
        assert 'below 0.005 %' in text


def test_numbers_on_the_pages_match_the_runs():
    assert 'a fifth is left' in ' '.join(PAGES['stability'].split())
    errors = [
        run(
            configured('recommended', 60.0, {'two_link.learning_weight': weight})
        ).parameter_error[-1]
        for weight in (100.0, 500.0)
    ]
    assert errors[0] / errors[1] == pytest.approx(5.0, abs=0.5)

    assert '7 % at 5 s instead of 0.01 % at 2π' in PAGES['gains']
    window = run(configured('recommended', 30.0, {'learning.window': 5.0}))
    assert window.error_at(30.0) == pytest.approx(0.07, abs=0.015)


IMPORT = 'from blf_dsc_controller.studies.laws import StudiedLaw\n'
E0 = 0.004 * np.array([1.0, -0.5, 0.2, 0.8, -1.0, 0.6])  # rad, inside the bound
GAINS = {'gains.position': 900.0, 'gains.velocity': 50.0, 'gains.integral': 1e-9}
FRICTIONLESS = {'robot.viscous': [0.0] * 6, 'robot.coulomb': [0.0] * 6}


def ideal(period, law=FRICTIONLESS):
    """A UR5e true to its URDF, with ideal sensors and drives, in motion E0 off its reference."""
    loop = load_loop('ur5e_rigid')
    step = {'sample_time': period}
    config = loop.controller
    robot = {'robot.urdf': 'ur5e.urdf', 'robot.tip': 'tool0'}
    config = change(config, step | law)
    ((q, dq, _),) = terms.sampled(reference_of(config), np.zeros(1))
    start = {'initial.position': (q + E0).tolist(), 'initial.velocity': dq.tolist()}
    plant = build(PlantConfig, robot | step | start | {'duration': 0.1})
    return loop._replace(plant=plant, controller=config)


def simulated(loop, gains):
    """Return true errors [rad] and torques [N m] of computed torque with these gains."""
    config = change(loop.controller, {'law': laws.COMPUTED_TORQUE} | gains)
    record = simulate(config, loop.plant, supervised=False)
    torques = sample_columns(record.samples, record.controller.settings).torque
    return record.true_errors(), torques


def deviation(period):
    """Largest difference to the errors of e'' + k_d e' + k_p e = 0."""
    errors, torques = simulated(ideal(period), GAINS)
    A = np.array([[0.0, 1.0], [-900.0, -50.0]])
    decay = [expm(A * period * k)[0, 0] for k in range(len(errors))]
    np.testing.assert_allclose(errors[0], E0, atol=1e-15)
    assert np.ptp(torques, axis=0).max() > 5.0
    return np.abs(errors - np.outer(decay, E0)).max()


def test_law_of_a_file_acts_at_the_right_time():
    """Computed torque with the true model; the deviation is of first order in the sample time."""
    coarse, fine = deviation(4e-3), deviation(1e-3)
    assert fine < 0.02 * np.abs(E0).max()
    assert coarse / fine == pytest.approx(4.0, rel=0.1)


def test_file_without_a_usable_law_is_rejected(tmp_path, capsys):
    taken = f"{IMPORT}LAWS = {{'slotine_li': StudiedLaw('mine')}}"
    gain = "(type('Gain', (), {'name': 'gains.k', 'least': 9.0, 'most': 1.0}),)"
    turned = f"{IMPORT}LAWS = {{'mine': StudiedLaw('mine', {gain})}}"
    for name, text, problem in (
        ('missing.py', None, 'expected a law of the study (proposed, '),
        ('json.py', '', 'there is another module of this name'),
        ('broken.py', '1 / 0', 'cannot be imported: ZeroDivisionError'),
        ('unclosed.py', '\nLAWS = {', 'cannot be imported: line 2: '),
        ('empty.py', '', 'LAWS must be a dict of StudiedLaw by name. For the law of'),
        ('taken.py', taken, 'has a law slotine_li already'),
        (
            'turned.py',
            turned,
            "got Gain('gains.k', 9, 1), but its range must be above 0",
        ),
    ):
        if text is not None:
            (tmp_path / name).write_text(text)
        out = tmp_path / 'out'
        assert main(['arms', '--laws', str(tmp_path / name), '--out', str(out)]) == 1
        assert problem in capsys.readouterr().err
        assert not out.exists()


def test_laws_of_a_file_join_those_chosen_by_name(tmp_path, monkeypatch, capsys):
    assert (
        main(['arms', '--config', 'recommended', '--out', str(tmp_path / 'out')]) == 1
    )
    assert 'got model two_link' in capsys.readouterr().err
    monkeypatch.setattr(laws, 'LAWS', dict(laws.LAWS))
    file = tmp_path / 'law_of_mine.py'
    file.write_text(f"{IMPORT}LAWS = {{'mine': StudiedLaw('mine')}}")
    assert laws.chosen_laws([]) == list(laws.LAWS)
    for _ in range(2):  # a worker that was forked has it already
        assert laws.chosen_laws(['slotine_li', str(file)]) == [
            'proposed',
            'slotine_li',
            'mine',
        ]
