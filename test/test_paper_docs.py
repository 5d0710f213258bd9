# SPDX-License-Identifier: Apache-2.0
"""Tests, presets, parameters, errata and numbers on the pages about the paper exist and agree."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from paper_case import P, configured, run

from blf_dsc_controller.configuration.nodes import known_names, locate

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


def test_table_of_the_laws_matches_the_presets():
    """Columns as `make paper` writes them: joint1 / joint2. README has some of the rows."""
    row = r'^\| `(\w+)`[^|]*\| ([\d.]+) / ([\d.]+) \| ([\d.]+) / ([\d.]+) \| ([\d.]+)?'
    page = (ROOT / 'doc' / 'comparison.md').read_text()
    rows = re.findall(row, page, re.MULTILINE)
    short = re.findall(row, (ROOT / 'README.md').read_text(), re.MULTILINE)
    assert short
    assert set(short) <= set(rows)
    assert len(rows) == 7
    for preset, *errors, parameter_error in rows:
        loop = run(configured(preset, 60.0))
        peak = 1e3 * np.abs(loop.xi1).max(axis=0)
        rms = 1e3 * np.sqrt(np.mean(loop.xi1**2, axis=0))
        np.testing.assert_allclose([*peak, *rms], np.array(errors, float), rtol=0.01)
        if parameter_error:
            assert 100 * loop.parameter_error[-1] == pytest.approx(float(parameter_error), rel=0.1)


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
