# SPDX-License-Identifier: Apache-2.0
"""The sampled plant as a whole: repeatable, restorable, and independent of how it is called."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys
from plants import START, commands, motion, plant, rough_disturbance, run

from blf_dsc_controller.compiled.jit import kernel
from sim_plant.kernels import draw_noise, observe, plant_views, step
from sim_plant.motion import Stages, integrate
from sim_plant.sensors import DIFFERENCED, MEASURED

IMPERFECTIONS = {
    'position_noise': 1e-5,
    'velocity_noise': 1e-3,
    'resolution': 1e-5,
    'torque_limit': (8.0, 3.0),
    'delay': 2,
    'time_constant': 2e-3,
    'torque_noise': 0.01,
    'velocity_pole': 400.0,
}
REPOSITORY = Path(__file__).parents[1]


def full_plant(**changes):
    """A plant with every kind of imperfection."""
    load = rough_disturbance()._replace(
        stribeck=0.5, ripple=np.array([0.1, 0.05]), ripple_frequency=20.0
    )
    return plant(load=load, **{**IMPERFECTIONS, **changes})


@kernel
def compiled_run(arm, settings, state, rng, torques, rows):
    plant, now = plant_views(arm, settings, state)
    for k in range(len(torques)):
        draw_noise(plant, now, rng)
        observe(plant, now, rows[k])
        step(plant, now, torques[k])


@pytest.mark.parametrize('source', [MEASURED, DIFFERENCED])
@pytest.mark.parametrize('noise', [0.0, 1e-5])
def test_compiled_loop_and_python_calls_are_bit_identical(source, noise):
    changes = {'velocity_source': source, 'position_noise': noise}
    arm, other = (full_plant(seed=11, **changes) for _ in range(2))
    rows = np.empty((300, 6))
    compiled_run(other.arm, other.settings, other.state, other.rng, commands(300), rows)
    assert (run(arm, commands(300)) == rows).all()
    assert (arm.state == other.state).all()
    assert arm.rng.bit_generator.state == other.rng.bit_generator.state


def test_sample_times_are_whole_nanoseconds():
    """The disturbance is evaluated at t_k = (k T_ns) 1e-9 s, to the last bit."""
    period_ns, load = 333_333, rough_disturbance()
    arm = plant(load=load, period_ns=period_ns)
    x, stages = np.array([*START, 0.0, 0.0]), Stages(np.empty(4), np.empty((6, 4)))
    for k, torque in enumerate(commands(100)):
        arm.step(torque)
        integrate(motion(load=load), (k * period_ns) * 1e-9, period_ns * 1e-9, torque, x, stages)
    assert (arm.truth()[5:] == x).all()


def test_reset_plant_repeats_its_run():
    arm = full_plant(seed=2)
    first = run(arm, commands(50))
    arm.reset()
    assert arm.sample == 0
    assert (run(arm, commands(50)) == first).all()


@pytest.mark.parametrize('source', [MEASURED, DIFFERENCED])
def test_restored_plant_continues_bit_for_bit(source):
    torques = commands(120)
    arm = full_plant(velocity_source=source)
    run(arm, torques[:60])
    saved = arm.save()
    expected = run(arm, torques[60:])
    other = full_plant(velocity_source=source, seed=99)
    run(other, torques[:7])
    other.restore(saved)
    assert (run(other, torques[60:]) == expected).all()
    assert (other.state == arm.state).all()


def test_arm_stopped_for_excessive_speed_stays_stopped_when_restored():
    arm = plant()
    run(arm, np.full((300, 2), 9e3))
    assert arm.is_broken
    before = arm.measure().copy()
    arm.restore(arm.save())
    after = run(arm, np.full((3, 2), 9e3))
    np.testing.assert_array_equal(after[-1, :2], before[:2])
    assert not after[-1, 2:4].any()
    arm.reset()
    assert not arm.is_broken


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason='compares compiled code with Python')
def test_results_are_the_same_without_compilation():
    """The interpreter's libm and order of operations agree with the compiler's up to rounding."""
    program = (
        'import json, sys\n'
        'from plants import commands, run\n'
        'from test_plant_sampled import full_plant\n'
        'json.dump(run(full_plant(seed=6), commands(100)).tolist(), sys.stdout)\n'
    )
    paths = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / 'test')])
    environment = {**os.environ, 'NUMBA_DISABLE_JIT': '1', 'PYTHONPATH': paths}
    output = subprocess.run(
        [sys.executable, '-c', program], env=environment, check=True, stdout=subprocess.PIPE
    ).stdout
    interpreted = np.array(json.loads(output))
    assert run(full_plant(seed=6), commands(100)) == pytest.approx(interpreted, rel=1e-10)


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason='counts allocations of compiled code')
def test_step_allocates_no_memory():
    arm = full_plant()

    def allocations(samples):
        torques, rows = commands(samples), np.empty((samples, 6))
        before = rtsys.get_allocation_stats()
        compiled_run(arm.arm, arm.settings, arm.state, arm.rng, torques, rows)
        return rtsys.get_allocation_stats().mi_alloc - before.mi_alloc

    counting = _nrt_python.memsys_stats_enabled()
    _nrt_python.memsys_enable_stats()
    try:
        assert allocations(2000) == allocations(1)
    finally:
        if not counting:
            _nrt_python.memsys_disable_stats()
