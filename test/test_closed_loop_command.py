# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc run` with three processes: its results are complete and nothing is lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import PATIENT, closed_loop, finished
from ros_rig import simulated_torques

from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.params_file import load_loop

DURATION = 3  # s
SAMPLES = 3001
EACH_SAMPLE = ('commands', 'reference', 'tracking_error', 'learning')
COUNTS = {
    '/joint_states': SAMPLES,
    **{f'/blf_dsc_controller/{topic}': SAMPLES for topic in EACH_SAMPLE},
    '/blf_dsc_controller/bound': 1,
    '/blf_dsc_controller/monitor': 301,  # every tenth sample
    '/sim_plant/truth': 301,
}
TYPES = dict.fromkeys(COUNTS, 'sensor_msgs/msg/JointState') | {
    '/blf_dsc_controller/commands': 'std_msgs/msg/Float64MultiArray'
}

STRANGER = """
import json, sys
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from pathlib import Path
bag = Path(sys.argv[1])
with (bag / 'bag_0.mcap').open('rb') as file:
    summary = make_reader(file).get_summary()
by_mcap = {
    channel.topic: [summary.schemas[channel.schema_id].name,
                    summary.statistics.channel_message_counts.get(channel.id, 0)]
    for channel in summary.channels.values()
}
with AnyReader([bag]) as reader:
    by_rosbags = {c.topic: [c.msgtype, c.msgcount] for c in reader.connections}
    states = [c for c in reader.connections if c.topic == '/joint_states']
    stamps = [
        (lambda stamp: stamp.sec * 10**9 + stamp.nanosec)(
            reader.deserialize(raw, connection.msgtype).header.stamp
        )
        for connection, _, raw in reader.messages(states)
    ]
assert not any(name.startswith(('blf_dsc', 'sim_plant', 'rclpy')) for name in sys.modules)
print(json.dumps([[by_mcap, by_rosbags], stamps]))
"""


@pytest.fixture(scope='module')
def out(tmp_path_factory):
    """Results of a run in lock-step."""
    out = tmp_path_factory.mktemp('run') / 'results' / 'first'
    run = closed_loop('--mode', 'lockstep', '--duration', DURATION, '--out', out)
    assert run.returncode == 0, run.stderr
    (out / 'output.txt').write_text(run.stdout + run.stderr)
    return out


@pytest.fixture(scope='module')
def reading(out):
    """Topics with types and counts from two libraries, and the stamps of all joint states."""
    run = finished(sys.executable, '-I', '-c', STRANGER, out / 'bag', cwd=out)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.fixture(scope='module')
def counts(out, reading):
    """COUNTS, plus the states that the plant sent again when a torque took over 3 s to arrive."""
    repeated = [stamp for stamp, after in pairwise(reading[1]) if stamp == after]
    log = (out / 'logs' / 'sim_plant.log').read_text()
    assert len(repeated) == log.count('sending the state again')
    truths = sum(stamp % 10_000_000 == 0 for stamp in repeated)
    return COUNTS | {'/joint_states': SAMPLES + len(repeated), '/sim_plant/truth': 301 + truths}


def test_torques_of_three_processes_match_the_offline_run_bit_for_bit(out, tmp_path):
    offline = closed_loop(
        '--offline', '--mode', 'lockstep', '--duration', DURATION, '--out', tmp_path / 'out'
    )
    assert offline.returncode == 0, offline.stderr
    recorded, computed = read_run(out / 'bag'), read_run(tmp_path / 'out' / 'bag')
    np.testing.assert_array_equal(recorded.torque, computed.torque)
    np.testing.assert_array_equal(recorded.position, computed.position)
    np.testing.assert_array_equal(recorded.stamp, computed.stamp)
    np.testing.assert_array_equal(recorded.torque, simulated_torques({'duration': float(DURATION)}))


def test_torques_match_on_a_busy_machine(tmp_path):
    busy = [sys.executable, '-c', 'while True: pass']
    busy_processes = [subprocess.Popen(busy) for _ in range(os.cpu_count() or 1)]
    try:
        run = closed_loop('--mode', 'lockstep', '--duration', 1, '--out', tmp_path / 'out')
    finally:
        for process in busy_processes:
            process.kill()
            process.wait()
    assert run.returncode == 0, run.stderr
    torque = read_run(tmp_path / 'out' / 'bag').torque
    np.testing.assert_array_equal(torque, simulated_torques({'duration': 1.0}))


def test_programs_without_this_package_read_the_whole_bag(reading, counts):
    topics, stamps = reading
    expected = {topic: [TYPES[topic], count] for topic, count in counts.items()}
    for by_library in topics:
        assert {topic: by_library[topic] for topic in expected} == expected
    np.testing.assert_array_equal(np.unique(stamps), 10**9 + 10**6 * np.arange(SAMPLES))
    assert sorted(stamps) == stamps


def test_command_reports_where_the_results_are(out, counts):
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['samples'] == SAMPLES
    assert summary['tracking']['held'] is True
    assert {topic: summary['messages'][topic] for topic in counts} == counts
    for picture in ('tracking.png', 'parameters.png'):
        assert (out / picture).read_bytes().startswith(b'\x89PNG')
    output = (out / 'output.txt').read_text()
    assert 'bound       held by every joint' in output
    assert f'wrote       {out}: bag, summary.json, tracking.png, parameters.png' in output
    for node in ('sim_plant', 'blf_dsc_controller', 'bag_recorder'):
        assert (out / 'logs' / f'{node}.log').read_text()


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
    assert 'parameter error' in progress[-1]


def test_real_time_run_reports_its_timing(tmp_path):
    config = tmp_path / 'fifo.yaml'
    fifo = '/**:\n  ros__parameters:\n    realtime: {priority: 10, lock_memory: true}\n'
    config.write_text(fifo + PATIENT)
    out = tmp_path / 'out'
    run = closed_loop('--mode', 'realtime', '--duration', 1, '--config', config, '--out', out)
    assert run.returncode == 0, run.stderr
    timing = json.loads((out / 'summary.json').read_text())['timing']
    assert set(timing) == {'rate_hz', 'latency_us', 'late_steps'}
    assert timing['rate_hz'] > 0.0
    assert list(timing['latency_us']) == ['p50', 'p99', 'p99.9', 'max']
    assert timing['late_steps'] >= 0
    assert 'real time' in run.stdout
    assert 'late steps' in run.stdout
    for node in ('sim_plant', 'blf_dsc_controller'):
        output = (out / 'logs' / f'{node}.log').read_text()
        # Granted or denied, as this machine permits, but always logged.
        assert 'SCHED_FIFO priority 10' in output
        assert 'memory' in output


def test_planar_chain_runs_over_ros_and_reports_parameter_error(tmp_path):
    text = (
        'blf_dsc_controller:\n  ros__parameters:\n    model: planar_chain\n'
        '    learning: {initial_estimate: [0.5, 0.2, 0.16]}\n'
    )
    (tmp_path / 'chain.yaml').write_text(text)
    arguments = ('--config', tmp_path / 'chain.yaml', '--mode', 'lockstep', '--duration', 0.5)
    run = closed_loop(*arguments, '--out', tmp_path / 'out')
    assert run.returncode == 0, run.stderr
    # As with the model two_link.
    assert 'parameter error 41.89 %' in run.stderr
    assert 'parameters  error end 41.9 %' in run.stdout
