# SPDX-License-Identifier: Apache-2.0
"""Recordings from tables as people have them, and results in other formats than URDF."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from random_arm import (
    GRAVITY,
    PANDA,
    PANDA_CHAIN,
    PANDA_TEXT,
    measured,
    recording_of,
    reference_of,
    shake,
    truth_of,
)
from scipy.io import savemat

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.cli import identify as command
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, load
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.from_files import identify_bag
from blf_dsc_controller.identification.from_table import read_table
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.mjcf import mjcf
from blf_dsc_controller.identification.problem import problem_of
from blf_dsc_controller.identification.recording import Recording

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


@pytest.mark.parametrize(
    ('time', 'q', 'dq', 'tau', 'delimiter'),
    [
        ('t', numbered('q_'), numbered('dq_'), numbered('tau_'), ','),
        ('time [s]', numbered('Joint'), numbered('v'), numbered('effort'), ';'),
        (
            'timestamp',
            [f'position {name} [rad]' for name in PANDA],
            [f'velocity {name} [rad/s]' for name in PANDA],
            [f'effort {name} [N m]' for name in PANDA],
            '\t',
        ),
    ],
)
def test_columns_are_found_by_their_names(tmp_path, time, q, dq, tau, delimiter):
    if q[0] == 'Joint1':
        q = [f'{name}_Pos' for name in q]
    names = [time, *q, *dq, *tau]
    columns = [TIME, Q, np.zeros_like(Q), TAU]
    is_read(write_csv(tmp_path / 'a.csv', names, columns, delimiter))


def test_columns_are_those_of_the_joints_in_any_order(tmp_path):
    names = ['t', *(f'q {name}' for name in PANDA[::-1])]
    names += [f'tau {name}' for name in PANDA]
    is_read(write_csv(tmp_path / 'a.csv', names, [TIME, Q[:, ::-1], TAU]))


def test_desired_and_external_values_are_not_taken_for_measured_ones(tmp_path):
    names = ['t', *numbered('q_'), *numbered('q_d_'), *numbered('tau_ext_')]
    names += numbered('tau_')
    columns = [TIME, Q, np.ones_like(Q), np.ones_like(Q), TAU]
    is_read(write_csv(tmp_path / 'a.csv', names, columns))


@pytest.mark.parametrize(
    ('name', 'unit'), [('time_s', 1.0), ('t_ms', 1e-3), ('t_us', 1e-6), ('t_ns', 1e-9)]
)
def test_time_is_in_the_unit_of_its_name(tmp_path, name, unit):
    np.savez(tmp_path / 'a.npz', **{name: 3.0 + TIME / unit}, q=Q, tau=TAU)
    is_read(tmp_path / 'a.npz')


def test_columns_without_names_are_given_by_number_and_rows_by_rate(tmp_path):
    path = tmp_path / 'a.txt'
    np.savetxt(path, np.column_stack((Q, TAU)))
    is_read(path, 'q=0:7', 'tau=7:14', 'time=100Hz')


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


@pytest.mark.parametrize(
    ('names', 'columns', 'message'),
    [
        (['t', *numbered('q_')], [TIME, Q], 'which columns are tau of panda_joint1'),
        ([*numbered('q_'), *numbered('tau_')], [Q, TAU], '--map time=100Hz'),
        (
            ['t', *numbered('q_'), *numbered('tau_')[:6]],
            [TIME, Q, TAU[:, :6]],
            'choose as many',
        ),
        (
            ['t', *numbered('q_'), *['tau'] * 7],
            [TIME, Q, TAU],
            'which columns are tau of .* Its columns are .* 8, 9,',
        ),
    ],
)
def test_unclear_tables_are_rejected_with_a_remedy(tmp_path, names, columns, message):
    path = write_csv(tmp_path / 'a.csv', names, columns)
    with pytest.raises(BlfDscError, match=message):
        read_table(path, PANDA_TEXT)


@pytest.mark.parametrize('suffix', ['csv', 'npz', 'mat'])
def test_files_that_are_no_tables_are_rejected(tmp_path, suffix):
    path = tmp_path / f'a.{suffix}'
    path.write_bytes(b'\0\1\2\3 no table\n' * 20)
    with pytest.raises(BlfDscError, match=r'a\.'):
        read_table(path, PANDA_TEXT)


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


def test_csv_becomes_a_corrected_urdf_mjcf_and_parameters(csv, monkeypatch, capsys):
    monkeypatch.chdir(csv.parent)
    words = ['--urdf', 'panda.urdf', '--tip', 'panda_hand_tcp']
    for name in ('new.urdf', 'new.xml', 'new.yaml'):
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
    model = mujoco.MjModel.from_xml_path('new.xml')
    np.testing.assert_allclose(model.dof_armature[1:], TRUTH.rotors[1:], rtol=0.05)
    np.testing.assert_allclose(model.dof_frictionloss, TRUTH.coulomb, rtol=0.05)
    # once more, without and with leave to overwrite
    assert main(['identify', 'run.csv', *words]) == 1


def test_two_recordings_are_identified_together(csv, capsys):
    urdf = str(csv.parent / 'panda.urdf')
    page = str(csv.parent / 'page.html')
    words = ['--urdf', urdf, '--tip', 'panda_hand_tcp', '--report', page]
    assert main(['identify', str(csv), str(csv), *words]) == 0
    assert ': 40.0 s of 7 joints' in ' '.join(capsys.readouterr().out.split())


def test_mjcf_has_the_torques_of_the_identified_arm(states):
    """MuJoCo's inverse dynamics against the regressor, friction aside."""
    recording = Recording(
        PANDA, 0.001, states[:, 0], states[:, 2], np.zeros(len(states), dtype=bool), ''
    )
    found = identify_arm(recording, Robot(urdf=PANDA_TEXT, tip='panda_hand_tcp'))
    model = mujoco.MjModel.from_xml_string(mjcf(found, GRAVITY, 'a -- b'))
    model.dof_damping[:] = 0.0
    model.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(model)
    parameters = base_parameters(PANDA_CHAIN, GRAVITY)
    P = parameters.of(found.parts.bodies, found.parts.terms[0])
    q, dq, ddq = reference_of(PANDA_CHAIN, 9).at(1.0)
    data.qpos[:] = q
    data.qvel[:] = dq
    data.qacc[:] = ddq
    mujoco.mj_inverse(model, data)
    H = regressors_at(parameters.model, q[None], dq[None], dq[None], ddq[None])[0]
    np.testing.assert_allclose(data.qfrc_inverse, H @ P, rtol=1e-6, atol=1e-6)
    assert serial_chain(PANDA_CHAIN, GRAVITY).n == model.nv


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


@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_sign_that_neither_gravity_nor_friction_shows_is_that_of_the_others(
    states, sign
):
    """The first joint's torque is hardly more than noise."""
    faint = states[::5].copy()
    faint[:, 2, 0] = np.random.default_rng(0).normal(size=len(faint))
    faint[:, 2] *= sign
    recording = recording_of(faint, period=0.005)
    robot = Robot(urdf=PANDA_TEXT, tip='panda_hand_tcp')
    problem = problem_of(recording, robot, 'torque', None, find_signs=True)
    assert (problem.reversed == (sign < 0.0)).all()


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
