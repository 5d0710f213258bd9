# SPDX-License-Identifier: Apache-2.0
"""Errata of the paper (doc/errata.md): each shown with the equation as printed, and mended."""

from __future__ import annotations

import numpy as np
import plants
import pytest
from closed_loop_case import (
    JOINTS,
    REFERENCE,
    as_printed,
    closed_loop,
    controller,
    energies,
    plant,
    recommended,
)
from paper_case import P, configured, run
from plain_law import R, dynamics, regressor
from plants import QUIET, START
from symbols import replaced

from blf_dsc_controller import ControllerConfig, StartError
from blf_dsc_controller.law import adaptation, learning
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.law.surface import virtual_control
from blf_dsc_controller.numerics.algebra import cholesky_factor
from blf_dsc_controller.reference.approach import check_takeover


def work_around_a_circle(torque, radius=0.3, centre=(2.0, np.pi / 2.0), points=400):
    """Work [J] of a torque field; the rectangle rule is exact to rounding over a period."""
    phi = np.arange(points) * 2.0 * np.pi / points
    circle = radius * np.column_stack([np.cos(phi), np.sin(phi)])
    power = [torque(centre + at) @ (-at[1], at[0]) for at in circle]
    return np.mean(power) * 2.0 * np.pi


def test_erratum_4_first_gravity_term_has_cos_q1():
    """(34) prints cos q2: a gravity that does work along a closed path."""

    def corrected(q):
        return dynamics(P, R, q, (0.0, 0.0))[2]

    def printed(q):
        outer = P[2] * R * np.cos(q[0] + q[1])
        return np.array([P[0] * R * np.cos(q[1]) + outer, outer])

    assert abs(work_around_a_circle(corrected)) < 1e-12
    # The curl of the printed field is P1 r sin q2, 9.8 N m/rad over a circle of 0.28 rad^2.
    assert abs(work_around_a_circle(printed)) == pytest.approx(2.74, abs=0.01)
    stretched = np.array([0.0, np.pi])
    assert np.abs(printed(stretched) - corrected(stretched)).max() == pytest.approx(
        19.6
    )


def test_erratum_5_start_outside_the_barrier_is_rejected_by_name():
    """Section IV prints q2(0) = 0.1696 rad: 763 times the bound away from the reference."""
    bound, config = 0.002, ControllerConfig(JOINTS)

    def check(q, t=0.0):
        check_takeover(config, np.full(2, bound), q, np.zeros(2), REFERENCE, t)

    check(np.array(START))
    with pytest.raises(StartError):
        check(np.array(START), t=0.2)  # the reference has moved on
    printed = 0.1696 - (1.3961 + 0.3)
    assert abs(printed) / bound == pytest.approx(763.0, abs=0.5)
    for joint, error in ((0, bound), (1, -0.0021), (1, 1.5), (0, np.nan), (1, printed)):
        q = np.array([1.9935, 1.3961]) + 0.3  # the reference at t = 0
        q[joint] += error * (1.0 + 1e-9)
        with pytest.raises(StartError) as caught:
            check(q)
        for part in (JOINTS[joint], f'{error:+.6g} rad', '0.002 rad'):
            assert part in str(caught.value)


def test_erratum_12_linear_virtual_control_crosses_zero_without_a_jump():
    """(18) has slope K/2 + mu there: the filter's gap is at most (lambda + T) times its rate."""
    K = 150.0
    mu = 20.0
    bound = 0.002
    time_constant = 0.002
    T = 1e-3
    errors = 1e-3 * np.sin(10.0 * np.arange(0.0, 2.0, T))
    beta2 = [virtual_control(xi1, bound, K, mu, 0.0) for xi1 in errors]
    gain = filter_gain(time_constant, T)
    alpha2 = beta2[0]
    gap = []
    for target in beta2:
        gap.append(abs(target - alpha2))
        alpha2 += gain * (target - alpha2)
    fastest = (K / 2.0 + mu) * 1e-3 * 10.0
    assert np.abs(np.diff(beta2)).max() <= fastest * T
    assert max(gap) <= (time_constant + T) * fastest
    assert max(gap) < mu * bound


