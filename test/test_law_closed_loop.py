# SPDX-License-Identifier: Apache-2.0
"""The controller: tracking, handover, limit of continuous time, (29); its state and its laws."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import (
    REFERENCE,
    as_printed,
    closed_loop,
    controller,
    energies,
    plant,
    quick,
    recommended,
)
from paper_case import BOUND, NO_DISTURBANCE, P, configured, run_preset
from plain_law import PlainLaw, R, dynamics, regressor
from plants import QUIET, START
from scipy.integrate import solve_ivp

from blf_dsc_controller import controller_of, read_run, simulate
from blf_dsc_controller.analysis.lyapunov import energies as offline_energies
from blf_dsc_controller.numerics.algebra import cholesky_factor
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.simulation.loop import write_bag


def test_recommended_loop_keeps_half_the_bound_and_finds_the_parameters():
    loop = run_preset(60.0)
    assert np.abs(loop.xi1).max() < 0.5 * BOUND
    assert np.abs(loop.torque).max() < recommended().torque.limit.min()
    assert loop.parameter_error[0] == pytest.approx(0.5, abs=0.01)  # P^(0) = P / 2
    assert loop.parameter_error[loop.t >= 15.0].max() < 0.01
    assert loop.parameter_error[-1] < 5e-4
    # A window of one period averages the sine of 0.1 + 0.1 sin t [N m] to zero.
    np.testing.assert_allclose(loop.estimate[-1, 3:], 0.1, atol=0.01)


def power_of_the_initial_model(law, q, dq):
    """xi2^T (H - H_r) (P^(0) - P) [W]: what the feedback's model lacks, away from the reference."""
    s = law.signals
    H = regressor(R, q, dq, dq - s.xi2, s.dalpha2)
    return s.xi2 @ (H - s.H[:, :3]) @ (law.settings.initial_estimate[:3] - P)


@pytest.mark.parametrize('of_law', [controller, as_printed])
def test_lyapunov_function_decreases_from_sample_to_sample(of_law):
    """(31), (32) without a disturbance, as long as nothing is learned from a window.

    With compensation along the reference V may rise by no more than the power of the
    initial model.
    """
    along = of_law is controller
    law = of_law(recommended(bias=False, gamma=np.full(2, 1.0)))
    V, power = [], []
    for sample in closed_loop(law, plant(constant=QUIET, amplitude=QUIET), 6.5):
        off = law.sample.disturbance
        V.append(energies(law, sample.t)[:3].sum() + 0.5 * off @ off)
        lacking = power_of_the_initial_model(law, *sample.measurement.reshape(3, 2)[:2])
        power.append(lacking if along else 0.0)
    V, power = np.array(V), np.array(power)
    assert (np.abs(power).max() > 1e-3) == along
    # A sampled loop may ripple where V' is close to zero: by a millionth of the initial V.
    assert np.max(np.diff(V) - 1e-3 * power[1:]) < 1e-6 * V[0]
    assert V[6000] < 0.5 * V[0]


END = 0.5
RHO = 1e-5
KAPPA = 20.0
PHI = np.array([[60.0, 5.0, 20.0], [5.0, 1.0, 2.0], [20.0, 2.0, 9.0]])
TIMES = np.linspace(0.0, END, 11)


def derivative(t, y, plain):
    """The whole loop: arm (1), filter (13), law (28), learning (20) from a latched window, (30)."""
    g = plain.gains
    q, dq, alpha2, estimate, d3 = np.split(y, [2, 4, 6, 9])
    ((qr, dqr, ddqr),) = sampled(REFERENCE, np.array([t]))
    xi1, xi2 = q - qr, dq - alpha2
    dalpha2 = (plain.virtual_control(xi1, dqr, t) - alpha2) / g.time_constant
    H = regressor(R, q, dq, alpha2, dalpha2)
    H_r = regressor(R, qr, dqr, dqr, ddqr)
    P0 = 0.5 * P
    torque = (
        H @ P0 + H_r @ (estimate - P0) + d3 - g.Kp * xi2 + plain.barrier_torque(xi1, t)
    )
    M, C, G = dynamics(P, R, q, dq)
    ddq = np.linalg.solve(M, torque - C @ dq - G - 0.1 - 0.1 * np.sin(t))
    eps = np.linalg.solve(PHI + RHO * np.eye(3), PHI @ (P - estimate))
    learned = g.Gamma * KAPPA * eps
    update = learned - g.Gamma * (H_r.T @ xi2)
    return np.concatenate([dq, ddq, dalpha2, update, -g.gamma * xi2 - H_r @ learned])


