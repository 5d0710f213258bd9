# SPDX-License-Identifier: Apache-2.0
"""One motion as many tools and people write it: each is read without any option."""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import UR5E
from test_identify_foreign_tables import EPOCH, TAU, TIME, Q, is_read, written

ZERO = np.zeros_like(Q)
WHOLE_SECONDS = np.floor(EPOCH + TIME)
NANOSECONDS = 1e9 * (EPOCH + TIME - WHOLE_SECONDS)


def listed(form, first=1):
    """Names of six columns, by number, or of the joints."""
    if '{name}' in form:
        return [form.format(name=name) for name in UR5E]
    return [form.format(k) for k in range(first, first + 6)]


def table(time, q, tau, others=(), *, first=1, values=(TIME, Q, TAU)):
    """Names and columns; velocities and others, which are not to be read, are between."""
    names = [time, *listed(q, first)]
    columns = [values[0], values[1]]
    for other in others:
        names += listed(other, first)
        columns.append(7.0 + ZERO)
    return [*names, *listed(tau, first)], [*columns, values[2]]


DEGREES = (TIME, np.rad2deg(Q), TAU)

TABLES = {
    'numbers': table('t', 'q{}', 'tau{}', ['qd{}']),
    'numbers from 0': table('t', 'q_{}', 'tau_{}', ['dq_{}'], first=0),
    'capitals': table('TIME', 'Q{}', 'TAU{}', ['DQ{}']),
    'words': table('time', 'position_{}', 'torque_{}', ['velocity_{}']),
    'camel case': table('Time', 'JointPosition{}', 'JointTorque{}'),
    'joints first': table('t', '{name}_position', '{name}_effort', ['{name}_velocity']),
    'joints last': table('t', 'q_{name}', 'tau_{name}', ['dq_{name}']),
    'brackets': table('time', 'q[{}]', 'tau_J[{}]', ['dq[{}]', 'tau_J_d[{}]'], first=0),
    'PlotJuggler': table(
        '__time',
        '/joint_states/{name}/position',
        '/joint_states/{name}/effort',
        ['/joint_states/{name}/velocity'],
        values=(EPOCH + TIME, Q, TAU),
    ),
    'PlotJuggler, numbers': table(
        '__time',
        '/joint_states/position[{}]',
        '/joint_states/effort[{}]',
        ['/joint_states/velocity[{}]'],
        first=0,
    ),
    'bagpy': table('Time', 'position_{}', 'effort_{}', ['velocity_{}'], first=0),
    'actual and target': table(
        'timestamp', 'actual_q_{}', 'actual_torque_{}', ['target_q_{}', 'actual_qd_{}']
    ),
    'measured and commanded': table(
        't', 'q_meas_{}', 'tau_meas_{}', ['q_cmd_{}', 'tau_cmd_{}']
    ),
    'desired': table('t', 'q_{}', 'tau_{}', ['q_des_{}', 'tau_des_{}', 'tau_ext_{}']),
    'degrees': table('t [s]', 'q{} [deg]', 'tau{} [Nm]', values=DEGREES),
    'degrees before the number': table('t', 'q_deg_{}', 'tau_Nm_{}', values=DEGREES),
    'milliseconds': table('t_ms', 'q{}', 'tau{}', values=(1e3 * TIME, Q, TAU)),
    'microseconds': table(
        'timestamp_us', 'q{}', 'tau{}', values=(1e6 * (EPOCH + TIME), Q, TAU)
    ),
    'revolutions and N cm': table(
        'time (us)',
        'q{} [rev]',
        'tau{} [N cm]',
        values=(1e6 * TIME, 0.5 / np.pi * Q, 1e2 * TAU),
    ),
    'mrad and kN m': table(
        'time', 'q{} [mrad]', 'tau{} {{kN m}}', values=(TIME, 1e3 * Q, 1e-3 * TAU)
    ),
    'N mm': table('t', 'pos {}', 'trq {} [Nmm]', values=(TIME, Q, 1e3 * TAU)),
    'an index of pandas': (
        ['', *table('t', 'q_{}', 'tau_{}')[0]],
        [np.arange(TIME.size), TIME, Q, TAU],
    ),
    'a header of ROS': (
        [
            'header.seq',
            'header.stamp.secs',
            'header.stamp.nsecs',
            *table('', 'position_{}', 'effort_{}')[0][1:],
        ],
        [np.arange(TIME.size), WHOLE_SECONDS, NANOSECONDS, Q, TAU],
    ),
    'a stamp of ROS 2': (
        ['stamp.sec', 'stamp.nanosec', *table('', 'q_{}', 'tau_{}')[0][1:]],
        [WHOLE_SECONDS, NANOSECONDS, Q, TAU],
    ),
}


@pytest.mark.parametrize('form', TABLES)
def test_tables_of_people_are_read_as_they_are(tmp_path, form):
    is_read(written(tmp_path / 'a.csv', *TABLES[form]))


@pytest.mark.parametrize(
    'how',
    [
        {'delimiter': ';', 'decimal': ','},
        {'delimiter': '\t'},
        {'delimiter': ' '},
        {'newline': '\r\n', 'encoding': 'utf-8-sig'},
        {'encoding': 'utf-16'},
    ],
    ids=str,
)
def test_files_of_people_are_read_however_they_are_separated(tmp_path, how):
    is_read(written(tmp_path / 'a.csv', *TABLES['numbers from 0'], **how))


def test_names_in_quotes_are_read(tmp_path):
    names, columns = TABLES['numbers from 0']
    is_read(written(tmp_path / 'a.csv', [f'"{name}"' for name in names], columns))
