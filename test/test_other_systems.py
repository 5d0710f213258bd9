# SPDX-License-Identifier: Apache-2.0
"""What needs no ROS, on systems without the parts of Python that only Linux and its kin have."""

from __future__ import annotations

import subprocess
import sys

import pytest
from command import PATIENCE

import blf_dsc_controller as blf
from blf_dsc_controller.cli import domains
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.robot import Realtime
from blf_dsc_controller.control.realtime import request_realtime

COMPILED = 10 * PATIENCE

# Windows has none of these, macOS not all; its name is set once all is imported, since
# libraries ask for it.
WITHOUT = """
import os, sys
sys.modules |= dict.fromkeys(('fcntl', 'resource', 'rclpy'))
for name in ('getuid', 'geteuid', 'getloadavg', 'nice', 'sched_getaffinity',
             'sched_setscheduler', 'sched_param', 'SCHED_FIFO', 'SCHED_OTHER'):
    delattr(os, name)
import numpy as np
import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
loop = blf.load_loop('two_tone', {'sim_plant': {'duration': 0.05}})
run = blf.simulate(loop.controller, loop.plant).run()
sys.platform = 'another'
out = sys.argv[1]
main(['run', '--offline', '--config', 'two_tone', '--duration', '0.05', '--out', out])
same = np.array_equal(run.torque, blf.read_run(out + '/bag').torque)
print('as in the bag:', same)
main(['replay', out + '/bag'])
"""


def test_runs_bags_and_replay_need_nothing_that_only_linux_has(tmp_path):
    ended = subprocess.run(
        [sys.executable, '-c', WITHOUT, tmp_path / 'out'],
        capture_output=True,
        text=True,
        timeout=COMPILED,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert 'as in the bag: True' in ended.stdout
    assert 'bit-equal' in ended.stdout


@pytest.fixture
def other(monkeypatch):
    monkeypatch.setattr(sys, 'platform', 'another')


@pytest.mark.usefixtures('other')
def test_a_run_over_ros_is_refused_elsewhere_with_what_to_do(tmp_path, capsys):
    assert main(['run', '--out', str(tmp_path / 'out')]) == 1
    told = capsys.readouterr().err
    assert 'on Linux only: run with --offline' in told
    with pytest.raises(blf.BlfDscError, match='ros2 run'):
        domains.check_network()


@pytest.mark.usefixtures('other')
def test_real_time_is_left_out_elsewhere_with_a_word():
    said = []
    request_realtime(Realtime(priority=10), said.append)
    request_realtime(Realtime(), said.append)
    assert said == ['realtime: left out, since only Linux has it']


def test_a_drive_without_processes_that_inherit_sockets_names_another_way(monkeypatch):
    monkeypatch.setattr('os.name', 'nt')
    with pytest.raises(blf.DriveError, match='use ArmController in a loop of yours'):
        blf.Drive('panda', robot='simulated')
