# SPDX-License-Identifier: Apache-2.0
"""Tables as other tools write them, and as people name their columns."""

from __future__ import annotations

import importlib
import os
import warnings
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pytest
import recorded_run
from random_arm import PANDA, PANDA_TEXT, UR5E, UR5E_TEXT
from scipy.io import savemat

from blf_dsc_controller import BlfDscError
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.identification.from_files import read_recording
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import JOINT_STATES

PERIOD = 0.01  # s
TIME = np.arange(300) * PERIOD
Q = np.sin(np.multiply.outer(TIME, np.arange(1.0, 7.0)))
TAU = 10.0 * np.cos(np.multiply.outer(TIME, np.arange(1.0, 7.0)))
EPOCH = 1_700_000_000  # s
NUMBERS = range(1, 7)
# As drivers of Universal Robots list their joints: by the alphabet
SHUFFLED = tuple(sorted(UR5E))
ORDER = [UR5E.index(name) for name in SHUFFLED]


def numbered(stem, unit=''):
    return [f'{stem}_{k}{unit}' for k in NUMBERS]


def written(path, names, columns, delimiter=',', decimal='.', before='', **how):
    """Write a table; a name that is None is that of text cells."""
    table = np.column_stack(columns)
    rows = [[f'{value:.17g}' for value in row] for row in table]
    lines = [delimiter.join(row).replace('.', decimal) for row in rows]
    header = [delimiter.join(names)] if names else []
    path.write_text('\n'.join([*([before] if before else []), *header, *lines]), **how)
    return path


