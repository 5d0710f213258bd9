# SPDX-License-Identifier: Apache-2.0
"""However a run ends early, its recording is kept and no process is left running."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import PATIENT, Running, closed_loop, wait_for
from recorded_run import small_disk

from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.bags.writer import recover


@pytest.fixture
def running(tmp_path, monkeypatch):
    monkeypatch.delenv('FASTRTPS_DEFAULT_PROFILES_FILE', raising=False)
    monkeypatch.setenv('ROS_LOCALHOST_ONLY', '1')  # of a user; Fast DDS would share memory
    command = Running(tmp_path / 'out')
    yield command
    command.close()


def whole(bag):
    """Check that no sample of a bag is missing up to its end; return the number of samples."""
    run = read_run(bag)
    assert set(np.diff(run.stamp)) == {1_000_000}
    return run.stamp.size


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_shuts_down_cleanly_with_bag_and_report(running, number):
    running.process.send_signal(number)
    code, output, errors = running.end()
    assert code == 130, errors
    assert 'Traceback' not in errors
    running.wait_for_children()
    samples = whole(running.out / 'bag')
    assert f'{samples} samples' in output
    for result in ('summary.json', 'tracking.png', 'bag/metadata.yaml'):
        assert (running.out / result).is_file()


def test_killed_node_is_reported_and_ends_the_others(running):
    for process in (running.process.pid, running.child('blf_dsc_controller.nodes.lockstep_loop')):
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


def test_no_node_outlives_the_command(running):
    running.process.kill()
    running.process.communicate()
    running.wait_for_children()
    bag = running.out / 'bag'
    wait_for((bag / 'metadata.yaml').exists)
    assert whole(bag) > 100


def test_loop_in_lockstep_waits_for_its_recorder(running):
    """Which holds 5000 messages of each topic; the loop takes thousands of steps a second."""
    recorder = running.child('recorder_node')
    os.kill(recorder, signal.SIGSTOP)
    time.sleep(8.0)
    os.kill(recorder, signal.SIGCONT)
    running.process.send_signal(signal.SIGINT)
    code, output, errors = running.end()
    assert code == 130, errors
    assert f'{whole(running.out / "bag")} samples' in output
    assert 'missing' not in output


@pytest.mark.parametrize('mode', ['lockstep', 'realtime'])
def test_full_disk_ends_the_run_and_tells_how_to_recover_the_bag(tmp_path, mode):
    config = tmp_path / 'patient.yaml'
    config.write_text(PATIENT)
    with small_disk(tmp_path / 'disk', 2) as disk:  # a second takes over 1 MB
        out = disk / 'out'
        run = closed_loop('--config', config, '--mode', mode, '--duration', 10_000, '--out', out)
        assert run.returncode == 1
        assert 'bag_recorder exited with code 1:' in run.stderr
        assert f'no space left on the disk of {out}' in run.stderr
        assert f'blf_dsc recover {out / "bag"} saves what was recorded' in run.stderr
        assert 'Traceback' not in run.stderr
        recovered = recover(out / 'bag', tmp_path / 'clean').messages['/joint_states']
        assert recovered > 500