def continuous(settings):
    """Positions and P^ at TIMES, to a tolerance far below the sampling error."""
    plain, start = PlainLaw(settings), np.array(START)
    ((qr, dqr, _),) = sampled(REFERENCE, np.zeros(1))
    alpha2 = plain.virtual_control(start - qr, dqr, 0.0)
    y = np.concatenate([start, np.zeros(2), alpha2, 0.5 * P, np.zeros(2)])
    tolerance = {'method': 'LSODA', 'rtol': 1e-10, 'atol': 1e-13}
    solution = solve_ivp(
        derivative, (0.0, END), y, t_eval=TIMES, args=(plain,), **tolerance
    )
    assert solution.success
    return solution.y[[0, 1, 6, 7, 8]]


def of_samples(dt, settings):
    """The same for the sampled loop with the package's own kernels."""
    law = controller(settings)
    arm = plant(sample_time=dt)
    law.state.latch.latched[0] = 1.0
    law.state.latch.Phi[:], law.state.latch.b[:] = PHI, PHI @ P
    law.state.latch.factor[:] = PHI + RHO * np.eye(3)
    cholesky_factor(law.state.latch.factor)
    stride = round(END / dt / (TIMES.size - 1))
    found, estimate = [], law.state.estimate.copy()
    for sample in closed_loop(law, arm, END + dt):
        if sample.k % stride == 0:
            found.append(np.append(sample.measurement[:2], estimate))
        estimate = law.state.estimate.copy()
    return np.transpose(found)


def test_sampled_loop_converges_to_the_continuous_one_at_first_order():
    """Halve the sample time three times; held torque and Euler adaptation are of first order."""
    learning = {
        'Gamma': np.full(3, 0.5),
        'kappa': KAPPA,
        'learning_start': 1e9,
        'window': 10,
    }
    settings = recommended(bias=False, **learning)
    exact = continuous(settings)
    steps = (1e-3, 5e-4, 2.5e-4, 1.25e-4)
    errors = np.array(
        [np.abs(of_samples(dt, settings) - exact).max(axis=1) for dt in steps]
    )
    # positions, estimates
    errors = np.column_stack((errors[:, :2].max(1), errors[:, 2:].max(1)))
    order = np.log2(errors[:-1] / errors[1:])
    assert np.all(order > 0.9), (errors, order)
    assert np.all(errors[-1] < 0.15 * errors[0])


NOISY = {'position_noise': 1e-5, 'sensor.velocity': 'differenced', 'delay': 2}


def test_law_continues_bit_for_bit_from_a_saved_state_and_begins_anew_after_a_reset():
    """The state vector is the complete state, so another controller can continue from it too."""
    law, arm = controller(quick()), plant(**NOISY)
    measured = []
    for k in range(2000):
        measured.append(arm.measure().copy())
        if k == 1337:
            saved = law.save()
        arm.step(law.update(k * 1e-3, 1e-3, measured[k]))

    def torques(law, first, last):
        return [
            law.update(k * 1e-3, 1e-3, measured[k]).copy() for k in range(first, last)
        ]

    assert np.any(saved != law.state_vector)
    law.reset()
    start = torques(law, 0, 1337)
    np.testing.assert_array_equal(law.state_vector, saved)
    after = torques(law, 1337, 2000)
    other = controller(quick())
    for same in (law, other):
        same.restore(saved)
        np.testing.assert_array_equal(torques(same, 1337, 2000), after)
    law.reset()
    np.testing.assert_array_equal(torques(law, 0, 1337), start)


FROZEN = {
    'two_link.initial_estimate': list(P),
    'two_link.adaptation_gain': [0.0] * 3,
    'disturbance.gain': [0.0] * 2,
}


def test_proposed_law_with_everything_known_and_frozen_equals_model_based():
    known = FROZEN | {'law': 'model_based'}
    frozen, model_based = (
        run_preset(10.0, NO_DISTURBANCE, law=law) for law in (FROZEN, known)
    )
    np.testing.assert_allclose(frozen.torque, model_based.torque, atol=1e-12)
    np.testing.assert_allclose(frozen.xi1, model_based.xi1, atol=1e-15)


def of_linear_surface(law, gains):
    """Return the first torque of a law (2,), and H P^(0) - K_p z2 with its surface."""
    config = configured('recommended', 1.0, {'law': law} | gains).controller
    controller = controller_of(config)
    qr, dqr, ddqr = controller.reference_at(0.0)
    z1, rate = np.array([1e-3, -2e-3]), np.array([0.03, 0.01])
    q, dq = qr + z1, dqr + rate
    controller.update(0.0, 1e-3, np.concatenate((q, dq, np.zeros(2))))
    surface = gains['gains.surface_gain']
    alpha2, dalpha2 = dqr - surface * z1, ddqr - surface * rate
    z2 = dq - alpha2
    H = regressor(R, q, dq, alpha2, dalpha2)
    usual = H @ config.two_link.initial_estimate - config.two_link.feedback_gain * z2
    return controller.signals.demand, usual, z1, z2


