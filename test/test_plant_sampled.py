# SPDX-License-Identifier: Apache-2.0
"""The sampled plant: its integrator against scipy, disturbances, and repeatable runs."""

import numpy as np
import pytest
from plants import PERIOD, START, commands, disturbance, full_plant, motion, plant, run
from plants import rough_disturbance as rough
from scipy.integrate import RK45, solve_ivp

from blf_dsc_controller.compiled.jit import kernel
from sim_plant.kernels import draw_noise, observe, plant_views, step
from sim_plant.motion import Stages, disturbance_torque, integrate, state_derivative
from sim_plant.sensors import DIFFERENCED, MEASURED

STAGES = Stages(np.empty(4), np.empty((6, 4)))
INITIAL = np.array([*START, 0.5, -1.0])
TORQUE = np.array([-6.0, -2.0])


def advanced(load, t, h, x=INITIAL, torque=TORQUE):
    """State after a step of h seconds."""
    x = np.array(x)
    integrate(motion(load=load), t, h, torque, x, STAGES)
    return x


def rhs(load, torque):
    """Right-hand side for scipy."""

    def evaluate(t, x):
        dx = np.empty(4)
        state_derivative(motion(load=load), t, x, torque, dx)
        return dx

    return evaluate


def test_dopri5_step_matches_scipys_rk45():
    """The disturbance is evaluated within the step, too."""
    load, h = rough(), 0.05
    rk45 = RK45(rhs(load, TORQUE), 0.3, INITIAL, 1.0, first_step=h, rtol=1e9, atol=1e9)
    rk45.step()
    assert rk45.t == 0.3 + h
    assert advanced(load, 0.3, h) == pytest.approx(rk45.y, rel=1e-14)


def test_motion_under_sampled_torques_matches_dop853():
    found = expected = INITIAL
    for t, torque in zip(np.arange(100) * PERIOD, commands(100), strict=True):
        found = advanced(rough(), t, PERIOD, found, torque)
        accurate = {'method': 'DOP853', 'rtol': 1e-13, 'atol': 1e-14}
        expected = solve_ivp(rhs(rough(), torque), (t, t + PERIOD), expected, **accurate).y[:, -1]
    # 100 steps with scipy's tolerance of 1e-13 each
    assert found == pytest.approx(expected, abs=1e-11)


def torque_of(load, t, q, dq):
    """The disturbance in plain numpy: friction has the sign of the velocity, and more near rest."""
    near_rest = 1.0 + load.stribeck * np.exp(-((dq / load.stribeck_velocity) ** 2))
    friction = load.viscous * dq + load.coulomb * near_rest * np.tanh(dq / load.coulomb_velocity)
    ripple = load.ripple * np.sin(load.ripple_frequency * q)
    return (
        load.constant + load.amplitude * np.sin(load.frequency * t + load.phase) + friction + ripple
    )


def test_disturbances_of_every_kind_add_up_for_each_joint():
    for load in (rough(), disturbance(coulomb=[0.3, 0.5]), disturbance(ripple=0.2)):
        for q, dq in np.random.default_rng(0).normal(size=(10, 2, 2)) * [[1.0], [0.2]]:
            found = np.empty(2)
            disturbance_torque(motion(load=load), 1.7, q, dq, found)
            np.testing.assert_allclose(found, torque_of(load, 1.7, q, dq), rtol=1e-13)


def test_positive_disturbance_decelerates_the_joint_and_is_in_the_truth():
    """In the equation of motion tau_dist is on the side of M ddq."""
    undisturbed, disturbed = plant(), plant(load=disturbance(constant=[0.0, 1.0]))
    undisturbed.step(np.zeros(2))
    disturbed.step(np.zeros(2))
    assert disturbed.truth()[-1] < undisturbed.truth()[-1]
    arm = plant(load=rough(), velocity=(0.3, -0.2))
    for _ in range(100):
        arm.step(TORQUE)
    P, load, q, dq = np.split(arm.truth(), [3, 5, 7])
    assert pytest.approx([1.0, 0.32, 0.4]) == P
    np.testing.assert_allclose(load, torque_of(rough(), 100_000_000 * 1e-9, q, dq), rtol=1e-13)


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
    period_ns, x = 333_333, np.array([*START, 0.0, 0.0])
    load = disturbance(amplitude=1.0, frequency=1e6)
    arm = plant(load=load, period_ns=period_ns)
    for k, torque in enumerate(commands(100)):
        arm.step(torque)
        x = advanced(load, (k * period_ns) * 1e-9, period_ns * 1e-9, x, torque)
    assert (arm.truth()[5:] == x).all()


@pytest.mark.parametrize('source', [MEASURED, DIFFERENCED])
def test_reset_plant_repeats_its_run_and_restored_one_continues_bit_for_bit(source):
    torques = commands(120)
    arm = full_plant(velocity_source=source)
    first = run(arm, torques[:60])
    saved = arm.save()
    expected = run(arm, torques[60:])
    other = full_plant(velocity_source=source, seed=99)
    run(other, torques[:7])
    other.restore(saved)
    assert (run(other, torques[60:]) == expected).all()
    assert (other.state == arm.state).all()
    arm.reset()
    assert arm.sample == 0
    assert (run(arm, torques[:60]) == first).all()


def test_arm_stopped_for_excessive_speed_stays_stopped_when_restored():
    arm = plant()
    run(arm, np.full((300, 2), 9e3))
    assert arm.is_broken
    before, saved = arm.measure().copy(), arm.save()
    arm.reset()
    assert not arm.is_broken
    arm.restore(saved)
    after = run(arm, np.full((3, 2), 9e3))
    np.testing.assert_array_equal(after[-1, :2], before[:2])
    assert not after[-1, 2:4].any()
