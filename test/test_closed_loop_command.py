# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc run` over ROS: its results are complete, and however it ends, its recording is kept."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from nights import at_night

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import (
    COMMAND,
    COMPILED,
    NO_PICTURES,
    PATIENT,
    Running,
    closed_loop,
    finished,
    wait_for,
)
from recorded_run import small_disk
from ros_rig import simulated
from rosbags.highlevel import AnyReader

from blf_dsc_controller import read_run
from blf_dsc_controller.bags.recovery import recover
from blf_dsc_controller.cli.main import main

HALF = {'two_link.initial_estimate': [0.5, 0.16, 0.2]}
DURATION = 1  # s
SAMPLES = 1001


@pytest.fixture(scope='module')
def out(tmp_path_factory):
    """Results of a run in lock-step."""
    folder = tmp_path_factory.mktemp('run')
    config = folder / 'chain.yaml'
    out = folder / 'results' / 'first'
    config.write_text(f'blf_dsc_controller:\n  ros__parameters: {json.dumps(HALF)}\n')
    arguments = ('--config', config, '--mode', 'lockstep', '--duration', DURATION)
    run = closed_loop(*arguments, '--out', out, pictures=True)
    assert run.returncode == 0, run.stderr
    (out / 'output.txt').write_text(run.stdout + run.stderr)
    return out


@pytest.mark.usefixtures('blank_pictures')
def test_torques_over_ros_match_the_offline_run_bit_for_bit(out, tmp_path):
    again = [
        'run',
        '--config',
        out / 'config.yaml',
        '--offline',
        '--out',
        tmp_path / 'out',
    ]
    assert main([str(each) for each in again]) == 0
    recorded = read_run(out / 'bag')
    computed = read_run(tmp_path / 'out' / 'bag')
    np.testing.assert_array_equal(recorded.torque, computed.torque)
    np.testing.assert_array_equal(recorded.position, computed.position)
    np.testing.assert_array_equal(recorded.stamp, computed.stamp)
    plant = {'duration': float(DURATION)}
    np.testing.assert_array_equal(recorded.torque, simulated(plant, HALF).torque)


def test_bag_has_every_message(out):
    with AnyReader([out / 'bag']) as reader:
        counts = {each.topic: each.msgcount for each in reader.connections}
    # The plant sends a state again when a torque takes over 3 s to arrive.
    assert counts['/joint_states'] >= SAMPLES
    assert counts['/sim_plant/truth'] >= 101
    expected = {'tracking_error': SAMPLES, 'reference': 101, 'monitor': 101, 'bound': 1}
    expected['commands'] = SAMPLES + 1  # the last torque, when it ends
    assert {
        topic: counts[f'/blf_dsc_controller/{topic}'] for topic in expected
    } == expected


def test_command_reports_where_the_results_are(out):
    # what is unknown is null, since JSON has no NaN
    text = (out / 'summary.json').read_text()
    summary = json.loads(text, parse_constant=pytest.fail)
    assert summary['samples'] == SAMPLES
    assert summary['held'] is True
    for picture in ('tracking.png', 'parameters.png'):
        assert (out / picture).read_bytes().startswith(b'\x89PNG')
    output = (out / 'output.txt').read_text()
    assert 'bound       held by every joint' in output
    assert 'parameters  error end 40.1 %' in output
    assert 'closed loop ' not in output  # no bar, as this is no terminal
    assert (
        f'wrote       {out}: bag, summary.json, tracking.png, parameters.png' in output
    )
    for process in ('loop', 'bag_recorder'):
        log = (out / 'logs' / f'{process}.log').read_text()
        assert log
        assert 'XMLPARSER' not in log  # config/fastdds.xml is accepted


OPEN = """<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="open" is_default_profile="true"/>
</profiles>
"""


@pytest.fixture
def running(tmp_path, monkeypatch):
    """A run from a shell that is set up to reach other computers."""
    open_profile = (
        tmp_path / 'DEFAULT_FASTRTPS_PROFILES.xml'
    )  # read where a node starts
    open_profile.write_text(OPEN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(open_profile))
    monkeypatch.setenv('ROS_STATIC_PEERS', '192.0.2.1')
    monkeypatch.setenv('ROS_DISCOVERY_SERVER', '192.0.2.1:11811')
    # Fast DDS would share memory
    monkeypatch.setenv('ROS_LOCALHOST_ONLY', '1')
    command = Running(tmp_path / 'out')
    yield command
    command.close()


def whole(bag):
    """Check that no sample of a bag is missing up to its end.

    Return the number of samples.
    """
    run = read_run(bag)
    assert set(np.diff(run.stamp)) == {1_000_000}
    return run.stamp.size


def ended_cleanly(running, number):
    """End a run by a signal, check that bag and report are whole, and return its output."""
    running.process.send_signal(number)
    code, output, errors = running.end()
    assert code == 130, errors
    assert 'Traceback' not in errors
    running.wait_for_children()
    samples = whole(running.out / 'bag')
    assert f'{samples} samples' in output
    for result in ('summary.json', 'tracking.png', 'bag/metadata.yaml'):
        assert (running.out / result).is_file()
    return output


