# SPDX-License-Identifier: Apache-2.0
"""The sampled plant: its integrator against scipy, disturbances, and repeatable runs."""

import numpy as np
import pytest
from plants import FULL, ROUGH, START, commands, plant, run
from scipy.integrate import RK45

from blf_dsc_controller.compiled.jit import kernel
from sim_plant.kernels import observe, plant_views, step
from sim_plant.motion import disturbing_torque, integrate, state_derivative, update_loads

INITIAL = np.array([*START, 0.5, -1.0])
TORQUE = np.array([-6.0, -2.0])


def views(**changes):
    """Settings and state of a plant."""
    arm = plant(**changes)
    found = plant_views(arm.arm, arm.settings, arm.state)
    update_loads(*found)
    return found


def advanced(load, t, h, x=INITIAL, torque=TORQUE):
    """State after a step of h seconds."""
    arm, now = views(**load)
    now.x[:4] = x
    integrate(arm, now, t, h, torque)
    return now.x[:4].copy()


def rhs(load, torque):
    """Right-hand side for scipy."""

    def evaluate(t, x):
        dx = np.empty(4)
        state_derivative(*views(**load), t, x, torque, dx)
        return dx

    return evaluate


def test_dopri5_step_matches_scipys_rk45():
    """The disturbance is evaluated within the step, too."""
    h = 0.05
    rk45 = RK45(rhs(ROUGH, TORQUE), 0.3, INITIAL, 1.0, first_step=h, rtol=1e9, atol=1e9)
    rk45.step()
    assert rk45.t == 0.3 + h
    assert advanced(ROUGH, 0.3, h) == pytest.approx(rk45.y, rel=1e-14)


def torque_of(arm, t, q, dq):
    """The disturbance in plain numpy: friction has the sign of the velocity, and more near rest."""
    load = arm.disturbance
    near_rest = 1.0 + load.stribeck * np.exp(-((dq / load.stribeck_velocity) ** 2))
    friction = load.viscous * dq + load.coulomb * near_rest * np.tanh(dq / load.coulomb_velocity)
    ripple = load.ripple * np.sin(load.ripple_frequency * q)
    sine = load.amplitude * np.sin(load.frequency * t + load.phase)
    return load.constant + sine + friction + ripple


def test_disturbances_of_every_kind_add_up_for_each_joint():
    for changes in (FULL, {'coulomb': (0.3, 0.5)}, {'ripple': 0.1, 'torque_limit': (1.0, 2.0)}):
        arm, now = views(**changes)
        for q, dq in np.random.default_rng(0).normal(size=(10, 2, 2)) * [[1.0], [0.2]]:
            found = np.empty(2)
            disturbing_torque(arm, now, 1.7, np.concatenate((q, dq)), found)
            np.testing.assert_allclose(found, torque_of(arm, 1.7, q, dq), rtol=1e-13)


def test_positive_disturbance_decelerates_the_joint_and_is_in_the_truth():
    """In the equation of motion tau_dist is on the side of M ddq."""
    undisturbed, disturbed = plant(), plant(constant=(0.0, 1.0))
    undisturbed.step(np.zeros(2))
    disturbed.step(np.zeros(2))
    assert disturbed.truth()[-1] < undisturbed.truth()[-1]
    arm = plant(velocity=(0.3, -0.2), **ROUGH)
    for _ in range(100):
        arm.step(TORQUE)
    P, load, q, dq = np.split(arm.truth(), [3, 5, 7])
    assert pytest.approx([1.0, 0.32, 0.4]) == P
    expected = torque_of(views(**ROUGH)[0], 100_000_000 * 1e-9, q, dq)
    np.testing.assert_allclose(load, expected, rtol=1e-13)


@kernel
def compiled_run(arm, settings, state, rng, torques, rows):
    plant, now = plant_views(arm, settings, state)
    for k in range(len(torques)):
        observe(plant, now, rng, rows[k])
        step(plant, now, torques[k])


SOURCES = pytest.mark.parametrize('source', ['measured', 'differenced'])


@SOURCES
@pytest.mark.parametrize('noise', [0.0, 1e-5])
def test_compiled_loop_and_python_calls_are_bit_identical(source, noise):
    changes = FULL | {'sensor.velocity': source, 'position_noise': noise}
    arm, other = (plant(seed=11, **changes) for _ in range(2))
    rows = np.empty((300, 6))
    compiled_run(other.arm, other.settings, other.state, other.rng, commands(300), rows)
    assert (run(arm, commands(300)) == rows).all()
    assert (arm.state == other.state).all()
    assert arm.rng.bit_generator.state == other.rng.bit_generator.state


def test_sample_times_are_whole_nanoseconds():
    """The disturbance is evaluated at t_k = (k T_ns) 1e-9 s, to the last bit."""
    period_ns, x = 333_333, np.array([*START, 0.0, 0.0])
    load = {'amplitude': (1.0, 1.0), 'frequency': (1e6, 1e6)}
    arm = plant(sample_time=period_ns * 1e-9, **load)
    for k, torque in enumerate(commands(100)):
        arm.step(torque)
        x = advanced(load, (k * period_ns) * 1e-9, period_ns * 1e-9, x, torque)
    assert (arm.truth()[5:] == x).all()


@SOURCES
def test_reset_plant_repeats_its_run_and_restored_one_continues_bit_for_bit(source):
    torques = commands(120)
    changes = FULL | {'sensor.velocity': source}
    arm = plant(**changes)
    first = run(arm, torques[:60])
    saved = arm.save()
    expected = run(arm, torques[60:])
    other = plant(seed=99, **changes)
    run(other, torques[:7])
    other.restore(saved)
    assert (run(other, torques[60:]) == expected).all()
    assert (other.state == arm.state).all()
    arm.reset()
    assert arm.sample == 0
    assert (run(arm, torques[:60]) == first).all()
