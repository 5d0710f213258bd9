# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc replay` as a user runs it, without ROS."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import recorded_run

from blf_dsc_controller.cli.bags import DIFFERENT, PARTIAL
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import JointStateDecoder, JointStateEncoder
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATES

JOINTS = ('joint1', 'joint2')

WITHOUT_ROS = """
import sys
sys.modules['rclpy'] = None  # any import of it fails
from blf_dsc_controller.cli.main import main
sys.exit(main(['replay', *sys.argv[1:]]))
"""


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('recorded') / 'bag', 0.3)


def test_identical_replay_exits_with_zero_and_a_verdict(bag):
    command = [sys.executable, '-c', WITHOUT_ROS, str(bag)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert '/blf_dsc_controller/commands: 602 values bit-equal' in run.stdout
    assert 'x real time' in run.stdout


def test_difference_sets_the_exit_code_and_the_last_line(bag, tmp_path, capsys):
    entries = recorded_run.messages(bag)
    second = [entry for entry in entries if entry[0] == COMMANDS.resolved][1]
    second[3] = second[3][:-1] + bytes([second[3][-1] ^ 0x80])  # the sign
    path = recorded_run.write(tmp_path / 'bag', entries)
    assert main(['replay', str(path)]) == DIFFERENT
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith('DIFFERENT, first at 0.001000 s (stamp 1001000000 ns), /blf_dsc_c')
    assert 'effort of joint2: recorded ' in last


@pytest.mark.parametrize('topic', [JOINT_STATES, COMMANDS])
def test_partial_comparison_has_a_verdict_of_its_own(bag, tmp_path, capsys, topic):
    """A lost state ends the replay after a third; a lost command leaves the others to compare."""
    entries = recorded_run.messages(bag)
    lost = recorded_run.of(entries, topic)[100]
    kept = [entry for entry in entries if entry is not lost]
    path = recorded_run.write(tmp_path / 'bag', kept)
    assert main(['replay', str(path)]) == PARTIAL
    last = capsys.readouterr().out.splitlines()[-1]
    percent = float(last.removeprefix('PARTLY COMPARED: ').split()[0])
    # Two of the 24 numbers of a sample are commands.
    assert percent == pytest.approx(33.2 if topic is JOINT_STATES else 91.4, abs=1.5)


def test_replay_with_another_configuration_is_reported_as_open_loop(bag, capsys):
    assert main(['replay', str(bag), '--config', 'recommended']) == 0
    output = capsys.readouterr().out
    assert 'OPEN LOOP' in output
    assert 'joint2: torque differs from the recorded one by rms' in output


def test_states_that_are_not_finite_are_left_out_of_an_open_loop(bag, tmp_path, capsys):
    decoder, encoder = (codec(JOINTS) for codec in (JointStateDecoder, JointStateEncoder))
    entries = recorded_run.messages(bag)
    for k, entry in enumerate(recorded_run.of(entries, JOINT_STATES)):
        stamp, values = decoder.decode(entry[3]), decoder.values.reshape(3, 2).copy()
        values[0, 1] = np.nan if k == 200 else values[0, 1]
        values[2] = np.nan if k < 40 else values[2]  # no torque yet
        entry[3] = encoder.encode(stamp, *values)
    states = recorded_run.of(entries, JOINT_STATES)
    path = recorded_run.write(tmp_path / 'bag', states)
    assert main(['replay', str(path), '--config', 'recommended']) == 0
    output = capsys.readouterr().out
    assert 'note: 41 states left out: not finite' in output
    assert 'nan' not in output


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['nowhere'], 'nowhere cannot be read as a bag: there is no such folder'),
        (['nowhere', '--config', 'recomended'], 'recomended does not exist'),
        (['nowhere', '--config', 'recommended', '--map', 'joint1'], 'one side is missing'),
    ],
)
def test_error_is_reported_in_one_message(arguments, message, capsys):
    assert main(['replay', *arguments]) == 1
    error = capsys.readouterr().err
    assert error.startswith('blf_dsc replay: ')
    assert message in error
