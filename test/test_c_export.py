# SPDX-License-Identifier: Apache-2.0
"""The law called from C: the torques of Python, bit for bit, and what it refuses."""

from __future__ import annotations

import shutil
import subprocess
import zlib

import numpy as np
import pytest
from command import finished
from recorded_run import QUICK

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, dump
from blf_dsc_controller.run import FIRST_STAMP
from sim_plant.plant import plant_of

CASES = {'recommended': QUICK, 'panda': {}}
SETTINGS = 'blf_dsc_law.bin'
SOURCES = ('example.c', 'blf_dsc_law.c', 'blf_dsc_update.o', 'blf_dsc_advance.o')
MISSED = range(700, 712)  # samples whose states do not arrive
PERIOD = 1_000_000  # ns
STOPPED = 5  # exit code of the example


def built(folder, config):
    """Export the law of a configuration; return its example, built by the system's compiler."""
    file = folder.with_suffix('.yaml')
    dump(file, {CONTROLLER: config})
    assert main(['export-c', '--config', str(file), '--out', str(folder)]) == 0
    compiler = shutil.which('cc')
    assert compiler, 'there is no C compiler: install gcc or clang'
    program = folder / 'example'
    strict = ('-std=c99', '-O2', '-Wall', '-Wextra', '-Werror', '-no-pie')
    sources = [folder / name for name in SOURCES]
    compiled = finished(compiler, *strict, *sources, '-o', program)
    assert compiled.returncode == 0, compiled.stderr
    return program


def run_in_python(loop):
    """Run the arm, which learns, with a gap; return lines for the example, and torques (k, n)."""
    plant = plant_of(loop.plant)
    lines, torques, estimates = [], [], []
    with blf.ArmController(loop.controller) as controller:
        for step in range(1500):
            state = plant.measure()
            if step not in MISSED:
                stamp = FIRST_STAMP + step * PERIOD
                torque = controller.update(1e-9 * stamp, *state.reshape(3, -1))
                reference = np.ravel(controller.reference)
                lines.append(' '.join(map(str, (stamp, *state, *reference))))
                torques.append(torque)
                estimates.append(controller.estimates)
            plant.step(torque)
        assert controller.phase in {blf.Phase.APPROACHING, blf.Phase.TRACKING}
    assert estimates[0] != estimates[-1]
    return lines, np.array(torques)


def run_in_c(program, settings, lines):
    """Run the example to its end; return its process, and its torques (k, n)."""
    run = subprocess.run(
        [program, settings],
        input='\n'.join(lines),
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    return run, np.array([line.split() for line in run.stdout.splitlines()], float)


@pytest.fixture(scope='module', params=CASES)
def case(request, tmp_path_factory):
    """Return the program in C, and a run in Python."""
    chosen = {CONTROLLER: CASES[request.param], PLANT: {'duration': 2.0}}
    loop = blf.load_loop(request.param, chosen)
    folder = tmp_path_factory.mktemp('law') / request.param
    return built(folder, loop.controller), *run_in_python(loop)


def test_torques_are_those_of_python_bit_for_bit_also_with_missed_states(case):
    program, lines, torques = case
    run, found = run_in_c(program, program.with_name(SETTINGS), lines)
    assert run.returncode == 0, run.stderr
    np.testing.assert_array_equal(found, torques)


def test_a_state_that_cannot_be_and_a_gap_have_a_flag_and_no_torque(case):
    program, lines, torques = case
    settings = program.with_name(SETTINGS)
    words = lines[100].split()
    no_position = ' '.join([words[0], 'nan', *words[2:]])
    no_reference = ' '.join([*words[:-1], 'nan'])
    for rest in (no_position, no_reference, lines[140]):
        run, found = run_in_c(program, settings, [*lines[:100], rest])
        assert run.returncode == STOPPED
        assert run.stderr.startswith('flags 4 at ')
        np.testing.assert_array_equal(found, torques[:100])


def test_settings_that_are_damaged_or_of_another_object_are_refused(case, tmp_path):
    program, lines, _ = case
    whole = program.with_name(SETTINGS).read_bytes()
    other = b'0' * 64 + whole[64:-4]
    other += zlib.crc32(other).to_bytes(4, 'little')
    damaged = whole[:1000] + bytes([whole[1000] ^ 1]) + whole[1001:]
    file = tmp_path / 'settings'
    for content, problem in (
        (damaged, 'damaged'),
        (whole[:-1], 'damaged'),
        (whole + b'0', 'damaged'),
        (other, 'of other objects'),
    ):
        file.write_bytes(content)
        run, found = run_in_c(program, file, lines)
        assert run.returncode == 1
        assert f'the file of the settings is {problem}' in run.stderr
        assert not found.size


@pytest.mark.parametrize(
    ('section', 'given', 'problem'),
    [
        (CONTROLLER, 'contact: {enabled: true}', 'contact.enabled'),
        (CONTROLLER, 'safety: {velocity: estimated}', 'safety.velocity is estimated'),
        (CONTROLLER, 'law: backstepping', 'law is backstepping: only blf_dsc'),
        ('drive', 'feedback: motor', 'drive.feedback is motor'),
    ],
)
def test_what_python_alone_does_is_refused(section, given, problem, tmp_path, capsys):
    file, out = tmp_path / 'my.yaml', tmp_path / 'law'
    file.write_text(f'{section}:\n  ros__parameters:\n    {given}\n')
    assert main(['export-c', '--config', str(file), '--out', str(out)]) == 1
    assert problem in capsys.readouterr().err
    assert not out.exists()