def test_torque_of_the_comparison_laws_is_that_of_their_equations():
    found, usual, z1, z2 = of_linear_surface('slotine_li', {'gains.surface_gain': 60.0})
    np.testing.assert_allclose(found, usual, rtol=1e-12)
    gains = {'position_gain': 30.0, 'robust_gain': 0.4, 'surface_gain': 60.0}
    named = {f'gains.{name}': value for name, value in gains.items()}
    found, usual, z1, z2 = of_linear_surface('backstepping', named)
    expected = usual - 30.0 * z1 - 0.4 * np.clip(z2 / 0.01, -1.0, 1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ('gain', 'mu', 'weight'),
    [(150.0, 20.0, 1000.0), (60.0, 60.0, 1.0), (0.0, 40.0, 500.0)],
)
def test_error_of_the_oracle_is_the_lag_of_the_surface_filter(gain, mu, weight):
    """The model-based law knows the disturbance, but alpha2 lags beta2 by lambda alpha2'.

    xi1 compensates it by (K/2 + mu) xi1 in beta2, and by w xi1 = -K_p xi2 in the torque.  The
    reference's acceleration is 0.3 rad/s^2; the held torque adds half a sample to the lag.
    """
    gains = {
        'two_link.surface_gain': gain,
        'two_link.mu': mu,
        'two_link.barrier_weight': weight,
    }
    changes = {name: [value] * 2 for name, value in gains.items()}
    loop = run_preset(8.0, preset='model_based', law=changes)
    rate = gain / 2.0 + mu + weight / np.array([60.0, 20.0])
    expected = (0.002 + 0.5e-3) * 0.3 / rate
    np.testing.assert_allclose(loop.largest(1.0), expected, rtol=0.05)


def test_lyapunov_function_of_the_oracle_decreases_to_the_floor_of_the_lag():
    """(17): V decreases in every sample until only the barrier's energy of the lag remains."""
    loop = run_preset(8.0, preset='model_based')
    V = loop.lyapunov.sum(axis=1)
    # J, twice the energy
    lag = 1000.0 * np.sum(loop.xi1[loop.t >= 1.0] ** 2, axis=1).max()
    above = np.flatnonzero(10.0 * lag < V)
    assert above[-1] > 50  # there is a decrease to check
    assert np.all(np.diff(V[: above[-1] + 2]) < 0.0)
    assert V[0] > 1e4 * V[loop.t >= 1.0].max()


def test_terms_of_equation_29_follow_from_what_a_bag_holds(tmp_path):
    """Those of a simulated run, and of its bag where this has the truth."""
    loop = configured('paper', 0.5)
    record = simulate(loop.controller, loop.plant)
    run = record.run()
    found = offline_energies(run)
    gains = loop.controller.two_link.adaptation_gain, loop.controller.disturbance.gain
    k = 250
    xi1, xi2 = run.error[k], run.xi2[k]
    M, _, _ = dynamics(P, R, run.position[k], run.velocity[k])
    s = np.pi * xi1**2 / (2.0 * BOUND**2)
    off = P - run.monitor.values[k, :3]
    tau_dist = 0.1 + 0.1 * np.sin(run.time[k])
    missed = tau_dist - record.sample(k).disturbance
    expected = (
        np.sum(BOUND**2 / np.pi * np.tan(s)),
        0.5 * xi2 @ M @ xi2,
        0.5 * np.sum(off**2 / gains[0]),
        0.5 * np.sum(missed**2 / gains[1]),
    )
    np.testing.assert_allclose(found.values[k], expected, rtol=1e-9)
    write_bag(tmp_path / 'bag', record, loop.plant)
    recorded = offline_energies(read_run(tmp_path / 'bag'))
    rows = np.searchsorted(found.stamp, recorded.stamp - recorded.stamp[0])
    assert len(rows) > 5
    np.testing.assert_allclose(recorded.values, found.values[rows], rtol=1e-9)


@pytest.mark.parametrize('law', ['backstepping', 'slotine_li'])
def test_equation_29_is_of_laws_with_the_barrier_alone(law):
    loop = configured('recommended', 0.01, {'law': law})
    assert offline_energies(simulate(loop.controller, loop.plant).run()) is None
