# SPDX-License-Identifier: Apache-2.0
"""Tables as other tools write them, and as people name their columns."""

from __future__ import annotations

import os
import re
import tracemalloc
import warnings
from io import BytesIO
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pytest
from random_arm import PANDA, PANDA_TEXT, UR5E, UR5E_TEXT
from scipy.io import savemat

from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.bags.sources import next_record
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.bad_values import _apart, _sizes
from blf_dsc_controller.identification.from_table import read_table
from blf_dsc_controller.identification.reading import read_recording

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


def named(field, joints=UR5E, unit=''):
    return [f'{field} {joint}{unit}' for joint in joints]


def written(path, names, columns, delimiter=',', decimal='.', before='', **how):
    """Write a table; a name that is None is that of text cells."""
    table = np.column_stack(columns)
    rows = [[f'{value:.9g}' for value in row] for row in table]
    lines = [delimiter.join(row).replace('.', decimal) for row in rows]
    header = [delimiter.join(names)] if names else []
    path.write_text('\n'.join([*([before] if before else []), *header, *lines]), **how)
    return path


def is_read(path, *entries, time=TIME, urdf=UR5E_TEXT):
    """Whether the motion is read as it is, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        recording = read_table(path, urdf, names=NameMap.parse(entries))
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
        read_table(path, UR5E_TEXT, names=NameMap.parse(entries))
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


def test_seconds_and_nanoseconds_in_two_columns_are_one_time(tmp_path):
    nanoseconds = np.round(TIME * 1e9).astype(int)
    seconds = EPOCH + nanoseconds // 10**9
    for first, second in (
        ('sec', 'nanosec'),
        ('header.stamp.secs', 'header.stamp.nsecs'),
    ):
        path = tmp_path / f'{first}.csv'
        np.savetxt(
            path,
            np.column_stack((seconds, nanoseconds % 10**9, Q, TAU)),
            delimiter=',',
            header=','.join([first, second, *numbered('q'), *numbered('tau')]),
            comments='',
        )
        is_read(path)


def test_nanoseconds_of_two_clocks_are_no_part_of_one_time(tmp_path):
    names = ['sec', 'nanosec', 'received.nanosec', *numbered('q'), *numbered('tau')]
    nanoseconds = np.round(TIME * 1e9)
    path = tmp_path / 'a.csv'
    written(path, names, (0.0 * TIME, nanoseconds, nanoseconds, Q, TAU))
    assert 'which column is the time is not clear' in refused(path)


def test_columns_of_which_more_than_one_may_be_a_position_are_named_alone(tmp_path):
    """As those of a table by `blf_dsc export` of a simulated arm."""
    names = [
        'time',
        *numbered('position'),
        *numbered('truth position'),
        *numbered('x'),
    ]
    path = tmp_path / 'a.csv'
    written(path, names, (TIME, Q, Q, TAU))
    assert re.search(
        'These may be: position_1, .* truth position_6: choose them', refused(path)
    )


# Separators, headers, orders.


@pytest.mark.parametrize('delimiter', [';', '\t'])
@pytest.mark.parametrize('has_header', [True, False])
def test_decimal_commas_are_read(tmp_path, delimiter, has_header):
    names = ['t', *numbered('q'), *numbered('tau')] if has_header else []
    path = written(tmp_path / 'a.csv', names, (TIME, Q, TAU), delimiter, ',')
    is_read(path, *([] if has_header else ['time=0:1', 'q=1:7', 'tau=7:13']))


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


def test_numbered_columns_are_those_of_their_numbers_in_any_order(tmp_path):
    order = [5, 0, 1, 2, 3, 4]
    names = ['t', *(f'q_{k + 1}' for k in order), *(f'tau[{k}]' for k in order)]
    is_read(written(tmp_path / 'a.csv', names, (TIME, Q[:, order], TAU[:, order])))
    # by number of the column, the order is that of the file
    recording = read_table(
        tmp_path / 'a.csv', UR5E_TEXT, names=NameMap.parse(['q=1:7', 'tau=7:13'])
    )
    np.testing.assert_allclose(recording.q[5:6][:, 0], Q[5:6, 5], atol=1e-6)


def test_columns_of_one_name_are_given_by_their_numbers(tmp_path):
    names = ['t', *['q'] * 6, *['tau'] * 6]
    path = written(tmp_path / 'a.csv', names, (TIME, Q, TAU))
    assert '--map q=1:7' in refused(path)
    is_read(path, 'q=1:7', 'tau=7:13')
    # a table of a spreadsheet, with columns that nobody needs
    names = ['t', *numbered('q'), *numbered('tau'), 'note', 'note', '', '']
    is_read(
        written(tmp_path / 'b.csv', names, (TIME, Q, TAU, *[np.zeros(len(TIME))] * 4))
    )


def test_positions_and_torques_of_two_files_are_put_side_by_side(tmp_path):
    """As it is advised; with other times in the second file, they are no rows of one table."""
    first = written(tmp_path / 'q.csv', ['t', *named('position')], (TIME, Q))
    message = refused(first)
    assert 'which columns are tau of shoulder_pan_joint' in message
    assert f'paste -d, {first} OTHER.csv > both.csv' in message
    for late, name in ((0.0, 'a.csv'), (0.004, 'b.csv')):
        columns = TIME + late, TAU
        second = written(tmp_path / 'tau.csv', ['t', *named('effort')], columns)
        both = tmp_path / name
        texts = [path.read_text().splitlines() for path in (first, second)]
        lines = zip(*texts, strict=True)
        both.write_text('\n'.join(','.join(pair) for pair in lines))
        if late:
            assert 'which column is the time is not clear' in refused(both)
        else:
            is_read(both)
    assert f'paste -d, {second} OTHER.csv' in refused(second)


@pytest.mark.parametrize('rate', ['q_dot', 'position_velocity', 'joint_pos_acc'])
def test_rates_of_positions_are_no_positions(tmp_path, rate):
    names = ['t', *numbered('q'), *numbered(rate), *numbered('tau')]
    is_read(written(tmp_path / 'a.csv', names, (TIME, Q, 9.0 * Q, TAU)))


def test_dates_and_lists_in_cells_are_refused_with_what_is_read(tmp_path):
    for cell in ('2024-05-01 12:00:00.01,1.0', '"[1.0, 2.0]","[1.0, 2.0]"'):
        path = tmp_path / 'a.csv'
        path.write_text('\n'.join(['time,q', *[cell] * 9]))
        assert 'dates and lists in cells are not read' in refused(path)


def test_text_of_spreadsheets_is_read_in_any_encoding(tmp_path):
    names = ['t', *(f'{name} [°]' for name in numbered('q')), *numbered('tau')]
    for encoding in ('utf-8-sig', 'utf-16', 'cp1252'):
        path = tmp_path / f'{encoding}.csv'
        written(path, names, (TIME, np.rad2deg(Q), TAU), encoding=encoding)
        is_read(path)


def test_table_that_was_cut_off_and_one_with_empty_cells_are_read(tmp_path):
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (TIME, Q, TAU))
    path.write_text(path.read_text()[:-20])
    is_read(path, time=TIME[:-1])
    lines = path.read_text().splitlines()
    lines[50] = lines[50].replace(lines[50].split(',')[3], '')
    path.write_text('\n'.join(lines))
    assert not read_table(path, UR5E_TEXT).gap[:5].any()
    lines[60] = ','.join(lines[60].split(',')[:4])
    path.write_text('\n'.join(lines))
    assert 'line 61: got 4 cells' in refused(path)


@pytest.mark.parametrize('delimiter', [' ', ','])
def test_row_with_a_cell_too_many_is_refused(tmp_path, delimiter):
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.txt', names, (TIME, Q, TAU), delimiter)
    lines = path.read_text().splitlines()
    lines[60] = lines[60].replace(delimiter, f'{delimiter}7{delimiter}', 1)
    path.write_text('\n'.join(lines))
    assert 'line 61: got 14 cells, but the first lines have 13' in refused(path)


# Units.


@pytest.mark.parametrize(
    ('time', 'q', 'tau'),
    [
        ('t [s]', ' [rad]', ' [N m]'),
        ('t [ms]', ' [deg]', ' [Nmm]'),
        ('time (us)', '_deg', '_mNm'),
        ('stamp_ns', ' (degrees)', ' [N·m]'),
        ('time', ' [mrad]', ' {kN m}'),
        ('time_ms', ' [rev]', ' [N cm]'),
    ],
)
def test_units_in_the_names_are_used(tmp_path, time, q, tau):
    of_time = {'ms': 1e3, 'us': 1e6, 'ns': 1e9}
    of_q = {'deg': 180 / np.pi, 'degrees': 180 / np.pi, 'mrad': 1e3, 'rev': 0.5 / np.pi}
    of_tau = {'Nmm': 1e3, 'mNm': 1e3, 'kN m': 1e-3, 'N cm': 1e2}
    factors = (
        next(
            (
                f
                for unit, f in units.items()
                if unit in name.replace('_', ' ').split(' ', 1)[-1]
            ),
            1,
        )
        for units, name in ((of_time, time), (of_q, q), (of_tau, tau))
    )
    columns = [values * f for values, f in zip((TIME, Q, TAU), factors, strict=True)]
    for names in (
        [time, *numbered('q', q), *numbered('tau', tau)],
        [time, *named('position', unit=q), *named('effort', unit=tau)],
    ):
        is_read(written(tmp_path / 'a.csv', names, columns))


def test_units_of_matrices_are_used_and_may_be_given(tmp_path):
    np.savez(tmp_path / 'a.npz', t_ms=1e3 * TIME, q_deg=np.rad2deg(Q), tau=TAU)
    is_read(tmp_path / 'a.npz')
    savemat(
        tmp_path / 'a.mat', {'log': {'t': TIME, 'q_deg': np.rad2deg(Q), 'tau': TAU}}
    )
    is_read(tmp_path / 'a.mat')
    np.savez(tmp_path / 'b.npz', t=1e9 * TIME, q=np.rad2deg(Q), tau=1e3 * TAU)
    is_read(tmp_path / 'b.npz', 'time=t[ns]', 'q=q_*[deg]', 'tau=tau_*[Nmm]')
    assert "--map 'time=t[ns]'" in refused(tmp_path / 'b.npz')


def test_stamps_of_this_century_need_no_unit(tmp_path):
    for factor in (1e3, 1e6, 1e9):
        stamp = (EPOCH + TIME) * factor
        np.savez(tmp_path / 'a.npz', time=stamp, q=Q, tau=TAU)
        is_read(tmp_path / 'a.npz')


@pytest.mark.parametrize('unit', ['counts', 'lbf in', 'rad/s'])
def test_unknown_units_are_refused_with_those_that_are_known(tmp_path, unit):
    names = ['t', *numbered('q', f' [{unit}]'), *numbered('tau')]
    message = refused(written(tmp_path / 'a.csv', names, (TIME, Q, TAU)))
    assert f"the unit '{unit}' of q is not known; expected rad" in message


@pytest.mark.parametrize('unit', [' [%]', ' [A]', '_mA'])
def test_percentages_and_currents_need_gains(tmp_path, unit):
    names = ['t', *numbered('q'), *numbered('tau', unit)]
    path = written(tmp_path / 'a.csv', names, (TIME, Q, TAU))
    recording = read_table(path, UR5E_TEXT)
    assert recording.currents
    factor = 1e-3 if unit == '_mA' else 1.0
    np.testing.assert_allclose(recording.torque[:9], factor * TAU[:9], atol=1e-5)


@pytest.mark.parametrize(
    ('names', 'pattern'),
    [
        (numbered('q'), 'q_*'),
        (named('position'), 'position *'),
        ([f'{joint} position' for joint in UR5E], '*_joint position'),
        (
            ['pan pos', 'lift pos', 'elbow pos', 'wrist pos 1', 'pos 2', 'a pos 3'],
            '1:7',
        ),
    ],
)
def test_degrees_without_a_unit_are_refused_with_what_to_type(tmp_path, names, pattern):
    """180 deg of a joint that turns by 360 deg are 29 times a turn in rad."""
    degrees = 180.0 * Q
    path = written(
        tmp_path / 'a.csv', ['t', *names, *numbered('tau')], (TIME, degrees, TAU)
    )
    message = refused(path)
    assert f"If it is in degrees: --map 'q={pattern}[deg]'" in message
    assert f'{names[0]!r} goes to 180 rad, but shoulder_pan_joint turns by' in message
    recording = read_table(path, UR5E_TEXT, names=NameMap.parse([f'q={pattern}[deg]']))
    np.testing.assert_allclose(recording.q[:290], np.pi * Q[:290], atol=1e-6)
    kept = read_table(path, UR5E_TEXT, names=NameMap.parse([f'q={pattern}[rad]']))
    np.testing.assert_allclose(kept.q[:290][:, 0], degrees[:290, 0], atol=1e-6)


@pytest.mark.parametrize('kind', ['revolute', 'continuous'])
def test_degrees_of_small_or_endless_turns_are_told_by_their_speed(tmp_path, kind):
    """A motion of 9 degrees stays within two turns if it is read in rad."""
    text = UR5E_TEXT.replace('type="revolute"', f'type="{kind}"')
    q = (0.16 if kind == 'revolute' else 1.6) * Q  # rad
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (TIME, np.degrees(q), TAU))
    with pytest.raises(BlfDscError, match='so it is with most joints') as error:
        read_table(path, text)
    assert "If it is in degrees: --map 'q=q_*[deg]'" in str(error.value)
    recording = read_table(path, text, names=NameMap.parse(['q=q_*[deg]']))
    np.testing.assert_allclose(recording.q[:290], q[:290], atol=1e-6)
    kept = read_table(path, text, names=NameMap.parse(['q=q_*[rad]']))
    # the slowest one: others seem to wrap
    np.testing.assert_allclose(kept.q[:290][:, 0], np.degrees(q[:290, 0]), atol=1e-6)


@pytest.mark.parametrize('speed', [0.05, 1.0, 2.0])
def test_speeds_that_arms_have_are_in_rad(tmp_path, speed):
    """Up to 12 rad/s, of joints that reach 3.14, and wrap to one turn."""
    turning = np.sin(np.multiply.outer(speed * TIME, NUMBERS)) + 3.0
    wrapped = np.angle(np.exp(1j * turning))
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (TIME, wrapped, TAU))
    recording = read_table(path, UR5E_TEXT)
    np.testing.assert_allclose(recording.q[:290], turning[:290], atol=1e-5)


def test_torques_that_are_the_positions_are_refused(tmp_path):
    """Whatever their columns are called."""
    path = written(tmp_path / 'a.csv', ['t', *'abcdefghijkl'], (TIME, Q, Q))
    message = refused(path, 'q=1:7', 'tau=7:13')
    assert "'g' is 'a' in all rows, so it is no torque" in message


def test_joint_without_limits_may_turn_as_often_as_it_does(tmp_path):
    text = UR5E_TEXT.replace('type="revolute"', 'type="continuous"')
    turned = Q + 4.5 * TIME[:, None]  # beyond two turns, at speeds that such arms have
    assert turned.max() > 4.0 * np.pi
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (TIME, turned, TAU))
    recording = read_table(path, text)
    np.testing.assert_allclose(recording.q[:290], turned[:290], atol=1e-6)


@pytest.mark.parametrize(
    ('entries', 'message'),
    [
        (
            ['tau=q_*'],
            "'q_1' was chosen as tau, but is q: choose others, as in --map 'tau=tau_*'",
        ),
        (['tau=1:7'], "as in --map 'tau=tau_*'"),
        (
            ['q=tau_*'],
            "'tau_1' was chosen as q, but is tau: choose others, as in --map 'q=q_*'",
        ),
        (['q=tau_*', 'tau=q_*'], "as in --map 'q=q_*'"),
        (['q=7:13', 'tau=1:7'], "as in --map 'q=q_*'"),
    ],
)
def test_positions_chosen_as_torques_are_refused_and_vice_versa(
    tmp_path, entries, message
):
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (TIME, Q, TAU))
    assert message in refused(path, *entries)


def test_columns_whose_names_say_nothing_else_may_be_chosen_as_anything(tmp_path):
    """Q is the torque of a textbook, theta the position."""
    names = ['t', *numbered('theta'), *numbered('Q')]
    path = written(tmp_path / 'a.csv', names, (TIME, Q, TAU))
    is_read(path, 'q=theta_*', 'tau=Q_*')


def test_words_in_brackets_that_are_no_units_belong_to_the_name(tmp_path):
    names = ['t', *numbered('q', ' (measured)'), *numbered('tau', ' (filtered)')]
    is_read(written(tmp_path / 'a.csv', names, (TIME, Q, TAU)))


# Time.


def test_two_runs_in_one_table_are_two_runs(tmp_path):
    """With the clock starting again, and also with the rows of another file in between."""
    names = ['t', *numbered('q'), *numbered('tau')]
    columns = [np.concatenate((values, values)) for values in (TIME, Q, TAU)]
    path = written(tmp_path / 'a.csv', names, columns)
    recording = read_table(path, UR5E_TEXT)
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
    assert 'read as 2 runs' in read_table(path, UR5E_TEXT).source


def test_rows_that_are_hardly_out_of_order_are_sorted(tmp_path):
    order = np.arange(len(TIME))
    order[[50, 51]] = order[[51, 50]]
    names = ['t', *numbered('q'), *numbered('tau')]
    is_read(written(tmp_path / 'a.csv', names, [v[order] for v in (TIME, Q, TAU)]))


def test_time_that_starts_again_all_the_time_is_refused(tmp_path):
    time = PERIOD * (np.arange(2500) % 20)
    values = np.zeros((2500, 6))
    path = tmp_path / 'a.npz'
    np.savez(path, t=time, q=values, tau=values)
    assert 'falls back 124 times' in refused(path)


def test_fifty_hertz_with_jitter_are_enough(tmp_path):
    random = np.random.default_rng(0)
    time = np.arange(300) * 0.0203 + random.uniform(0.0, 0.004, 300)
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (time, Q, TAU))
    assert read_table(path, UR5E_TEXT).period == pytest.approx(0.0203, rel=0.02)
    path = written(tmp_path / 'a.csv', names, (2.0 * time, Q, TAU))
    assert 'at least one in 0.02 s' in refused(path)


def test_wrapped_positions_are_unwrapped_and_said(tmp_path):
    turning = 3.0 * TIME[:, None] + np.zeros(6)
    wrapped = turning.copy()
    wrapped[:, 5] = np.angle(np.exp(1j * turning[:, 5]))
    names = ['t', *numbered('q'), *numbered('tau')]
    recording = read_table(
        written(tmp_path / 'a.csv', names, (TIME, wrapped, TAU)), UR5E_TEXT
    )
    np.testing.assert_allclose(recording.q[:280], turning[:280], atol=1e-6)
    assert 'positions of wrist_3_joint are wrapped' in recording.source


# Numbers that are none.


@pytest.mark.parametrize('stand_in', [-999.0, 1e10, 1.7e308])
@pytest.mark.parametrize('column', [0, 3, 9])
@pytest.mark.parametrize('rows', [[70], [0, 70, 71, 150], range(100, 299)])
def test_stand_ins_for_missing_values_are_missing_and_said(
    tmp_path, stand_in, column, rows
):
    """Of a time, a position and a torque; one, some, or two thirds of the rows."""
    table = np.column_stack((TIME, Q, TAU))
    table[rows, column] = stand_in
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, [table])
    recording = read_table(path, UR5E_TEXT)
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


def test_several_stand_ins_in_several_columns_are_missing(tmp_path):
    table = np.column_stack((TIME, Q, TAU))
    table[40:45, 2], table[60, 2], table[60, 8] = -9999.0, 1e10, -9999.0
    path = written(tmp_path / 'a.csv', ['t', *numbered('q'), *numbered('tau')], [table])
    source = read_table(path, UR5E_TEXT).source
    for said in ("'q_2' is 1e+10 in 1", "'q_2' is -9999 in 5", "'tau_2' is -9999 in 1"):
        assert said in source


def test_hits_pauses_and_coarse_clocks_are_no_stand_ins(tmp_path):
    names = ['t', *numbered('q'), *numbered('tau', ' [Nmm]')]
    heavy = 1e4 * TAU
    heavy[:, 5] *= 1e-3
    heavy[50, 5] = 900.0  # N mm, a hit on a wrist that has 100 otherwise
    path = written(tmp_path / 'a.csv', names, (TIME, Q, heavy))
    recording = read_table(path, UR5E_TEXT)
    assert 'missing' not in recording.source
    assert recording.torque[50:51][0, 5] == pytest.approx(0.9)
    # ms, with a pause of 100 s after a third
    time = 1e3 * TIME + 1e5 * (TIME > 1.0)
    path = written(path, ['t_ms', *names[1:]], (time, Q, TAU))
    recording = read_table(path, UR5E_TEXT)
    assert 'missing' not in recording.source
    assert recording.duration == pytest.approx(100.0 + TIME[-1], abs=0.03)


@pytest.mark.parametrize('value', [0.0, -9999.0])
def test_torques_that_are_the_same_in_all_rows_are_refused(tmp_path, value):
    names = ['t', *numbered('q'), *numbered('tau')]
    some = TAU.copy()
    some[:, [3, 5]] = value
    path = written(tmp_path / 'a.csv', names, (TIME, Q, some))
    message = refused(path)
    assert f"'tau_4', 'tau_6': {value:g} in all rows" in message
    assert 'wrist_1_joint, wrist_3_joint was not recorded' in message
    assert 'as in --map tau=effort_*' in message
    path = written(path, names, (TIME, Q, np.full_like(TAU, value)))
    assert message.split(':')[0] in refused(path)
    assert 'in all rows' in refused(path)


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
        recording = read_table(path, UR5E_TEXT)
        said = f'torques are exactly 0 in {len(rows)} row(s), read as missing'
        assert said in recording.source
        offset = len(rows) if rows[0] == 0 else 0
        times = np.arange(offset, offset + len(recording.q)) * PERIOD
        there = ~recording.gap & (times < 2.9)
        wanted = 10.0 * np.cos(np.multiply.outer(times, NUMBERS))
        # (6 rad/s x 20 ms)^2 / 8 x 10 N m between two rows
        np.testing.assert_allclose(recording.torque[:][there], wanted[there], atol=0.02)


def test_first_state_may_be_before_any_torque(tmp_path):
    names = ['t', *numbered('q'), *numbered('tau')]
    torque = TAU.copy()
    torque[0] = 0.0
    path = written(tmp_path / 'a.csv', names, (TIME, Q, torque))
    recording = read_table(path, UR5E_TEXT)
    assert 'missing' not in recording.source
    np.testing.assert_allclose(recording.torque[:290], torque[:290], atol=1e-6)


def test_torques_in_steps_of_which_some_are_zero_are_kept(tmp_path):
    """A coarse current sensor, at an eighth of the range."""
    torque = 2.5 * np.round(TAU / 2.5)
    torque[:, 0] = np.where(np.abs(TAU[:, 0]) < 5.0, 0.0, torque[:, 0])
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (TIME, Q, torque))
    recording = read_table(path, UR5E_TEXT)
    assert 'missing' not in recording.source
    np.testing.assert_allclose(recording.torque[:290], torque[:290], atol=1e-6)


def test_column_without_numbers_is_named(tmp_path):
    names = ['t', *numbered('q'), *numbered('tau')]
    torque = TAU.copy()
    torque[:, 5] = np.nan
    path = written(tmp_path / 'a.csv', names, (TIME, Q, torque))
    assert "'tau_6' has no numbers" in refused(path)


# Files that take the machine.


@pytest.mark.parametrize('suffix', ['csv', 'npz', 'mat'])
@pytest.mark.parametrize('kind', ['pipe', 'device', 'folder'])
def test_what_is_no_file_is_refused_at_once(tmp_path, suffix, kind, capsys):
    path = tmp_path / f'a.{suffix}'
    if kind == 'pipe':
        os.mkfifo(path)
    elif kind == 'folder':
        path.mkdir()
    else:
        path.symlink_to('/dev/zero')
    (tmp_path / 'panda.urdf').write_text(PANDA_TEXT)
    words = ['--urdf', str(tmp_path / 'panda.urdf'), '--foresee']
    assert main(['identify', str(path), *words]) == 1
    error = capsys.readouterr().err
    assert 'is not a regular file' in error
    assert error.count('\n') == 1
    assert len(PANDA) == 7


def test_memory_for_a_long_table_is_a_few_times_its_numbers(tmp_path):
    """An honest CSV with an empty cell: all rows as lists would be three times as much."""
    names = ['t', *numbered('q'), *numbered('dq'), *numbered('tau')]
    repeats = 100  # 30,000 rows, 6 MB
    time = np.arange(repeats * TIME.size) * PERIOD
    q, tau = (np.tile(values, (repeats, 1)) for values in (Q, TAU))
    path = written(tmp_path / 'a.csv', names, (time, q, q, tau))
    head, last = path.read_text().rsplit(',', 1)
    path.write_text(f'{head},\n{head.rsplit(chr(10), 1)[1]},{last}')  # an empty cell
    numbers = 8 * time.size * (1 + q.shape[1] + tau.shape[1])  # bytes
    tracemalloc.start()
    read_table(path, UR5E_TEXT)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # as they stand in the file, in rad and N m, and masks; and a block of lines
    assert peak < 3.5 * numbers + 5_000_000


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


@pytest.mark.parametrize('suffix', ['npz', 'mat'])
def test_damaged_arrays_are_refused_in_one_line(tmp_path, suffix):
    """Any of 60 flipped or missing bytes: they are refused, or hit what is not read."""
    path = tmp_path / f'a.{suffix}'
    if suffix == 'npz':
        np.savez_compressed(path, t=TIME, q=Q, tau=TAU)
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
            read_table(path, UR5E_TEXT)
        except BlfDscError as error:
            messages.append(str(error))
    assert len(messages) > 30
    assert '\n' not in ''.join(messages)


@pytest.mark.parametrize('number', ['1.234,5', '1,234.5', '1 234,5', '-12.345.678,9'])
@pytest.mark.parametrize('row', [0, 150])
def test_separators_of_thousands_are_refused_and_not_taken_for_gaps(
    tmp_path, number, row
):
    path = written(
        tmp_path / 'a.csv', ['t', *numbered('q'), *numbered('tau')], (TIME, Q, TAU), ';'
    )
    lines = path.read_text().splitlines()
    cells = lines[1 + row].split(';')
    lines[1 + row] = ';'.join([*cells[:-1], number])
    path.write_text('\n'.join(lines))
    assert f'line {2 + row}: {number!r} has a separator of thousands' in refused(path)


@pytest.mark.parametrize('which', ['names', 'numbers', 'both'])
def test_separators_at_the_ends_of_lines_are_no_columns(tmp_path, which):
    path = written(
        tmp_path / 'a.csv', ['t', *numbered('q'), *numbered('tau')], (TIME, Q, TAU)
    )
    names, *rows = path.read_text().splitlines()
    ends = [',' if which != 'numbers' else '', ',' if which != 'names' else '']
    path.write_text('\n'.join([names + ends[0], *(row + ends[1] for row in rows)]))
    is_read(path)


def test_time_in_minutes_is_not_read_as_seconds(tmp_path):
    names = ['time [min]', *numbered('q'), *numbered('tau')]
    is_read(written(tmp_path / 'a.csv', names, (TIME / 60.0, Q, TAU)))


def test_minus_of_typesetting_is_no_gap(tmp_path):
    path = tmp_path / 'a.csv'
    names = ['t', *numbered('q'), *numbered('tau')]
    written(path, names, (TIME, Q, TAU))
    path.write_text(path.read_text().replace('-', '\u2212'), encoding='utf-8')
    is_read(path)


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


@pytest.mark.parametrize('rate', ['0Hz', '1.2.3Hz'])
def test_rate_that_is_none_is_refused(tmp_path, rate):
    names = ['t', *numbered('q'), *numbered('tau')]
    path = written(tmp_path / 'a.csv', names, (TIME, Q, TAU))
    assert 'time' in refused(path, f'time={rate}')


@pytest.mark.parametrize(
    ('name', 'content', 'words'),
    [
        ('a.csv', b'\x1f\x8b\x08 packed', 'is gzip, not text: unpack it'),
        ('a.csv', b'PK\x03\x04 packed', 'is a zip archive or a spreadsheet'),
        ('a.csv.gz', b'\x1f\x8b\x08 packed', 'got .gz, but bags and tables end with'),
        ('a.npy', b'\x93NUMPY', 'got .npy, but bags and tables end with'),
        ('folder/a.csv', b't\n1\n', 'is a folder of tables: give the files, as'),
    ],
)
def test_files_of_another_kind_are_refused_by_what_they_are(
    tmp_path, name, content, words
):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    given = path.parent if path.parent != tmp_path else path
    with pytest.raises(BlfDscError, match=re.escape(words)):
        read_recording(given, UR5E_TEXT)


def test_name_that_no_file_can_have_is_refused(tmp_path):
    assert 'File name too long' in refused(tmp_path / ('a' * 300 + '.csv'))


def test_hole_in_a_bag_is_no_record():
    """Nine zeros would be a record without content: two gigabytes are read for hours."""
    with pytest.raises(ValueError, match='zeros instead of a record'):
        next_record(BytesIO(bytes(100)), 100, {})


def test_sizes_of_torques_are_those_of_both_signs_but_for_zero():
    torque = np.array([[0.0, -3.0], [-2.0, 0.0], [1.0, -5.0]])
    least, most = _sizes(torque, 3)
    assert (least.tolist(), most.tolist()) == ([1.0, 3.0], [2.0, 5.0])


@pytest.mark.parametrize('centre', [0.0, 2000.0, -2000.0])
def test_value_far_from_all_others_is_found_wherever_they_are(centre):
    """Nothing, for instance, among encoder counts."""
    others = centre + np.array([1.0, -1.0, 0.5, 0.0])
    found = _apart(np.append(others, centre - 1500.0))
    assert found.value == centre - 1500.0
    assert found.distance == pytest.approx(1500.0, abs=1.0)