def test_erratum_14_virtual_control_has_no_singularity():
    """At zero it is that of the reference; at the bound and beyond only mu is left."""
    bound = 0.002

    def beta2(xi1, dqr=0.0):
        return virtual_control(xi1, bound, 150.0, 20.0, dqr)

    assert beta2(0.0, -0.3) == -0.3
    for xi1 in (1e-12, -1e-9, 1e-7):  # linear: the next term is 1e-17 at 1e-7 rad
        assert beta2(xi1) == pytest.approx(-95.0 * xi1, rel=1e-14)
    for xi1 in (bound, -1.1 * bound, 10.0 * bound):
        assert beta2(xi1) == -20.0 * xi1


def damping_torque(d2, xi1, xi2):
    """Contribution of d2 to (28), for a law with these errors at its first sample."""
    demands = []
    for gain in (np.zeros(2), d2):
        law = controller(recommended(d2=gain))
        q = np.array([1.9935, 1.3961]) + 0.3 + xi1
        beta2 = [virtual_control(x, 0.002, 150.0, 20.0, 0.0) for x in xi1]
        law.update(0.0, 1e-3, np.concatenate([q, beta2 + xi2, np.zeros(2)]))
        np.testing.assert_allclose(law.signals.xi2, xi2, atol=1e-12)
        demands.append(law.signals.demand.copy())
    return demands[1] - demands[0]


def test_erratum_15_robust_term_dominates_disturbances_bounded_joint_by_joint():
    """With (5) as |tau_dist_i| <= d2_i |xi1_i|; the printed (5) bounds norms, which is weaker."""
    d2, d = np.array([300.0, 200.0]), 300.0
    for random in map(np.random.default_rng, range(3)):
        xi1 = random.uniform(-0.0015, 0.0015, 2)
        # outside the layer b
        xi2 = random.choice([-1.0, 1.0], 2) * random.uniform(0.01, 1.0, 2)
        power = damping_torque(d2, xi1, xi2) @ xi2
        assert power + np.sum(d2 * np.abs(xi1) * np.abs(xi2)) == pytest.approx(
            0.0, abs=1e-10
        )
        of_norms = d * np.linalg.norm(xi1) * np.linalg.norm(xi2)
        # xi3 as printed leaves this power
        assert of_norms > d * np.abs(xi1) @ np.abs(xi2)
        # |xi1| as a norm does not
        assert of_norms <= d * np.linalg.norm(xi1) * np.sum(np.abs(xi2))
    # As printed it vanishes if the errors are on different joints.
    torque = damping_torque(np.full(2, d), np.array([0.001, 0.0]), np.array([0.0, 1.0]))
    np.testing.assert_allclose(torque, 0.0, atol=1e-12)


def rows_of_a_loop(of_law, duration=1.0):
    """Yield X P - u of each sample without disturbances, with the controller that formed it.

    The filter (8) and those of the regressor settle within the first fifth of a second.
    """
    law = of_law(recommended(bias=False))
    arm = plant(constant=QUIET, amplitude=QUIET)
    for sample in closed_loop(law, arm, duration):
        if sample.t > 0.2:
            row = law.signals.row.Xu
            yield row[:, :3] @ P - row[:, 3], law, sample


def test_erratum_6_known_part_of_the_dynamics_is_subtracted():
    """(23): M xi2' + C xi2 is the torque LESS M alpha2' + C alpha2 + G; printed is a plus."""
    corrected, printed = [], []
    for _, law, sample in rows_of_a_loop(as_printed):
        q, dq, torque = sample.measurement.reshape(3, 2)
        xi2 = law.signals.xi2
        observed = law.state.memory[2:]
        M, C, _ = dynamics(P, R, q, dq)
        known = regressor(R, q, dq, dq - xi2, law.signals.dalpha2) @ P
        rest = M @ observed + C @ xi2 - torque
        corrected.append(np.linalg.norm(rest + known))
        printed.append(np.linalg.norm(rest - known))
    assert max(corrected) < 0.05  # N m, the lag of (8)
    assert min(printed) > 5.0


def test_erratum_7_only_filtered_rows_are_exact_with_an_error():
    """Lambda of (24) is a heuristic: its error is of first order in xi2 and xi2'."""
    largest = {
        kind: max(np.abs(residual).max() for residual, _, _ in rows_of_a_loop(kind))
        for kind in (controller, as_printed)
    }
    assert largest[controller] < 1e-4  # N m, of second order in the sample time
    assert largest[as_printed] > 100.0 * largest[controller]


