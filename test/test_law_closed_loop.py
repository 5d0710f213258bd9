# SPDX-License-Identifier: Apache-2.0
"""The law in closed loops: start, tracking, handover, the limit of continuous time, and (29)."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from changes import run
from closed_loop_case import (
    JOINTS,
    START,
    P,
    R,
    closed_loop,
    controller,
    plant,
    recommended,
    recommended_minute,
    record,
)
from paper_case import EXACT, configured
from plain_law import dynamics
from scipy.integrate import solve_ivp

from blf_dsc_controller.compiled import cholesky
from blf_dsc_controller.errors import OutsideBarrierError
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import controller_of
from blf_dsc_controller.law.settings import COMPENSATIONS
from blf_dsc_controller.simulation.loop import simulate

BOUND = 2e-3  # rad


def test_recommended_loop_keeps_half_the_bound_and_finds_the_parameters():
    run = recommended_minute()
    assert np.abs(run.xi1).max() < 0.5 * BOUND
    assert np.abs(run.torque).max() < recommended().torque_limit.min()
    assert run.parameter_error[0] == pytest.approx(0.5, abs=0.01)  # P^(0) = P / 2
    assert run.parameter_error[run.t >= 15.0].max() < 0.01
    assert run.parameter_error[-1] < 0.005
    # A window of one period averages the sine of 0.1 + 0.1 sin t [N m] to zero.
    np.testing.assert_allclose(run.estimate[-1, 3:], 0.1, atol=0.01)


def test_noise_differenced_velocity_and_delay_are_tolerated():
    """Encoder noise of 1e-5 rad, differenced velocities and a torque one sample late, together."""
    run = record(controller(recommended()), plant(noise=1e-5, differenced=True, delay=1), 60.0)
    assert np.abs(run.xi1).max() < BOUND
    assert run.parameter_error[-1] < 0.01


def test_arm_beyond_its_bound_comes_back():
    """There the paper's law is not defined; the barrier continues as a straight line."""
    law = controller(recommended())
    arm = plant(start=(2.2935 + 0.004, 1.6961 - 0.004))
    run = record(law, arm, 1.0)

    assert np.abs(run.xi1[0]).min() > 1.9 * BOUND
    assert np.abs(run.xi1[run.t > 0.1]).max() < 0.5 * BOUND


def lyapunov_function(law, measurement):
    """V [J] of (29) without a disturbance: barrier, xi2, P~ and d^3."""
    settings, xi2 = law.settings, law.signals.xi2
    joints = zip(
        law.signals.xi1,
        settings.bound,
        settings.weight,
        settings.slope_limit,
        settings.knee,
        strict=True,
    )
    M, _, _ = dynamics(P, R, measurement[:2], measurement[2:4])
    error = law.state.estimate[:3] - P
    return (
        sum(barrier.potential(*joint) for joint in joints)
        + 0.5 * xi2 @ M @ xi2
        + 0.5 * error @ (error / settings.Gamma[:3])
        + 0.5 * np.sum(law.state.disturbance**2 / settings.gamma)
    )


def power_of_the_initial_model(law, q, dq):
    """xi2^T (H - H_r) (P^(0) - P) [W]: what the feedback's model lacks, away from the reference."""
    s, n = law.signals, 2
    H = np.zeros((n, 3))
    law.settings.model.regressor(q, dq, dq - s.xi2, s.dalpha2, H)
    return s.xi2 @ (H - s.H[:, :3]) @ (law.settings.initial_estimate[:3] - P)


