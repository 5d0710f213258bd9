# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc run` over ROS: its results are complete and nothing is lost."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import closed_loop
from ros_rig import simulated
from rosbags.highlevel import AnyReader

from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import load_loop

HALF = {'learning.initial_estimate': [0.5, 0.16, 0.2]}
DURATION = 3  # s
SAMPLES = 3001
EACH_TENTH = ('reference', 'monitor')
COUNTS = {
    '/joint_states': SAMPLES,
    '/blf_dsc_controller/tracking_error': SAMPLES,
    '/blf_dsc_controller/commands': SAMPLES + 1,  # the last torque, when it ends
    '/blf_dsc_controller/bound': 1,
    **{f'/blf_dsc_controller/{topic}': 301 for topic in EACH_TENTH},
    '/sim_plant/truth': 301,
}
TYPES = dict.fromkeys(COUNTS, 'sensor_msgs/msg/JointState') | {
    '/blf_dsc_controller/commands': 'std_msgs/msg/Float64MultiArray'
}


@pytest.fixture(scope='module')
def out(tmp_path_factory):
    """Results of a run in lock-step."""
    folder = tmp_path_factory.mktemp('run')
    config, out = folder / 'chain.yaml', folder / 'results' / 'first'
    config.write_text(f'blf_dsc_controller:\n  ros__parameters: {json.dumps(HALF)}\n')
    arguments = ('--config', config, '--mode', 'lockstep', '--duration', DURATION)
    run = closed_loop(*arguments, '--out', out)
    assert run.returncode == 0, run.stderr
    (out / 'output.txt').write_text(run.stdout + run.stderr)
    return out


@pytest.fixture(scope='module')
def reading(out):
    """Topics with types and counts from another library, and the stamps of all joint states."""
    with AnyReader([out / 'bag']) as reader:
        topics = {each.topic: [each.msgtype, each.msgcount] for each in reader.connections}
        states = [each for each in reader.connections if each.topic == '/joint_states']
        headers = (
            reader.deserialize(raw, each.msgtype).header for each, _, raw in reader.messages(states)
        )
        return topics, [each.stamp.sec * 10**9 + each.stamp.nanosec for each in headers]


@pytest.fixture(scope='module')
def counts(out, reading):
    """COUNTS, plus the states that the plant sent again when a torque took over 3 s to arrive."""
    repeated = [stamp for stamp, after in pairwise(reading[1]) if stamp == after]
    log = (out / 'logs' / 'loop.log').read_text()
    assert len(repeated) == log.count('sending the state again')
    truths = sum(stamp % 10_000_000 == 0 for stamp in repeated)
    return COUNTS | {'/joint_states': SAMPLES + len(repeated), '/sim_plant/truth': 301 + truths}


def test_torques_over_ros_match_the_offline_run_bit_for_bit(out, tmp_path):
    again = ['run', '--config', out / 'config.yaml', '--offline', '--out', tmp_path / 'out']
    assert main([str(each) for each in again]) == 0
    recorded, computed = read_run(out / 'bag'), read_run(tmp_path / 'out' / 'bag')
    np.testing.assert_array_equal(recorded.torque, computed.torque)
    np.testing.assert_array_equal(recorded.position, computed.position)
    np.testing.assert_array_equal(recorded.stamp, computed.stamp)
    plant = {'duration': float(DURATION)}
    np.testing.assert_array_equal(recorded.torque, simulated(plant, HALF).torque)


def test_another_library_reads_the_whole_bag(reading, counts):
    topics, stamps = reading
    expected = {topic: [TYPES[topic], count] for topic, count in counts.items()}
    assert {topic: topics[topic] for topic in expected} == expected
    np.testing.assert_array_equal(np.unique(stamps), 10**9 + 10**6 * np.arange(SAMPLES))
    assert sorted(stamps) == stamps


def test_command_reports_where_the_results_are(out, counts):
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['samples'] == SAMPLES
    assert summary['held'] is True
    assert {topic: summary['messages'][topic] for topic in counts} == counts
    for picture in ('tracking.png', 'parameters.png'):
        assert (out / picture).read_bytes().startswith(b'\x89PNG')
    output = (out / 'output.txt').read_text()
    assert 'bound       held by every joint' in output
    assert f'wrote       {out}: bag, summary.json, tracking.png, parameters.png' in output
    for process in ('loop', 'bag_recorder'):
        log = (out / 'logs' / f'{process}.log').read_text()
        assert log
        assert 'XMLPARSER' not in log  # config/fastdds.xml is accepted


def test_configuration_beside_the_bag_is_the_one_that_ran(out):
    config = load_loop(out / 'config.yaml')
    assert (config.plant.mode, config.plant.duration) == ('lockstep', DURATION)
    assert config.recorder.output == str(out / 'bag')


def test_redirected_output_has_plain_progress_lines(out):
    output = (out / 'output.txt').read_text()
    assert '\r' not in output
    progress = [line for line in output.splitlines() if line.startswith('closed loop ')]
    assert len(progress) >= 1
    assert 'max|xi1|/bound' in progress[-1]
    assert 'parameters  error end 41.5 %' in output