def test_erratum_11_filter_gap_enters_the_error_rate_with_a_minus():
    """(12): xi1' = xi2 + beta2 - (beta2 - alpha2) - alpha1'; printed is a plus."""
    law = controller(recommended())
    off, alpha2 = [], None
    for sample in closed_loop(law, plant(), 0.05):
        signals = law.signals
        if alpha2 is not None:  # the filter's state before this sample
            beta2 = signals.surface.beta2
            gap = beta2 - alpha2
            rate = sample.measurement[2:4] - signals.dqr
            off.append(
                [
                    signals.xi2 + beta2 + sign * gap - law.signals.dqr - rate
                    for sign in (-1, 1)
                ]
            )
        alpha2 = law.state.alpha2.copy()
    corrected, printed = np.abs(off).max(axis=(0, 2))
    assert corrected < 1e-9
    assert printed > 1e-2  # rad/s


def test_erratum_24_varying_disturbance_adds_a_term_to_the_rate_of_the_lyapunov_function():
    """(31) treats tau_dist as constant.

    From d3^' = -gamma xi2 follows (V_d)' = d3~ (xi2 + tau_dist' / gamma), exact for the means.
    """
    gain, T = 5.0, 1e-3
    known = {
        'two_link.initial_estimate': list(P),
        'two_link.adaptation_gain': [0.0] * 3,
    }
    law = known | {'disturbance.gain': [gain, gain]}
    loop = run(configured('recommended', 8.0, law))
    V = loop.lyapunov[:, 3]
    tau_dist = 0.1 + 0.1 * np.sin(loop.t)[:, np.newaxis]
    error = tau_dist - loop.disturbance
    mean = 0.5 * (error[1:] + error[:-1])
    printed = np.sum(mean * loop.xi2[1:], axis=1) * T
    term = np.sum(mean * np.diff(tau_dist, axis=0), axis=1) / gain
    np.testing.assert_allclose(np.diff(V), printed + term, rtol=1e-6, atol=1e-12)
    assert np.abs(term).sum() > 0.1 * np.abs(np.diff(V)).sum()
    whole = loop.lyapunov.sum(axis=1)[1000:]
    assert np.diff(whole).max() > 1e-4 * whole[0]  # V can increase


def test_erratum_16_disturbance_reduces_the_effective_velocity_feedback():
    """(31): with tau_dist = -d1 xi2, as (5) allows, V' contains K_p - d1 I and not K_p.

    The arm starts on its reference with a velocity error xi2; the published energy
    xi2^T M xi2 / 2 is differenced over a hundredth of a millisecond.
    """
    T = 1e-5
    d1 = 15.0
    xi2 = np.array([0.02, -0.05])
    settings = recommended(bias=False, gamma=np.zeros(2), initial_estimate=P)
    law = controller(settings)
    start = law.reference_at(0.0)[0]  # at rest there, so that alpha2 = 0 and xi2 = q'
    arm = plants.plant(sample_time=1e-5, start=start, velocity=xi2)
    energy = []
    for k in range(2):
        law.update(k * T, T, arm.measure())
        energy.append(energies(law, 0.0)[1])
        arm.step(law.signals.torque + d1 * xi2)
    power = np.diff(energy)[0] / T
    assert power == pytest.approx(
        -xi2 @ ((law.settings.feedback.gain - d1) * xi2), rel=0.01
    )
    # the printed rate is twice as fast
    assert power > -0.5 * xi2 @ (law.settings.feedback.gain * xi2)


def test_erratum_1_prediction_error_enters_with_a_minus():
    """(20) prints -Gamma (H^T xi2 + kappa eps): learning then drives P^ to the projection ball."""
    settings = recommended()
    torques = []
    estimates = []
    for sign in (1.0, -1.0):
        law = controller(replaced(settings, kappa=sign * settings.adaptation.weight))
        torques.append(
            [law.signals.torque.copy() for _ in closed_loop(law, plant(), 8.0)]
        )
        estimates.append(law.state.estimate[:3])
    before = round(settings.excitation.learning_start / 1e-3)
    np.testing.assert_array_equal(*(torque[:before] for torque in torques))
    assert np.linalg.norm(estimates[1]) == pytest.approx(settings.adaptation.radius)
    np.testing.assert_allclose(estimates[0], P, atol=0.01)


