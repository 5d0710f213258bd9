# SPDX-License-Identifier: Apache-2.0
"""The law called from C: the torques of Python, bit for bit, and what it refuses."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest
from command import finished
from recorded_run import QUICK

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import CONTROLLER, dump
from blf_dsc_controller.run import FIRST_STAMP
from sim_plant.plant import plant_of

SOURCES = ('example.c', 'blf_dsc_law.c', 'blf_dsc_law.o')
MISSED = range(700, 712)  # samples whose states do not arrive
DURATIONS = {'recommended': 1.5, 'panda': 1.0}  # s


def exported(folder, config):
    """Export the law of a configuration; return its example, built by the system's compiler."""
    dump(folder.with_suffix('.yaml'), {CONTROLLER: config})
    given = ['--config', str(folder.with_suffix('.yaml')), '--out', str(folder)]
    assert main(['export-c', *given]) == 0
    compiler = shutil.which('cc')
    assert compiler, 'there is no C compiler: install gcc or clang'
    strict = ('-std=c99', '-O2', '-Wall', '-Wextra', '-Werror', '-no-pie')
    sources = [folder / name for name in SOURCES]
    built = finished(compiler, *strict, *sources, '-o', folder / 'example')
    assert built.returncode == 0, built.stderr
    return folder / 'example'


def run_in_python(loop):
    """Run the arm with a gap; return lines for the example, and the torques (k, n) [N m]."""
    plant = plant_of(loop.plant)
    period = round(loop.plant.sample_time * 1e9)
    lines, torques = [], []
    with blf.ArmController(loop.controller) as controller:
        for step in range(round(loop.plant.duration / loop.plant.sample_time)):
            state = plant.measure()
            if step not in MISSED:
                stamp = FIRST_STAMP + step * period
                torque = controller.update(1e-9 * stamp, *state.reshape(3, -1))
                assert controller.phase in {blf.Phase.APPROACHING, blf.Phase.TRACKING}
                values = *state, *np.ravel(controller.reference)
                lines.append(' '.join(map(repr, (stamp, *map(float, values)))))
                torques.append(torque)
            plant.step(torque)
        learned = np.any(controller.estimates != controller.config)
    assert learned
    return lines, np.array(torques)


def run_in_c(program, settings, lines):
    """Return the process of the example."""
    return subprocess.run(
        [program, settings],
        input='\n'.join(lines),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.fixture(scope='module', params=DURATIONS)
def case(request, tmp_path_factory):
    """An exported law, a run of it in Python, and the program in C."""
    loop = blf.load_loop(
        request.param,
        {
            'sim_plant': {'duration': DURATIONS[request.param]},
            'blf_dsc_controller': QUICK if request.param == 'recommended' else {},
        },
    )
    folder = tmp_path_factory.mktemp('c') / request.param
    return folder, exported(folder, loop.controller), *run_in_python(loop)


def test_torques_are_those_of_python_bit_for_bit_also_after_a_gap(case):
    folder, program, lines, torques = case
    run = run_in_c(program, folder / 'blf_dsc_law.bin', lines)
    assert run.returncode == 0, run.stderr
    found = np.array([line.split() for line in run.stdout.splitlines()], dtype=float)
    np.testing.assert_array_equal(found, torques)
    print(run.stderr)
