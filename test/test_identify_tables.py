# SPDX-License-Identifier: Apache-2.0
"""Recordings from tables as people have them, and results in other formats than URDF."""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import (
    PANDA,
    PANDA_CHAIN,
    PANDA_TEXT,
    measured,
    reference_of,
    shake,
    truth_of,
)
from test_identify_foreign_tables import written

from blf_dsc_controller import ControllerConfig
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import CONTROLLER, load

TRUTH = truth_of(PANDA_CHAIN, 1)


@pytest.fixture(scope='module')
def states():
    return measured(shake(PANDA_CHAIN, TRUTH, reference_of(PANDA_CHAIN, 2), 20.0), 3)


@pytest.fixture
def csv(states, tmp_path):
    """A file of the states at 200 Hz, and the URDF."""
    (tmp_path / 'panda.urdf').write_text(PANDA_TEXT)
    few = states[::5]
    names = ['time', *(f'{stem}_{k}' for stem in ('q', 'tau') for k in range(7))]
    columns = [np.arange(len(few)) * 0.005, few[:, 0], few[:, 2]]
    return written(tmp_path / 'run.csv', names, columns)


def test_csv_becomes_a_corrected_urdf_and_parameters(csv, monkeypatch, capsys):
    monkeypatch.chdir(csv.parent)
    words = ['--urdf', 'panda.urdf', '--tip', 'panda_hand_tcp']
    for name in ('new.urdf', 'new.yaml'):
        words += ['--out', name]
    assert main(['identify', 'run.csv', *words]) == 0
    output = capsys.readouterr().out
    assert 'run.csv' in output
    assert 'kg m^2' in output
    config = load(csv.parent / 'new.yaml', CONTROLLER, ControllerConfig)
    assert config.joints == PANDA
    np.testing.assert_allclose(config.robot.viscous, TRUTH.viscous, rtol=0.05)
    np.testing.assert_allclose(
        config.robot.rotor_inertia[1:], TRUTH.rotors[1:], rtol=0.05
    )
    np.testing.assert_allclose(config.robot.coulomb, TRUTH.coulomb, rtol=0.05)
    # once more, without and with leave to overwrite
    assert main(['identify', 'run.csv', *words]) == 1


def test_two_recordings_are_identified_together(csv, capsys):
    urdf = str(csv.parent / 'panda.urdf')
    page = str(csv.parent / 'page.html')
    words = ['--urdf', urdf, '--tip', 'panda_hand_tcp', '--report', page]
    assert main(['identify', str(csv), str(csv), *words]) == 0
    assert ': 40.0 s of 7 joints' in ' '.join(capsys.readouterr().out.split())


def test_efforts_of_opposite_sign_are_found_and_named(states, tmp_path, capsys):
    """The first joint of an upright arm carries no gravity: its friction shows the sign."""
    signs = np.array([-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0])
    (tmp_path / 'panda.urdf').write_text(PANDA_TEXT)
    time = np.arange(len(states)) * 0.001
    np.savez(tmp_path / 'a.npz', t=time, q=states[:, 0], tau=signs * states[:, 2])
    words = ['--urdf', str(tmp_path / 'panda.urdf'), '--tip', 'panda_hand_tcp']
    new = tmp_path / 'new.urdf'
    code = main(['identify', str(tmp_path / 'a.npz'), *words, '--out', str(new)])
    output = ' '.join(capsys.readouterr().out.split())
    assert code == 0
    wrong = [name for name, sign in zip(PANDA, signs, strict=True) if sign < 0.0]
    assert f'the efforts of {", ".join(wrong)} have the opposite sign' in output


def test_currents_without_gains_give_no_urdf(states, tmp_path, capsys):
    """Named so they are refused; else a tenth of the gravity shows that they are no torques."""
    (tmp_path / 'panda.urdf').write_text(PANDA_TEXT)
    few = states[::5]
    motion = {'t': np.arange(len(few)) * 0.005, 'q': few[:, 0]}
    named, unnamed = tmp_path / 'named.npz', tmp_path / 'unnamed.npz'
    np.savez(named, **motion, current=0.1 * few[:, 2])
    np.savez(unnamed, **motion, tau=0.1 * few[:, 2])
    new = tmp_path / 'new.urdf'
    words = ['--out', str(new), '--tip', 'panda_hand_tcp']
    words += ['--urdf', str(tmp_path / 'panda.urdf')]
    assert main(['identify', str(named), *words]) == 1
    error = capsys.readouterr().err
    assert 'these are currents' in error
    assert '--gains [N m/A or N m/%] of panda_joint1' in error
    assert main(['identify', str(unnamed), *words]) == 3
    output = ' '.join(capsys.readouterr().out.split())
    assert 'the efforts contain 0.1' in output
    assert 'If they are currents, give --gains' in output
    assert not new.exists()  # nor is it to be used, unless somebody insists
    assert main(['identify', str(unnamed), *words, '--force']) == 3
    new.unlink()
    assert main(['identify', str(named), *words, '--gains', *['10'] * 7]) == 0
    assert new.exists()