def test_erratum_2_both_integrals_carry_the_same_factor():
    """(21) lacks the 1/tau_d of (22) and (24): the update then settles at P / tau_d."""
    settings = recommended()
    law = controller(settings)
    list(closed_loop(law, plant(constant=(0.3, -0.2), amplitude=QUIET), 8.0))
    theta = np.array([*P, 0.3, -0.2])
    tau_d = settings.window.length * 1e-3

    def rest_point(Phi):
        latch = law.state.latch
        latch.Phi[:] = Phi
        latch.factor[:] = Phi + settings.window.regularization * np.eye(settings.m)
        cholesky_factor(latch.factor)
        law.signals.xi2[:] = 0.0
        for _ in range(2000):
            learning.adapt_estimate(settings, law.state, law.signals, 1e-3, False)  # noqa: FBT003
        return law.state.estimate.copy()

    np.testing.assert_allclose(rest_point(law.state.latch.Phi.copy()), theta, atol=1e-4)
    np.testing.assert_allclose(
        rest_point(law.state.latch.Phi * tau_d), theta / tau_d, atol=1e-4
    )


def test_erratum_3_integrand_belongs_to_the_integration_variable():
    """(21) prints H_a(t)^T H_a(t), a window of one sample: it has rank n and is never excited."""
    gains = {'bias': False, 'sigma': 1e-6}
    printed = controller(recommended(window=1, **gains))
    corrected = controller(recommended(**gains))
    ranks = set()
    for sample in closed_loop(printed, plant(), 8.0):
        if sample.k > 0 and sample.k % 10 == 0:
            ranks.add(np.linalg.matrix_rank(printed.signals.scratch.window.Phi))
            assert abs(printed.state.latch.lambda_min[0]) < 1e-9
    list(closed_loop(corrected, plant(), 8.0))
    assert max(ranks) == 2
    assert (printed.state.latch.latched[0], corrected.state.latch.latched[0]) == (
        0.0,
        1.0,
    )
    assert corrected.state.latch.lambda_min[0] > 0.1  # over a period of the reference


def test_erratum_8_estimates_drift_if_the_disturbance_estimate_is_subtracted():
    """By (28) tau - d^3 = H P^ up to the errors of tracking, so eps of (24) vanishes for every P^.

    The disturbance is estimated as columns instead.
    """
    errors = []
    for subtract in (True, False):
        law = controller(recommended(bias=not subtract))
        arm = plant()
        for k in range(20_000):
            d3 = law.state.disturbance.copy()  # contained in the next torque
            arm.step(law.update(k * 1e-3, 1e-3, arm.measure()))
            law.state.torque[:] -= d3 * subtract
        errors.append(np.linalg.norm(law.state.estimate[:3] - P) / np.linalg.norm(P))
    assert errors[0] > 0.3
    assert errors[1] < 0.01


def printed_projection(estimate, rate, radius):
    """(4) as printed, with its condition for an unchanged `rate`."""
    norm = np.linalg.norm(estimate)
    if norm < radius or (norm == radius and estimate @ rate <= 0.0):
        return rate
    return rate - estimate * (estimate @ rate) / norm**2


def test_erratum_19_printed_projection_lets_the_estimate_leave_for_good():
    """Ten outward steps cross the sphere; the printed form then blocks inward ones for ever.

    Outside, 'otherwise' removes the radial part of any direction, inward ones included.
    """
    radius, dt = 1.0, 0.1
    printed, corrected = np.array([[0.85, 0.1], [0.85, 0.1]])
    outward = np.array([1.0, 0.3])
    gain = np.ones(2)
    for k in range(1000):
        rate = outward if k < 10 else -printed
        printed = printed + dt * printed_projection(printed, rate, radius)
        rate = outward.copy() if k < 10 else -corrected
        adaptation.project(corrected, rate, gain, radius)
        corrected += dt * rate
        adaptation.retract(corrected, gain, radius)
        assert np.linalg.norm(corrected) <= radius * (1.0 + 1e-15)
    assert np.linalg.norm(printed) > 1.01 * radius
    assert np.linalg.norm(corrected) < 1e-6


def test_erratum_23_reference_excites_every_parameter_but_the_second_weakly():
    """Over a period of exact tracking, lambda_min of the mean of H^T H is 0.269."""
    law = controller(recommended())
    Phi = np.zeros((3, 3))
    for t in np.arange(1000) * 2.0 * np.pi / 1000:
        q, dq, ddq = law.reference_at(t)
        H = regressor(R, q, dq, dq, ddq)
        Phi += H.T @ H / 1000
    values, vectors = np.linalg.eigh(Phi)
    assert values[0] == pytest.approx(0.269, abs=5e-4)
    assert abs(vectors[1, 0]) > 0.9