@pytest.mark.parametrize('compensation', COMPENSATIONS)
@pytest.mark.parametrize('kappa', [0.0, 100.0], ids=['tracking alone', 'learning too'])
def test_lyapunov_function_decreases_from_sample_to_sample(kappa, compensation):
    """(31), (32) without a disturbance; before the latch at 6.8 s both cases are the same.

    With compensation along the reference V may rise by no more than the power of the initial model.
    """
    form = COMPENSATIONS.index(compensation)
    gains = {'kappa': kappa, 'gamma': np.full(2, 1.0), 'compensation': form}
    law = controller(recommended(bias=False, bumpless=0, **gains))
    arm = plant(constant=(0.0, 0.0), amplitude=(0.0, 0.0))
    V, power = [], []
    for sample in closed_loop(law, arm, 10.0):
        V.append(lyapunov_function(law, sample.measurement))
        power.append(power_of_the_initial_model(law, *sample.measurement.reshape(3, 2)[:2]))
    V, power = np.array(V), np.array(power)

    assert (np.abs(power).max() > 1e-3) == (compensation == 'reference')
    # A sampled loop may ripple where V' is close to zero: by a millionth of the initial V.
    assert np.max(np.diff(V) - 1e-3 * power[1:]) < 1e-6 * V[0]
    assert V[6000] < 0.5 * V[0]
    if kappa > 0.0:
        assert V[-1] < 0.1 * V[6000]


END = 0.5  # s
K, MU, LAMBDA, KP, W, KC = 150.0, 20.0, 0.002, np.array([60.0, 20.0]), 1000.0, 0.002
GAMMA, GAMMA3, KAPPA, RHO = 0.5, 100.0, 20.0, 1e-5
PHI = np.array([[60.0, 5.0, 20.0], [5.0, 1.0, 2.0], [20.0, 2.0, 9.0]])
TIMES = np.linspace(0.0, END, 11)


def reference(t):
    """qr of Section IV and its derivatives."""
    qr = np.array([1.9935, 1.3961]) + 0.3 * np.cos(t)
    return np.array([qr, [-0.3 * np.sin(t)] * 2, [-0.3 * np.cos(t)] * 2])


def surface(xi1, dqr):
    """beta2 of (18) with (15)."""
    s = np.pi * xi1**2 / (2.0 * KC**2)
    return -K * KC**2 / (np.pi * xi1) * np.sin(s) * np.cos(s) - MU * xi1 + dqr


def regressor(q, dq, v, a):
    """H(q, dq, v, a)."""
    parts = [dynamics(e, R, q, dq) for e in np.eye(3)]
    return np.column_stack([M @ a + C @ v + G for M, C, G in parts])


def derivative(t, y):
    """The whole loop: arm (1), filter (13), law (28), learning (20) from a latched window, (30)."""
    q, dq, alpha2, estimate, d3 = np.split(y, [2, 4, 6, 9])
    qr, dqr, ddqr = reference(t)
    xi1, xi2 = q - qr, dq - alpha2
    dalpha2 = (surface(xi1, dqr) - alpha2) / LAMBDA
    H, H_r = regressor(q, dq, alpha2, dalpha2), regressor(qr, dqr, dqr, ddqr)
    barrier = W * xi1 / np.cos(np.pi * xi1**2 / (2.0 * KC**2)) ** 2
    P0 = 0.5 * P
    torque = H @ P0 + H_r @ (estimate - P0) + d3 - KP * xi2 - barrier
    M, C, G = dynamics(P, R, q, dq)
    ddq = np.linalg.solve(M, torque - C @ dq - G - 0.1 - 0.1 * np.sin(t))
    eps = np.linalg.solve(PHI + RHO * np.eye(3), PHI @ (P - estimate))
    learned = GAMMA * KAPPA * eps
    update = learned - GAMMA * H_r.T @ xi2
    return np.concatenate([dq, ddq, dalpha2, update, -GAMMA3 * xi2 - H_r @ learned])


@cache
def continuous():
    """Positions and P^ at TIMES, to a tolerance far below the sampling error."""
    start = np.array([2.293, 1.696])
    qr, dqr, _ = reference(0.0)
    alpha2 = surface(start - qr, dqr)
    y = np.concatenate([start, np.zeros(2), alpha2, 0.5 * P, np.zeros(2)])
    solution = solve_ivp(
        derivative, (0.0, END), y, method='LSODA', rtol=1e-10, atol=1e-13, t_eval=TIMES
    )
    assert solution.success
    return solution.y[[0, 1, 6, 7, 8]]