def sockets(pid):
    """Yield the local address of each socket of a process, as the kernel shows it."""
    opened = {str(each.readlink()) for each in Path(f'/proc/{pid}/fd').iterdir()}
    for table in ('udp', 'udp6', 'tcp', 'tcp6'):
        path = Path('/proc/net', table)
        for line in path.read_text().splitlines()[1:] if path.exists() else ():
            _, local, *columns = line.split()
            if f'socket:[{columns[7]}]' in opened:
                yield local.partition(':')[0]


def test_run_exchanges_messages_on_this_computer_only_and_sigterm_shuts_down_cleanly(
    running,
):
    """Another one may name it in its ROS_STATIC_PEERS: its datagrams find no socket."""
    for process in (running.process.pid, *running.children):
        found = [*sockets(process)]
        assert found
        assert set(found) == {'0100007F'}  # 127.0.0.1
    ended_cleanly(running, signal.SIGTERM)


def test_killed_node_is_reported_and_ends_the_others(running):
    for process in (
        running.process.pid,
        running.child('blf_dsc_controller.nodes.lockstep_loop'),
    ):
        # A killed process would leave it broken, and crash the others.
        assert 'shm/fastrtps' not in Path(f'/proc/{process}/maps').read_text()
    os.kill(running.child('blf_dsc_controller.nodes.lockstep_loop'), signal.SIGKILL)
    code, _, errors = running.end()
    assert code == 1, errors
    assert 'blf_dsc run: loop was terminated by SIGKILL' in errors
    assert f'the recording up to then is in {running.out / "bag"}' in errors
    assert 'Traceback' not in errors
    running.wait_for_children()
    assert whole(running.out / 'bag') > 100


def test_killed_recorder_ends_the_run_without_waiting_for_it(running):
    """To the others it looks alive for 20 s, but nobody takes their last messages."""
    os.kill(running.child('recorder_node'), signal.SIGKILL)
    code, _, errors = running.end()
    assert code == 1
    assert 'bag_recorder has ended: so does the run' in errors
    assert 'bag_recorder was terminated by SIGKILL' in errors
    assert f'blf_dsc recover {running.out / "bag"} saves what was recorded' in errors
    assert 'Traceback' not in errors
    running.wait_for_children()
    # It was not waited for until its messages were given up.
    log = (running.out / 'logs' / 'loop.log').read_text()
    assert 'did not reach every subscriber' not in log


def test_run_without_a_network_is_refused_at_once(tmp_path):
    """In a container without any interface; offline runs need none."""
    alone = ('unshare', '--map-root-user', '--net', *COMMAND)
    out = tmp_path / 'out'
    run = finished(*alone, '--duration', 0.1, '--out', out)
    assert run.returncode == 1
    assert '127.0.0.1, which cannot be reached (Network is unreachable)' in run.stderr
    assert 'ip link set lo up' in run.stderr
    assert not out.exists()
    words = ('--offline', '--duration', 0.1, '--out', tmp_path / 'off')
    offline = finished(*alone, *words, env=os.environ | NO_PICTURES)
    assert offline.returncode == 0, offline.stderr


def test_no_node_outlives_the_command(running):
    running.process.kill()
    running.process.communicate()
    running.wait_for_children()
    bag = running.out / 'bag'
    wait_for((bag / 'metadata.yaml').exists)
    assert whole(bag) > 100


def test_loop_in_lockstep_waits_for_its_recorder_and_ctrl_c_shuts_down_cleanly(running):
    """The recorder holds 5000 messages of each topic; the loop says when it waits for it."""
    recorder = running.child('recorder_node')
    os.kill(recorder, signal.SIGSTOP)
    log = running.out / 'logs' / 'loop.log'
    wait_for(lambda: 'waiting for subscribers' in log.read_text())
    os.kill(recorder, signal.SIGCONT)
    assert 'missing' not in ended_cleanly(running, signal.SIGINT)


def test_interrupted_before_the_loop_began_a_run_leaves_nothing_and_may_be_repeated(
    tmp_path,
):
    out = tmp_path / 'out'
    started = subprocess.Popen(
        [*COMMAND, '--mode', 'lockstep', '--duration', '0.1', '--out', str(out)],
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for((out / 'logs' / 'loop.log').exists, COMPILED)  # it imports now
    started.send_signal(signal.SIGINT)
    _, errors = started.communicate()
    assert started.returncode == 130, errors
    assert errors.splitlines()[-1] == 'blf_dsc run: interrupted'
    assert 'Traceback' not in errors
    assert not out.exists()


@pytest.mark.parametrize('mode', ['lockstep', *at_night('realtime')])
def test_full_disk_ends_the_run_and_tells_how_to_recover_the_bag(tmp_path, mode):
    config = tmp_path / 'patient.yaml'
    config.write_text(PATIENT)
    with small_disk(tmp_path / 'disk', 2) as disk:  # a second takes over 1 MB
        out = disk / 'out'
        run = closed_loop(
            '--config', config, '--mode', mode, '--duration', 10_000, '--out', out
        )
        assert run.returncode == 1
        assert 'bag_recorder exited with code 1:' in run.stderr
        assert f'no space left on the disk of {out}' in run.stderr
        assert f'blf_dsc recover {out / "bag"} saves what was recorded' in run.stderr
        assert 'Traceback' not in run.stderr
        recovered = recover(out / 'bag', tmp_path / 'clean').messages['/joint_states']
        assert recovered > 500
