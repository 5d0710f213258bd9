# SPDX-License-Identifier: Apache-2.0
"""The tan barrier, the bound that narrows, and the virtual control with its filter."""

from __future__ import annotations

from cmath import cos as complex_cos
from cmath import tan as complex_tan
from functools import partial
from math import cos, exp, pi, sin

import numpy as np
import pytest
from arbitrary_case import arbitrary
from closed_loop_case import REFERENCE, P, R, closed_loop, controller, plant, recommended
from plain_law import dynamics

from blf_dsc_controller.law import barrier, surface
from blf_dsc_controller.reference import terms as reference

BOUND, WEIGHT, LIMIT = 0.002, 1000.0, 2e4
KNEE = barrier.knee(BOUND, WEIGHT, LIMIT)
INSIDE = np.linspace(0.01, 0.99, 25) * KNEE
PAST = KNEE + np.linspace(0.01, 3.0, 25) * BOUND
RECOMMENDED = (BOUND, WEIGHT, LIMIT, KNEE)


def printed_potential(xi, bound):
    """Equation (3); takes complex xi."""
    return bound**2 / pi * complex_tan(pi * xi * xi / (2.0 * bound**2))


def printed_torque(xi, bound):
    """The entries of -tau_c below (16); takes complex xi."""
    return xi / complex_cos(pi * xi * xi / (2.0 * bound**2)) ** 2


def complex_step(function, xi):
    """Derivative to rounding, without taking a difference."""
    return function(xi + 1e-30j).imag / 1e-30


def each(function, errors, *arguments):
    """Values of a function of one error at many."""
    return np.array([function(xi, *arguments) for xi in errors])


def test_barrier_inside_the_knee_is_that_of_the_paper_times_the_weight():
    for ours, printed in (
        (barrier.potential, printed_potential),
        (barrier.gradient, printed_torque),
    ):
        expected = WEIGHT * each(printed, INSIDE, BOUND).real
        np.testing.assert_allclose(each(ours, INSIDE, *RECOMMENDED), expected, rtol=1e-12)


def test_gradient_and_slope_are_the_first_two_derivatives_inside_the_knee():
    for derivative, printed in (
        (each(barrier.gradient, INSIDE, *RECOMMENDED), printed_potential),
        (each(barrier.slope, INSIDE, BOUND, WEIGHT), printed_torque),
    ):
        expected = [complex_step(partial(printed, bound=BOUND), xi) for xi in INSIDE]
        np.testing.assert_allclose(derivative, WEIGHT * np.array(expected), rtol=1e-12)


def test_gradient_is_the_finite_difference_of_the_potential():
    # With h = 1e-8 rad the third derivative (below 1e11 N m/rad^3) adds 1e-6 N m to ~10.
    h, errors = 1e-8, np.array([*-PAST, -KNEE, *-INSIDE, *INSIDE, KNEE, *PAST])
    below, above = (each(barrier.potential, errors + side, *RECOMMENDED) for side in (-h, h))
    gradient = each(barrier.gradient, errors, *RECOMMENDED)
    np.testing.assert_allclose((above - below) / (2.0 * h), gradient, rtol=1e-6, atol=1e-6)


def test_torque_and_slope_are_continuous_at_the_knee():
    h = 1e-10
    below, at, above = (barrier.gradient(KNEE + side, *RECOMMENDED) for side in (-h, 0.0, h))

    assert at == pytest.approx(WEIGHT * printed_torque(KNEE, BOUND).real, rel=1e-12)
    assert (at - below) / h == pytest.approx(LIMIT, rel=1e-4)  # rounding of 10 N m over h
    assert (above - at) / h == pytest.approx(LIMIT, rel=1e-4)


@pytest.mark.parametrize('weight', [1.0, 1000.0, 2e4])
def test_knee_is_where_the_slope_reaches_its_limit(weight):
    knee = barrier.knee(BOUND, weight, LIMIT)

    assert 0.0 <= knee < BOUND
    assert barrier.slope(knee, BOUND, weight) == pytest.approx(LIMIT, rel=1e-9)


def test_slope_never_exceeds_its_limit_and_reaches_it_past_the_knee():
    xi = np.linspace(-3.0 * BOUND, 3.0 * BOUND, 4001)
    slope = np.diff([barrier.gradient(x, *RECOMMENDED) for x in xi]) / np.diff(xi)
    past = np.minimum(np.abs(xi[1:]), np.abs(xi[:-1])) >= KNEE

    assert slope.min() >= WEIGHT * (1.0 - 1e-9)
    assert slope.max() <= LIMIT * (1.0 + 1e-9)
    np.testing.assert_allclose(slope[past], LIMIT, rtol=1e-9)