def sampled(dt):
    """The same for the sampled loop with the package's own kernels."""
    settings = recommended(
        bias=False, Gamma=np.full(3, GAMMA), kappa=KAPPA, learning_start=1e9, window=10
    )
    law: Controller = controller(settings)
    law.state.latched[0] = 1.0
    law.state.Phi[:] = PHI
    law.state.b[:] = PHI @ P
    law.state.factor[:] = PHI + RHO * np.eye(3)
    cholesky.factor(law.state.factor)
    arm = plant(sample_time=dt)
    found = []
    stride = round(END / dt / (TIMES.size - 1))
    for k in range(stride * (TIMES.size - 1) + 1):
        measurement = arm.measure()
        if k % stride == 0:
            found.append(np.append(measurement[:2], law.state.estimate[:3]))
        law.update(k * dt, dt, measurement)
        arm.step(law.signals.torque)
    return np.transpose(found)


def test_sampled_loop_converges_to_the_continuous_one_at_first_order():
    """Halve the sample time three times; held torque and Euler adaptation are of first order."""
    exact = continuous()
    steps = (1e-3, 5e-4, 2.5e-4, 1.25e-4)
    errors = np.array([np.abs(sampled(dt) - exact).max(axis=1) for dt in steps])
    errors = np.column_stack((errors[:, :2].max(1), errors[:, 2:].max(1)))  # positions, estimates
    order = np.log2(errors[:-1] / errors[1:])
    assert np.all(order > 0.9), (errors, order)
    assert np.all(errors[-1] < 0.15 * errors[0])


LATCH = 6.79  # s
FRICTION = {'disturbance.viscous': [0.3, 0.2], 'disturbance.coulomb': [0.5, 0.3]}
COLUMNS = {'learning.viscous': True, 'learning.coulomb': True}


def test_first_latch_disturbs_neither_the_tracking_nor_the_disturbance_estimate():
    """The estimate steps by half of P; without the handover the error reaches 0.42 mrad."""
    end = LATCH + 1.0
    true = 0.1 + 0.1 * np.sin(end)  # N m
    bumpless, paper = (run(end, law={'learning.bumpless': choice}) for choice in (True, False))
    off, late = (
        np.abs(loop.controller.state.disturbance - true).max() for loop in (bumpless, paper)
    )
    assert bumpless.parameter_error[np.searchsorted(bumpless.t, LATCH - 0.1)] > 0.1
    assert bumpless.parameter_error[-1] < 1e-3
    assert bumpless.largest(LATCH).max() < 0.02e-3
    assert paper.largest(LATCH).max() > 0.4e-3
    assert off < 0.02
    assert late > 0.1


@pytest.mark.parametrize(('preset', 'bound'), [('recommended', 0.01e-3), ('noisy', 0.05e-3)])
def test_learned_friction_is_compensated(preset, bound):
    with_columns = run(30.0, preset=preset, plant=FRICTION, law=COLUMNS)
    without = run(30.0, preset=preset, plant=FRICTION)

    assert with_columns.largest(15.0).max() < bound
    assert without.largest(15.0).max() > 3.0 * bound


def test_disturbance_in_telemetry_includes_friction():
    config = configured('recommended', 30.0, COLUMNS, FRICTION)
    found = simulate(config.controller, config.plant).run()
    disturbance = [f'disturbance {joint}' for joint in found.joints]
    estimated = found.learning.select(disturbance)[found.learning.stamp >= 20e9]
    true = found.truth.select(disturbance)[found.truth.stamp >= 20e9]

    moving = np.abs(found.velocity[found.stamp >= 20e9]).min(axis=1) > 0.1
    assert np.abs(true[moving]).max() > 0.5  # more than the 0.2 N m without friction
    np.testing.assert_allclose(estimated[moving], true[moving], atol=0.02)