def is_read(path, *entries, time=TIME, urdf=UR5E_TEXT):
    """Whether the motion is read as it is, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        recording = read_recording(path, urdf, names=NameMap.parse(entries))
    assert recording.joints == UR5E
    assert recording.period == pytest.approx(PERIOD, rel=1e-4)
    samples = len(recording.q)
    assert samples >= len(time) - 2
    # stamps since 1970 have no more than 0.3 us in a float
    time = np.multiply.outer(np.arange(samples) * recording.period, NUMBERS)
    np.testing.assert_allclose(recording.q, np.sin(time), atol=1e-5)
    np.testing.assert_allclose(recording.torque, 10.0 * np.cos(time), atol=1e-4)


def refused(path, *entries):
    with pytest.raises(BlfDscError) as error:
        read_recording(path, UR5E_TEXT, names=NameMap.parse(entries))
    message = str(error.value)
    assert '\n' not in message
    return message


# What the tools of ROS print.


@pytest.mark.parametrize('measured', [('position', 'velocity'), ('position',)])
def test_rostopic_echo_p_is_read_with_its_names_and_nanoseconds(tmp_path, measured):
    n = range(len(SHUFFLED))
    fields = [f'field.{field}{k}' for field in (*measured, 'effort') for k in n]
    head = ['%time', 'field.header.seq', 'field.header.stamp', 'field.header.frame_id']
    lines = [','.join([*head, *(f'field.name{k}' for k in n), *fields])]
    for k, t in enumerate(TIME):
        stamp = EPOCH * 10**9 + round(t * 1e9)
        velocities = np.zeros(6 * ('velocity' in measured))
        values = [*Q[k, ORDER], *velocities, *TAU[k, ORDER]]
        cells = [f'{stamp + 999}', f'{k}', f'{stamp}', 'base', *SHUFFLED]
        lines.append(','.join([*cells, *(f'{value:.9g}' for value in values)]))
    path = tmp_path / 'a.csv'
    path.write_text('\n'.join(lines))
    is_read(path)


def test_ros2_topic_echo_csv_is_read_without_a_header(tmp_path):
    lines = []
    for k, t in enumerate(TIME):
        nanoseconds = round(t * 1e9)
        stamp = [f'{EPOCH + nanoseconds // 10**9}', f'{nanoseconds % 10**9}', '']
        values = [*Q[k, ORDER], *np.zeros(6), *TAU[k, ORDER]]
        lines.append(
            ','.join([*stamp, *SHUFFLED, *(f'{value:.9g}' for value in values)])
        )
    path = tmp_path / 'a.csv'
    path.write_text('\n'.join(lines))
    is_read(path)


# Separators, headers, orders.


def test_decimal_commas_are_read_without_a_header(tmp_path):
    path = written(tmp_path / 'a.csv', [], (TIME, Q, TAU), ';', ',')
    is_read(path, 'time=0:1', 'q=1:7', 'tau=7:13')


def test_header_of_savetxt_and_lines_above_and_units_below_it_are_read(tmp_path):
    names = ['t', *numbered('q'), *numbered('tau')]
    np.savetxt(
        tmp_path / 'a.txt', np.column_stack((TIME, Q, TAU)), header=' '.join(names)
    )
    is_read(tmp_path / 'a.txt')
    title = 'Recording of Monday\n# by somebody\n'
    path = written(tmp_path / 'b.csv', names, (TIME, Q, TAU), before=title)
    is_read(path)
    units = ','.join(['ms', *['deg'] * 6, *['Nmm'] * 6])
    columns = (1e3 * TIME, np.rad2deg(Q), 1e3 * TAU)
    path = written(tmp_path / 'c.csv', [f'{",".join(names)}\n{units}'], columns)
    is_read(path)


def test_table_that_was_cut_off_and_one_with_empty_cells_are_read(tmp_path):
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (TIME, Q, TAU))
    path.write_text(path.read_text()[:-20])
    is_read(path, time=TIME[:-1])
    lines = path.read_text().splitlines()
    lines[50] = lines[50].replace(lines[50].split(',')[3], '')
    path.write_text('\n'.join(lines))
    assert not read_recording(path, UR5E_TEXT).gap[:5].any()
    lines[60] = ','.join(lines[60].split(',')[:4])
    path.write_text('\n'.join(lines))
    assert 'line 61: got 4 cells' in refused(path)


# Units.


@pytest.mark.parametrize('unit', [' [%]', ' [A]', '_mA'])
def test_percentages_and_currents_need_gains(tmp_path, unit):
    names = ['t', *numbered('q'), *numbered('tau', unit)]
    path = written(tmp_path / 'a.csv', names, (TIME, Q, TAU))
    recording = read_recording(path, UR5E_TEXT)
    assert recording.currents
    factor = 1e-3 if unit == '_mA' else 1.0
    np.testing.assert_allclose(recording.torque[:9], factor * TAU[:9], atol=1e-5)


@pytest.mark.parametrize('kind', ['revolute', 'continuous'])
def test_degrees_of_small_or_endless_turns_are_told_by_their_speed(tmp_path, kind):
    """A motion of 9 degrees stays within two turns if it is read in rad."""
    text = UR5E_TEXT.replace('type="revolute"', f'type="{kind}"')
    q = (0.16 if kind == 'revolute' else 1.6) * Q  # rad
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (TIME, np.degrees(q), TAU))
    with pytest.raises(BlfDscError, match='so it is with most joints') as error:
        read_recording(path, text)
    assert "If it is in degrees: --map 'q=q_*[deg]'" in str(error.value)
    recording = read_recording(path, text, names=NameMap.parse(['q=q_*[deg]']))
    np.testing.assert_allclose(recording.q[:290], q[:290], atol=1e-6)
    kept = read_recording(path, text, names=NameMap.parse(['q=q_*[rad]']))
    # the slowest one: others seem to wrap
    np.testing.assert_allclose(kept.q[:290][:, 0], np.degrees(q[:290, 0]), atol=1e-6)


# Time.


def test_two_runs_in_one_table_are_two_runs(tmp_path):
    """With the clock starting again, and also with the rows of another file in between."""
    names = ['t', *numbered('q'), *numbered('tau')]
    columns = [np.concatenate((values, values)) for values in (TIME, Q, TAU)]
    path = written(tmp_path / 'a.csv', names, columns)
    recording = read_recording(path, UR5E_TEXT)
    assert 'starts again 1 times: read as 2 runs' in recording.source
    assert recording.duration == pytest.approx(2 * TIME[-1] + 1.0, abs=0.03)
    second = round((TIME[-1] + 1.0) / PERIOD)
    np.testing.assert_allclose(recording.q[second : second + 250], Q[:250], atol=1e-6)
    pause = recording.gap[len(TIME) : second - 1]
    assert pause.all()
    assert not recording.gap[: len(TIME) - 1].any()
    lines = path.read_text().splitlines()
    half = 1 + len(TIME)
    path.write_text('\n'.join([*lines[:half], *lines[:half]]))  # with its header
    assert 'read as 2 runs' in read_recording(path, UR5E_TEXT).source


def test_wrapped_positions_are_unwrapped_and_said(tmp_path):
    turning = 3.0 * TIME[:, None] + np.zeros(6)
    wrapped = turning.copy()
    wrapped[:, 5] = np.angle(np.exp(1j * turning[:, 5]))
    names = ['t', *numbered('q'), *numbered('tau')]
    recording = read_recording(
        written(tmp_path / 'a.csv', names, (TIME, wrapped, TAU)), UR5E_TEXT
    )
    np.testing.assert_allclose(recording.q[:280], turning[:280], atol=1e-6)
    assert 'positions of wrist_3_joint are wrapped' in recording.source


# Numbers that are none.


@pytest.mark.parametrize(
    ('stand_in', 'column', 'rows'),
    [
        (-999.0, 0, [0, 70, 71, 150]),
        (1e10, 3, [70]),
        (1.7e308, 9, range(100, 299)),
        (-999.0, 9, [0, 70, 71, 150]),
    ],
)
def test_stand_ins_for_missing_values_are_missing_and_said(
    tmp_path, stand_in, column, rows
):
    """Of a time, a position and a torque; one, some, or two thirds of the rows."""
    table = np.column_stack((TIME, Q, TAU))
    table[rows, column] = stand_in
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, [table])
    recording = read_recording(path, UR5E_TEXT)
    said = f'{names[column]!r} is {stand_in:g} in {len(rows)} row(s), read as missing'
    assert said in recording.source
    begin = 1 if rows[0] == 0 else 0
    samples = len(recording.q)
    assert recording.period == pytest.approx(PERIOD)
    times = np.arange(begin, begin + samples) * PERIOD
    there = ~recording.gap[:samples] & (times < times[-1] - 3 * PERIOD)
    wanted = np.sin(np.multiply.outer(times, NUMBERS))
    # over two rows that are missing, the fastest is off by (6 rad/s x 30 ms)^2 / 8
    np.testing.assert_allclose(recording.q[:][there], wanted[there], atol=5e-3)


def test_rows_in_which_torques_are_exactly_zero_for_long_are_missing(tmp_path):
    names = ['t', *numbered('q'), *numbered('tau')]
    for rows, column in (
        (range(40), range(6)),  # before anything was heard of the drives
        (range(150, 200), range(6)),
        (range(40), [1]),
        (range(150, 200), [1]),
        ([100], range(6)),
    ):
        torque = TAU.copy()
        torque[np.ix_(rows, column)] = 0.0
        path = written(tmp_path / 'a.csv', names, (TIME, Q, torque))
        recording = read_recording(path, UR5E_TEXT)
        said = f'torques are exactly 0 in {len(rows)} row(s), read as missing'
        assert said in recording.source
        offset = len(rows) if rows[0] == 0 else 0
        times = np.arange(offset, offset + len(recording.q)) * PERIOD
        there = ~recording.gap & (times < 2.9)
        wanted = 10.0 * np.cos(np.multiply.outer(times, NUMBERS))
        # (6 rad/s x 20 ms)^2 / 8 x 10 N m between two rows
        np.testing.assert_allclose(recording.torque[:][there], wanted[there], atol=0.02)


def test_matrices_of_npz_and_structures_of_mat_are_read(tmp_path):
    np.savez(tmp_path / 'a.npz', t=TIME, q=Q, dq=np.zeros_like(Q), tau=TAU.T)
    is_read(tmp_path / 'a.npz')
    log = {'time_ms': 1e3 * TIME, 'pos': Q, 'torque': TAU}
    savemat(tmp_path / 'a.mat', {'log': log})
    is_read(tmp_path / 'a.mat')


def test_parquet_and_feather_are_read_with_lists_as_their_cells(tmp_path):
    """As data sets of LeRobot have them, beside text."""
    arrow = pytest.importorskip('pyarrow', reason='needs pyarrow')
    columns = {
        'timestamp': TIME,
        'observation.position': arrow.array(Q.tolist(), arrow.list_(arrow.float64())),
        'observation.effort': arrow.array(
            TAU.tolist(), arrow.list_(arrow.float64(), 6)
        ),
        'task': ['wave'] * len(TIME),
    }
    table = arrow.table(columns)
    importlib.import_module('pyarrow.parquet').write_table(
        table, tmp_path / 'a.parquet'
    )
    is_read(tmp_path / 'a.parquet')
    importlib.import_module('pyarrow.feather').write_feather(
        table, tmp_path / 'a.feather'
    )
    is_read(tmp_path / 'a.feather')


@pytest.mark.parametrize(('suffix', 'has_efforts'), [('csv', True), ('parquet', False)])
def test_own_export_is_read_without_a_map(tmp_path, suffix, has_efforts):
    """By its stamps, and by its efforts; without any, by the torques that were applied."""
    if suffix == 'parquet':
        pytest.importorskip('pyarrow', reason='needs pyarrow')
    made = recorded_run.Synthetic(200)
    states = JointStateEncoder(UR5E[:2])
    effort = 2.0 + made.position if has_efforts else 0.0 * made.position
    still = np.zeros_like(effort)
    measured = iter(zip(made.position, still, effort, strict=True))
    messages = [
        (topic, at, states.encode(at, *next(measured)))
        if topic is JOINT_STATES
        else (topic, at, raw)
        for topic, at, raw in made.messages(with_timing=True)
    ]
    names = ['--map', f'shoulder={UR5E[0]}', '--map', f'elbow={UR5E[1]}']
    bag = recorded_run.write_made(tmp_path / 'bag', messages)
    out = tmp_path / f'table.{suffix}'
    assert main(['export', str(bag), '--out', str(out), *names]) == 0
    text = UR5E_TEXT.replace(UR5E[0], 'shoulder').replace(UR5E[1], 'elbow')
    recording = read_recording(out, text)
    assert recording.joints == ('shoulder', 'elbow')
    size = len(recording.q)
    np.testing.assert_allclose(recording.q, made.position[:size], atol=1e-9)
    expected = effort if has_efforts else made.torque
    np.testing.assert_allclose(recording.torque, expected[:size], atol=1e-9)


def test_missing_cells_are_gaps(tmp_path):
    tau = TAU.copy()
    tau[100:150, 3] = np.nan
    np.savez(tmp_path / 'a.npz', t=TIME, q=Q, tau=tau)
    gap = read_recording(tmp_path / 'a.npz', UR5E_TEXT).gap
    assert gap[105:145].all()
    assert not gap[:95].any()


# Files that take the machine.


@pytest.mark.parametrize(
    ('suffix', 'kind'),
    [('csv', 'pipe'), ('csv', 'device'), ('npz', 'device'), ('mat', 'folder')],
)
def test_what_is_no_file_is_refused_at_once(tmp_path, suffix, kind, capsys):
    path = tmp_path / f'a.{suffix}'
    if kind == 'pipe':
        os.mkfifo(path)
    elif kind == 'folder':
        path.mkdir()
    else:
        path.symlink_to('/dev/zero')
    (tmp_path / 'panda.urdf').write_text(PANDA_TEXT)
    words = ['--urdf', str(tmp_path / 'panda.urdf')]
    assert main(['identify', str(path), *words]) == 1
    error = capsys.readouterr().err
    assert 'is not a regular file' in error
    assert error.count('\n') == 1
    assert len(PANDA) == 7


def test_data_sets_of_hdf5_are_read_and_those_of_mat_7_3(tmp_path):
    """As ALOHA has them, in groups; MATLAB writes the rows of a matrix as columns."""
    h5py = pytest.importorskip('h5py', reason='needs h5py')
    with h5py.File(tmp_path / 'a.hdf5', 'w') as file:
        file['time'] = TIME
        file['observations/qpos'] = Q
        file.create_dataset('observations/effort', data=TAU, compression='gzip')
        file['observations/images'] = np.zeros((len(TIME), 4, 4, 3), np.uint8)
    is_read(tmp_path / 'a.hdf5')
    with h5py.File(tmp_path / 'a.mat', 'w', userblock_size=512) as file:
        for name, values in (('t', TIME[:, np.newaxis]), ('q', Q), ('tau', TAU)):
            file[name] = values.T
    head = b'MATLAB 7.3 MAT-file'.ljust(124) + b'\x00\x02IM'
    raw = (tmp_path / 'a.mat').read_bytes()
    (tmp_path / 'a.mat').write_bytes(head + raw[len(head) :])
    is_read(tmp_path / 'a.mat')


def test_arrays_that_unpack_to_gigabytes_are_refused(tmp_path):
    """A third of a gigabyte of zeros, in a third of a megabyte."""
    shape = (7_000_000, 6)
    head = {'descr': '<f8', 'fortran_order': False, 'shape': shape}
    with ZipFile(tmp_path / 'a.npz', 'w', ZIP_DEFLATED) as archive:
        for name in ('q', 'tau'):
            with archive.open(f'{name}.npy', 'w') as stream:
                np.lib.format.write_array_header_1_0(stream, head)
                for _ in range(shape[0] * shape[1] * 8 >> 20):
                    stream.write(bytes(1 << 20))
    zeros = np.zeros(shape, np.uint8)  # numbers in memory have eight bytes
    savemat(tmp_path / 'a.mat', {'q': zeros, 'tau': zeros}, do_compression=True)
    for name in ('a.npz', 'a.mat'):
        assert (tmp_path / name).stat().st_size < 1 << 20
        message = refused(tmp_path / name, 'time=1000Hz')
        assert 'unpacks to 0.34 GB' in message
        assert 'write it as several files' in message


@pytest.mark.parametrize('suffix', ['npz', 'mat', 'h5'])
def test_damaged_arrays_are_refused_in_one_line(tmp_path, suffix):
    """Any of 60 flipped or missing bytes: they are refused, or hit what is not read."""
    path = tmp_path / f'a.{suffix}'
    if suffix == 'npz':
        np.savez_compressed(path, t=TIME, q=Q, tau=TAU)
    elif suffix == 'h5':
        h5py = pytest.importorskip('h5py', reason='needs h5py')
        with h5py.File(path, 'w') as file:
            for name, values in (('t', TIME), ('q', Q), ('tau', TAU)):
                file.create_dataset(name, data=values, fletcher32=True)
    else:
        savemat(path, {'t': TIME, 'q': Q, 'tau': TAU}, do_compression=True)
    whole = path.read_bytes()
    random = np.random.default_rng(0)
    messages = []
    for k in range(60):
        at = int(random.integers(len(whole)))
        raw = bytearray(whole)
        raw[at] ^= 1 << int(random.integers(8))
        path.write_bytes(raw[:at] if k % 3 == 0 else raw)
        try:
            read_recording(path, UR5E_TEXT)
        except BlfDscError as error:
            messages.append(str(error))
    assert len(messages) > 30
    assert '\n' not in ''.join(messages)


def test_a_row_for_each_joint_is_refused(tmp_path):
    """It has one column of positions, and would be an arm of one joint."""
    stamps = np.repeat(TIME, 6)
    path = written(
        tmp_path / 'a.csv', ['t', 'q', 'tau'], (stamps, Q.ravel(), TAU.ravel())
    )
    assert 'is there one for each joint?' in refused(path)
    columns = [np.repeat(values, 2, axis=0) for values in (TIME, Q, TAU)]
    names = ['t', *numbered('q'), *numbered('tau')]
    is_read(written(path, names, columns))  # the same rows twice are no fault