def test_barrier_is_symmetric():
    for xi in (0.0, *INSIDE, KNEE, *PAST):
        assert barrier.gradient(-xi, *RECOMMENDED) == -barrier.gradient(xi, *RECOMMENDED)
        assert barrier.potential(-xi, *RECOMMENDED) == barrier.potential(xi, *RECOMMENDED)


def test_barrier_near_zero_is_a_spring_of_stiffness_weight():
    xi = 1e-9  # s = 4e-13, so the correction 2 s^2 is below rounding
    assert barrier.gradient(0.0, *RECOMMENDED) == 0.0
    assert barrier.potential(0.0, *RECOMMENDED) == 0.0
    assert barrier.gradient(xi, *RECOMMENDED) == pytest.approx(WEIGHT * xi, rel=1e-12)
    assert barrier.potential(xi, *RECOMMENDED) == pytest.approx(0.5 * WEIGHT * xi**2, rel=1e-12)


def test_potential_without_slope_limit_is_unbounded_at_the_bound():
    """With s = pi/2 (1 - e)^2, tan s is 1 / (pi e) to first order in the distance e."""
    knee = barrier.knee(BOUND, 1.0, 1e300)
    for distance in (1e-4, 1e-5, 1e-6):
        potential = barrier.potential(BOUND * (1.0 - distance), BOUND, 1.0, 1e300, knee)
        assert potential == pytest.approx(BOUND**2 / pi / (pi * distance), rel=2.0 * distance)


def test_barrier_is_finite_and_pushes_back_at_and_beyond_the_bound():
    torques = [barrier.gradient(xi, *RECOMMENDED) for xi in (BOUND, 2.0 * BOUND, 1.0)]
    assert np.all(np.isfinite(torques))
    assert 0.0 < torques[0] < torques[1] < torques[2]


K0, K, RATE = 0.02, 0.0015, 2.0
STIFFNESS, LARGEST = 1000.0, 2e4
NARROWING = {
    'bound': np.full(2, K),
    'initial_bound': np.full(2, K0),
    'funnel_rate': RATE,
}


def at(t, **changes):
    case = arbitrary(0, **changes)
    barrier.update_bound(case.settings, case.signals, t)
    return case.settings, case.signals


def bound(t):
    return K + (K0 - K) * exp(-RATE * t)


def test_bound_decays_from_the_initial_to_the_final_one_at_its_rate():
    settings, begin = at(0.0, funnel_rate=RATE)
    np.testing.assert_allclose(begin.bound, settings.initial_bound, rtol=1e-15)
    _, half = at(np.log(2.0) / RATE, funnel_rate=RATE)
    np.testing.assert_allclose(half.bound, 0.5 * (settings.initial_bound + settings.bound))
    _, end = at(1e3, funnel_rate=RATE)
    np.testing.assert_array_equal(end.bound, settings.bound)


@pytest.mark.parametrize('t', [0.0, 0.3, 2.0])
def test_narrowing_is_the_derivative_divided_by_the_bound(t):
    # With h = 1e-5 s the third derivative, below 20 rad/s^3, adds 1e-9.
    h = 1e-5
    before, after = (at(t + side, funnel_rate=RATE)[1].bound for side in (-h, h))
    _, now = at(t, funnel_rate=RATE)
    np.testing.assert_allclose(now.narrowing, (after - before) / (2.0 * h) / now.bound, atol=1e-8)


@pytest.mark.parametrize('given', ['no rate', 'no difference'])
def test_constant_bound_equals_the_given_one_bit_for_bit(given):
    case = arbitrary(0)
    constant = (
        {'funnel_rate': 0.0, 'initial_bound': case.settings.bound}
        if given == 'no rate'
        else {'funnel_rate': 3.0, 'initial_bound': case.settings.bound}
    )
    settings, signals = at(1.234, **constant)
    np.testing.assert_array_equal(signals.bound, settings.bound)
    np.testing.assert_array_equal(signals.knee, settings.knee)
    np.testing.assert_array_equal(signals.narrowing, 0.0)


def test_knee_stays_where_the_slope_reaches_its_limit():
    knee = np.full(3, barrier.knee(K, STIFFNESS, LARGEST))
    changes = {'bound': np.full(3, K), 'initial_bound': np.full(3, K0), 'funnel_rate': RATE}
    for t in (0.0, 0.7, 3.0):
        _, now = at(t, knee=knee, **changes)
        assert barrier.slope(now.knee[0], now.bound[0], STIFFNESS) == pytest.approx(
            LARGEST, rel=1e-9
        )