def test_start_outside_the_barrier_is_rejected_by_name():
    law = controller(recommended())
    law.check_start(JOINTS, np.array(START))
    with pytest.raises(OutsideBarrierError):
        law.check_start(JOINTS, np.array(START), t=0.2)  # the reference has moved on
    for joint, error in ((0, 0.002), (1, -0.0021), (1, 1.5), (0, np.nan)):
        q = np.array([1.9935, 1.3961]) + 0.3  # the reference at t = 0
        q[joint] += error * (1.0 + 1e-9)
        with pytest.raises(OutsideBarrierError) as caught:
            law.check_start(JOINTS, q)
        assert (caught.value.joint, caught.value.bound) == (JOINTS[joint], 0.002)
        assert caught.value.error == pytest.approx(error, rel=1e-6, nan_ok=True)
        for part in (JOINTS[joint], f'{error:+.6g} rad', '0.002 rad'):
            assert part in str(caught.value)


GAINS = {
    'learning.adaptation_gain': [0.5, 2.0, 1.5],
    'disturbance.gain': [40.0, 10.0],
    'barrier.weight': [800.0, 300.0],
    'comparison.position_gain': [25.0, 9.0],
    'truth.phase': [0.0, 0.4],
}


def samples(law, **changes):
    """Yield time, controller and measurement of 300 samples."""
    controller = controller_of(configured('recommended', 1.0, EXACT | {'law': law} | changes)[1])
    arm = plant()
    for k in range(300):
        measurement = arm.measure().copy()
        controller.update(k * 1e-3, 1e-3, measurement)
        yield k * 1e-3, controller, measurement
        arm.step(controller.signals.torque)


@pytest.mark.parametrize('law', ['blf_dsc', 'backstepping'])
def test_terms_are_those_of_equation_29(law):
    Gamma, gamma = np.array([0.5, 2.0, 1.5]), np.array([40.0, 10.0])
    w = np.array([800.0, 300.0] if law == 'blf_dsc' else [25.0, 9.0])
    for t, running, measurement in samples(law, **GAINS):
        sample = running.sample
        xi1, xi2 = sample.xi1, sample.xi2
        M, _, _ = dynamics(P, 9.8, measurement[:2], measurement[2:4])
        tau_dist = 0.1 + 0.1 * np.sin(t + np.array([0.0, 0.4]))
        if law == 'blf_dsc':
            error = np.sum(w * 0.002**2 / np.pi * np.tan(np.pi * xi1**2 / (2.0 * 0.002**2)))
            disturbance = 0.5 * np.sum((tau_dist - sample.disturbance) ** 2 / gamma)
        else:
            error, disturbance = 0.5 * np.sum(w * xi1**2), 0.0  # (35) has no d^3
        expected = (
            error,
            0.5 * xi2 @ M @ xi2,
            0.5 * np.sum((P - sample.estimate[:3]) ** 2 / Gamma),
            disturbance,
        )
        np.testing.assert_allclose(sample.lyapunov, expected, rtol=1e-11, atol=1e-18)


def test_energies_of_estimates_that_are_not_adapted_or_unknown_do_not_count():
    frozen = {'learning.adaptation_gain': [0.0, 1.0, 0.0], 'disturbance.gain': [0.0, 50.0]}
    for t, running, _ in samples('blf_dsc', **frozen):
        sample = running.sample
        off = 0.1 + 0.1 * np.sin(t) - sample.disturbance[1]
        np.testing.assert_allclose(sample.lyapunov[2], 0.5 * (P[1] - sample.estimate[1]) ** 2)
        np.testing.assert_allclose(sample.lyapunov[3], 0.5 * off**2 / 50.0, rtol=1e-11)
    for _, running, _ in samples('blf_dsc', **{'truth.parameters': []}):
        assert running.sample.lyapunov[0] >= 0.0
        assert np.all(np.isnan(running.sample.lyapunov[1:]))
