# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc doctor` says what is there, and what to do about what is not."""

from __future__ import annotations

import importlib.util
import re

import pytest

from blf_dsc_controller.cli import computer
from blf_dsc_controller.cli.main import main

PING = """#!/bin/sh
echo "200 packets transmitted, 200 received, 0% packet loss, time 1990ms"
echo "rtt min/avg/max/mdev = 0.080/{mean}/0.900/0.050 ms"
"""

SILENT = """#!/bin/sh
echo "200 packets transmitted, 0 received, 100% packet loss"
exit 1
"""


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(computer, '_SAMPLES', 10)


def diagnosed(capsys, *words):
    """Return the exit code, and the lines by subject, each as (level, text)."""
    code = main(['doctor', *words])
    found = {}
    for line in capsys.readouterr().out.partition('\n\n')[0].splitlines():
        level, subject, text = line[:8].strip(), line[8:20].strip(), line[20:]
        if level:
            last = found.setdefault(subject, [])
            last.append([level, text])
        else:
            last[-1][1] += f' {text}'
    return code, found


def test_everything_that_can_matter_is_named(capsys):
    code, found = diagnosed(capsys)
    assert code == 0
    assert {'package', 'needs', 'kernels', 'ROS 2', 'kernel', 'clock', 'disk'} <= set(
        found
    )
    assert 'numba' in found['needs'][0][1]


def test_configuration_says_what_the_controller_would_say(capsys):
    _, found = diagnosed(capsys, '--config', 'fr3_direct')
    first, *others = found['config']
    assert first == ['ok', '7 joints at 1000 Hz, law blf_dsc']
    assert any('nobody has measured' in text for _, text in others)


@pytest.mark.parametrize(
    ('given', 'source'),
    [
        ('', 'assumed, for gears of any stiffness; .* drive 0.375 kg m.2, assumed'),
        (
            'joint_stiffness: [3.0e+4, 3.0e+4, 3.0e+4, 2.0e+4, 2.0e+4, 2.0e+4]',
            'derived',
        ),
        ('rotor_inertia: [0.4, 0.4, 0.4, 0.1, 0.1, 0.1]', 'drive 0.4 kg m.2, given'),
        ('ur5e', '900 N m/rad and 60 N m s/rad, given; integral'),
        ('ur5e_commissioned', '714 N m/rad and .* N m s/rad, measured; integral'),
    ],
)
def test_gains_of_each_joint_are_shown_with_where_they_come_from(
    capsys, tmp_path, given, source
):
    path = given
    if not given.startswith('ur5e'):
        path = tmp_path / 'my.yaml'
        robot = ', '.join(filter(None, ('urdf: ur5e.urdf', 'tip: tool0', given)))
        path.write_text(f'/**: {{ros__parameters: {{robot: {{{robot}}}}}}}')
    _, found = diagnosed(capsys, '--config', str(path))
    assert len(found['gains']) == 6
    level, text = found['gains'][0]
    assert level == 'ok'
    assert re.match(f'shoulder_pan_joint: .*{source}', text)


def test_configuration_with_a_mistake_is_a_problem(capsys, tmp_path):
    path = tmp_path / 'my.yaml'
    path.write_text('/**:\n  ros__parameters:\n    sample_tme: 0.001\n')
    code, found = diagnosed(capsys, '--config', str(path))
    assert code == 1
    assert found['config'][0][0] == 'PROBLEM'
    assert 'sample_tme' in found['config'][0][1]


def test_computer_without_ros_is_no_problem(capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        'importlib.util.find_spec',
        lambda name, *rest: None if name == 'rclpy' else find(name, *rest),
    )
    code, found = diagnosed(capsys)
    assert code == 0
    level, text = found['ROS 2'][0]
    assert level == 'note'
    assert 'source /opt/ros/jazzy/setup.bash' in text


@pytest.fixture
def ping(monkeypatch, tmp_path):
    """Return a function that lets `ping` answer with a script."""

    def answer(script):
        ping = tmp_path / 'ping'
        ping.write_text(script)
        ping.chmod(0o755)
        monkeypatch.setenv('PATH', str(tmp_path), prepend=':')

    return answer


@pytest.mark.parametrize(
    ('mean', 'level'), [('0.150', 'ok'), ('0.700', 'note')], ids=['cable', 'switch']
)
def test_robot_is_asked_how_fast_it_answers(capsys, ping, mean, level):
    ping(PING.format(mean=mean))
    code, found = diagnosed(capsys, '--robot', '172.16.0.2')
    assert code == 0
    assert found['robot'][0][0] == level
    assert 'at worst 0.90 ms of 200' in found['robot'][0][1]


@pytest.mark.parametrize(
    ('address', 'code', 'said'),
    [
        ('172.16.0.2', 1, ['PROBLEM', '172.16.0.2 does not answer']),
        ('simulated', 0, ['ok', 'simulated is not in the network']),
        ('can0', 0, ['ok', 'can0 is not in the network']),
    ],
)
def test_only_robots_in_a_network_must_answer(capsys, ping, address, code, said):
    ping(SILENT)
    ended, found = diagnosed(capsys, '--robot', address)
    ((level, text),) = found['robot']
    assert (ended, level) == (code, said[0])
    assert text.startswith(said[1])