def motion(share, t):
    """Error that stays at about a share of the bound, and its derivative."""
    angle = 5.0 * t
    narrowing = -RATE * (K0 - K) * exp(-RATE * t)
    value = share * bound(t) * (1.0 + 0.1 * np.sin(angle))
    slope = share * (narrowing * (1.0 + 0.1 * np.sin(angle)) + 0.5 * bound(t) * np.cos(angle))
    return value, slope


def potential(xi, k):
    return barrier.potential(xi, k, STIFFNESS, LARGEST, barrier.knee(K, STIFFNESS, LARGEST) / K * k)


@pytest.mark.parametrize('share', [0.1, 0.5, 0.75, 1.3, -0.6, -2.0])
@pytest.mark.parametrize('t', [0.0, 0.4, 1.5])
def test_rate_of_the_potential_accounts_for_the_narrowing_bound(share, t):
    """V' = dV/dxi (xi' - xi k'/k) + 2 (k'/k) V, inside the knee and past it."""
    h = 1e-6
    before, after = (potential(motion(share, t + s)[0], bound(t + s)) for s in (-h, h))
    xi, dxi = motion(share, t)
    k = bound(t)
    narrowing = -RATE * (K0 - K) * exp(-RATE * t) / k
    knee = barrier.knee(K, STIFFNESS, LARGEST) / K * k
    gradient = barrier.gradient(xi, k, STIFFNESS, LARGEST, knee)

    expected = gradient * (dxi - xi * narrowing) + 2.0 * narrowing * potential(xi, k)
    assert (after - before) / (2.0 * h) == pytest.approx(expected, rel=1e-6)


def test_virtual_control_scales_the_error_with_the_bound():
    """Without the gains, alpha2 = dqr + xi1 k'/k keeps xi1 / k constant."""
    settings = recommended(K=np.zeros(2), mu=np.zeros(2), **NARROWING)
    law = controller(settings)
    law.update(0.5, 1e-3, np.concatenate((law.reference_at(0.5)[0] + 0.003, np.zeros(4))))
    dqr = law.reference_at(0.5)[1]
    expected = -0.003 * RATE * (K0 - K) * exp(-RATE * 0.5) / bound(0.5)
    np.testing.assert_allclose(law.signals.beta2 - dqr, expected, rtol=1e-12)


def test_virtual_control_uses_the_bound_at_its_time():
    law = controller(recommended(**NARROWING))
    for t, error in ((0.0, 0.011), (1.0, 0.002)):
        law.reset()
        qr, dqr, _ = law.reference_at(t)
        law.update(t, 1e-3, np.concatenate((qr + error, np.zeros(4))))
        narrowing = -RATE * (K0 - K) * exp(-RATE * t) / bound(t)
        sinc = surface.sinc(pi * (error / bound(t)) ** 2)
        expected = dqr + error * narrowing - (75.0 * sinc + 20.0) * error
        np.testing.assert_allclose(law.signals.beta2, expected, rtol=1e-9)


START = (2.2935 + 0.015, 1.6961 - 0.012)


def test_loop_stays_within_the_narrowing_bound():
    law, arm = controller(recommended(**NARROWING)), plant(start=START)
    ratios = []
    for sample in closed_loop(law, arm, 10.0):
        np.testing.assert_allclose(law.sample.bound, bound(sample.t), rtol=1e-12)
        ratios.append(np.abs(law.sample.xi1) / law.sample.bound)
    assert np.max(ratios[0]) == pytest.approx(0.75, rel=1e-3)  # 15 of 20 mrad
    assert np.max(ratios) < 0.8


def test_lyapunov_function_decreases_while_the_bound_narrows():
    """(31) for the moving bound, with a known model and no disturbance."""
    model_known = {'initial_estimate': np.array([*P, 0.0, 0.0]), 'Gamma': np.zeros(5)}
    quiet = {'gamma': np.zeros(2), 'truth_known': 1, 'true_parameters': P}
    law = controller(recommended(**NARROWING | model_known | quiet))
    arm = plant(start=START, constant=(0.0, 0.0), amplitude=(0.0, 0.0))
    V = []
    for sample in closed_loop(law, arm, 2.0):
        M, _, _ = dynamics(P, R, sample.measurement[:2], sample.measurement[2:4])
        V.append(law.sample.lyapunov[0] + 0.5 * law.signals.xi2 @ M @ law.signals.xi2)
    # At the first sample alpha2 jumps to the virtual control: V2 starts there.
    assert np.diff(V).max() < 1e-6 * V[0]
    assert V[-1] < 1e-3 * V[0]


K_C, GAIN, MU, DQR = 0.002, 150.0, 20.0, -0.3


def virtual_control(xi1):
    return surface.virtual_control(xi1, K_C, GAIN, MU, DQR)


