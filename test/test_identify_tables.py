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
from scipy.io import savemat

from blf_dsc_controller import ControllerConfig
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.cli import identify as command
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import CONTROLLER, load
from blf_dsc_controller.identification.from_files import identify_bag
from blf_dsc_controller.identification.from_table import read_table

RATE = 100.0  # Hz
TIME = np.arange(300) / RATE
Q = np.sin(np.multiply.outer(TIME, np.arange(1.0, 8.0)))
TAU = 10.0 * np.cos(np.multiply.outer(TIME, np.arange(1.0, 8.0)))


def write_csv(path, names, columns, delimiter=','):
    header = delimiter.join(names)
    np.savetxt(path, np.column_stack(columns), header=header, comments='', fmt='%.9f',
               delimiter=delimiter)  # fmt: skip
    return path


def numbered(stem):
    return [f'{stem}{k}' for k in range(1, 8)]


def is_read(path, *entries):
    recording = read_table(path, PANDA_TEXT, names=NameMap.parse(entries))
    assert recording.joints == PANDA
    assert recording.period == pytest.approx(1.0 / RATE, rel=1e-6)
    samples = len(recording.q)
    assert samples >= len(TIME) - 1
    np.testing.assert_allclose(recording.q, Q[:samples], atol=1e-7)
    np.testing.assert_allclose(recording.torque, TAU[:samples], atol=1e-6)


def test_matrices_of_npz_and_structures_of_mat_are_read(tmp_path):
    np.savez(tmp_path / 'a.npz', t=TIME, q=Q, dq=np.zeros_like(Q), tau=TAU.T)
    is_read(tmp_path / 'a.npz')
    savemat(
        tmp_path / 'a.mat', {'log': {'time_ms': 1e3 * TIME, 'pos': Q, 'torque': TAU}}
    )
    is_read(tmp_path / 'a.mat')


def test_missing_cells_and_rows_are_gaps(tmp_path):
    tau = TAU.copy()
    tau[100:150, 3] = np.nan
    np.savez(tmp_path / 'a.npz', t=TIME, q=Q, tau=tau)
    recording = read_table(tmp_path / 'a.npz', PANDA_TEXT)
    assert recording.gap[105:145].all()
    assert not recording.gap[:95].any()


# Results.

TRUTH = truth_of(PANDA_CHAIN, 1)


@pytest.fixture(scope='module')
def states():
    return measured(shake(PANDA_CHAIN, TRUTH, reference_of(PANDA_CHAIN, 2), 20.0), 3)


@pytest.fixture
def csv(states, tmp_path):
    """A file of the states at 200 Hz, and the URDF."""
    (tmp_path / 'panda.urdf').write_text(PANDA_TEXT)
    few = states[::5]
    names = ['time', *numbered('q_'), *numbered('tau_')]
    columns = [np.arange(len(few)) * 0.005, few[:, 0], few[:, 2]]
    return write_csv(tmp_path / 'run.csv', names, columns)


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


def test_urdf_that_is_not_to_be_used_is_written_on_demand_only(
    states, tmp_path, capsys, monkeypatch
):
    """Efforts that are those of another joint; identified once, and written by the second run."""
    (tmp_path / 'panda.urdf').write_text(PANDA_TEXT)
    few = states[:8_000:5]
    time = np.arange(len(few)) * 0.005
    mixed = few[:, 2, ::-1]
    np.savez(tmp_path / 'a.npz', t=time, q=few[:, 0], tau=mixed)
    new = tmp_path / 'new.urdf'
    words = ['identify', str(tmp_path / 'a.npz'), '--out', str(new)]
    words += ['--urdf', str(tmp_path / 'panda.urdf'), '--tip', 'panda_hand_tcp']
    found = []

    def identified_once(*given, **named):
        if not found:
            found.append(identify_bag(*given, **named))
        return found[0]

    monkeypatch.setattr(command, 'identify_bag', identified_once)
    assert main(words) == 3
    assert 'DO NOT USE' in capsys.readouterr().out
    assert not new.exists()
    assert main([*words, '--force']) == 3
    assert new.exists()


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
    assert not new.exists()
    assert main(['identify', str(named), *words, '--gains', *['10'] * 7]) == 0
    assert new.exists()
