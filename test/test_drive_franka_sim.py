# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc drive` on franka-sim's FR3, which ends motions as the robot does.

franky-sim, beside it (`test_drive_franka.py`), has neither a limit of the torque's rate nor
a deadline.  franka-sim wants another numpy: it runs with the Python of an environment of
its own, which FRANKA_SIM_PYTHON names.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from command import COMPILED, own_address

import blf_dsc_controller as blf

PYTHON = os.environ.get('FRANKA_SIM_PYTHON', '')
if not PYTHON:
    pytest.skip(
        'needs FRANKA_SIM_PYTHON, the Python of an environment with franka-sim',
        allow_module_level=True,
    )
pytest.importorskip('pylibfranka', reason='needs pylibfranka')

SERVER = Path(__file__).with_name('franka_sim_server.py')
BOUND = 0.04  # rad, of the preset


@pytest.fixture
def simulate():
    """Start a simulator at an address of its own, which it accepts connections at."""
    started = []

    def start(*events):
        address = own_address()
        words = [PYTHON, SERVER, address, *events]
        process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        timer = threading.Timer(COMPILED, process.kill)
        timer.start()
        started.append((process, timer))
        assert process.stdout.readline().strip() == 'ready'
        return address

    yield start
    for process, timer in started:
        timer.cancel()
        process.kill()
        process.wait()
        process.stdout.close()


def drive(address, duration, *options):
    """Return exit code and output of the command."""
    words = ['drive', '--robot', address, '--duration', duration, *options]
    command = [sys.executable, '-m', 'blf_dsc_controller', *map(str, words)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=COMPILED, check=False
    )
    return done.returncode, done.stdout + done.stderr


def test_two_kilograms_come_and_go_and_no_torque_steps_too_far(simulate, tmp_path):
    """Rotors and friction are not those that the law assumes."""
    address = simulate('load=2@500', 'load=0@1000')
    code, output = drive(address, 1.5, '--out', tmp_path / 'bag')
    assert code == 0, output
    recorded = blf.read_run(tmp_path / 'bag')
    assert set(np.diff(recorded.stamp)) == {1_000_000}  # ns: no state was missed
    assert np.nanmax(np.abs(recorded.error)) < BOUND
    assert blf.verify(tmp_path / 'bag').difference is None


def test_robot_that_hears_nothing_stops_by_itself_and_is_started_again(simulate):
    address = simulate('deaf@300')
    code, output = drive(address, 60)
    assert code == 5, output
    assert 'the robot stopped by itself' in output
    assert 'communication_constraints_violation' in output
    assert 'it has recovered' in output
    code, output = drive(address, 0.1)
    assert code == 0, output


def test_what_it_says_of_a_tau_j_that_is_the_command_ends_with_an_arm_that_moves(
    simulate, tmp_path
):
    address = simulate('published')
    code, output = drive(address, 1)
    assert code == 5, output
    advice = 'safety.first_torque: send and disturbance.observer_bandwidth: 0.0'
    assert advice in re.sub(r'\s+', ' ', output)
    preset = (blf.share_folder() / 'config/fr3_direct.yaml').read_text()
    preset = preset.replace('observer_bandwidth: 150.0', 'observer_bandwidth: 0.0')
    preset = preset.replace('    safety:\n', '    safety:\n      first_torque: send\n')
    (tmp_path / 'my.yaml').write_text(preset)
    code, output = drive(address, 1, '--config', tmp_path / 'my.yaml')
    assert code == 0, output
    assert 'sensors ' not in output