@pytest.mark.parametrize('xi1', [*np.linspace(-0.999, -0.01, 9), *np.linspace(0.01, 0.999, 9)])
def test_virtual_control_matches_the_paper_away_from_zero(xi1):
    xi1 *= K_C
    s = pi * xi1**2 / (2.0 * K_C**2)
    tau_aux = -GAIN * K_C**2 / (xi1 * pi) * sin(s) * cos(s)

    assert virtual_control(xi1) == pytest.approx(tau_aux - MU * xi1 + DQR, rel=1e-13)


def test_virtual_control_at_zero_error_is_the_reference_velocity():
    assert virtual_control(0.0) == DQR


@pytest.mark.parametrize('xi1', [1e-12, 1e-9, 1e-7])
def test_virtual_control_near_zero_is_linear(xi1):
    # The sinc's next term is (pi xi1^2 / k_c^2)^2 / 6, 1e-17 at 1e-7 rad.
    without_reference = surface.virtual_control(xi1, K_C, GAIN, MU, 0.0)
    assert without_reference == pytest.approx(-(GAIN / 2.0 + MU) * xi1, rel=1e-14)
    assert surface.virtual_control(-xi1, K_C, GAIN, MU, 0.0) == -without_reference


@pytest.mark.parametrize('xi1', [K_C, 1.1 * K_C, 10.0 * K_C])
def test_only_the_linear_part_remains_at_and_beyond_the_bound(xi1):
    assert virtual_control(xi1) == DQR - MU * xi1
    assert virtual_control(-xi1) == DQR + MU * xi1


def test_barrier_part_falls_to_zero_at_the_bound_continuously():
    # sinc(pi (1 - e)^2) = 2 e to first order.
    e = 1e-9
    part = DQR - MU * K_C * (1.0 - e) - virtual_control(K_C * (1.0 - e))
    assert part == pytest.approx(GAIN / 2.0 * K_C * 2.0 * e, abs=1e-15)


def test_sinc_series_matches_the_quotient():
    switch = 1e-4
    assert surface.sinc(0.0) == 1.0
    assert surface.sinc(np.nextafter(switch, 0.0)) == pytest.approx(surface.sinc(switch), abs=3e-16)
    for x in (1e-6, 5e-5, -5e-5, switch, 0.1, -2.0):
        assert surface.sinc(x) == pytest.approx(sin(x) / x, abs=3e-16)
    assert surface.sinc(pi) == pytest.approx(0.0, abs=1e-16)


@pytest.mark.parametrize('dt', [1e-5, 1e-3, 2e-3, 1.0])
def test_filter_step_is_exact_for_a_held_input(dt):
    """lambda alpha' + alpha = beta from alpha0: alpha = beta + (alpha0 - beta) exp(-t / lambda)."""
    time_constant, alpha, beta = 0.002, 0.7, -0.4
    step = surface.filter_gain(time_constant, dt) * (beta - alpha)

    assert alpha + step == pytest.approx(
        beta + (alpha - beta) * exp(-dt / time_constant), rel=1e-14
    )


def test_two_half_steps_equal_one_full_step():
    whole, half = surface.filter_gain(0.002, 1e-3), surface.filter_gain(0.002, 0.5e-3)
    assert 1.0 - (1.0 - half) ** 2 == pytest.approx(whole, rel=1e-14)


def test_law_follows_the_filter_from_the_first_virtual_control():
    """alpha2(0) = beta2(0), then the solution for held beta2, at the mean rate alpha2'."""
    settings = recommended()
    law = controller(settings)
    qr, dqr, ddqr = np.zeros((3, 2))
    random = np.random.default_rng(1)
    alpha2 = None
    for k in range(200):
        t = k * 1e-3
        reference.evaluate(REFERENCE, t, qr, dqr, ddqr)
        xi1 = random.uniform(-0.0015, 0.0015, 2)
        dq = dqr + random.normal(size=2)
        law.update(t, 1e-3, np.concatenate([qr + xi1, dq, np.zeros(2)]))

        s = pi * xi1**2 / (2.0 * settings.bound**2)
        beta2 = -settings.K * settings.bound**2 / (xi1 * pi) * np.sin(s) * np.cos(s)
        beta2 += dqr - settings.mu * xi1
        alpha2 = beta2 if alpha2 is None else alpha2

        np.testing.assert_allclose(law.signals.beta2, beta2, atol=1e-12)
        np.testing.assert_allclose(law.signals.xi2, dq - alpha2, atol=1e-12)
        next_alpha2 = beta2 + (alpha2 - beta2) * exp(-1e-3 / settings.time_constant)
        np.testing.assert_allclose(law.signals.dalpha2, (next_alpha2 - alpha2) / 1e-3, atol=1e-9)
        alpha2 = next_alpha2
        np.testing.assert_allclose(law.state.alpha2, alpha2, atol=1e-12)
