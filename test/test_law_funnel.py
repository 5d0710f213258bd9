# SPDX-License-Identifier: Apache-2.0
"""The narrowing bound: its derivative, its effect on V, and a loop that stays within it."""

from __future__ import annotations

from math import exp, pi

import numpy as np
import pytest
from arbitrary_case import arbitrary
from closed_loop_case import P, R, closed_loop, controller, plant, recommended
from plain_law import dynamics

from blf_dsc_controller.law import barrier, surface

K0, K, RATE = 0.02, 0.0015, 2.0
WEIGHT, LIMIT = 1000.0, 2e4
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
    knee = np.full(3, barrier.knee(K, WEIGHT, LIMIT))
    changes = {'bound': np.full(3, K), 'initial_bound': np.full(3, K0), 'funnel_rate': RATE}
    for t in (0.0, 0.7, 3.0):
        _, now = at(t, knee=knee, **changes)
        assert barrier.slope(now.knee[0], now.bound[0], WEIGHT) == pytest.approx(LIMIT, rel=1e-9)


def motion(share, t):
    """Error that stays at about a share of the bound, and its derivative."""
    angle = 5.0 * t
    narrowing = -RATE * (K0 - K) * exp(-RATE * t)
    value = share * bound(t) * (1.0 + 0.1 * np.sin(angle))
    slope = share * (narrowing * (1.0 + 0.1 * np.sin(angle)) + 0.5 * bound(t) * np.cos(angle))
    return value, slope


def potential(xi, k):
    return barrier.potential(xi, k, WEIGHT, LIMIT, barrier.knee(K, WEIGHT, LIMIT) / K * k)


@pytest.mark.parametrize('share', [0.1, 0.5, 0.75, 1.3, -0.6, -2.0])
@pytest.mark.parametrize('t', [0.0, 0.4, 1.5])
def test_rate_of_the_potential_accounts_for_the_narrowing_bound(share, t):
    """V' = dV/dxi (xi' - xi k'/k) + 2 (k'/k) V, inside the knee and past it."""
    h = 1e-6
    before, after = (potential(motion(share, t + s)[0], bound(t + s)) for s in (-h, h))
    xi, dxi = motion(share, t)
    k = bound(t)
    narrowing = -RATE * (K0 - K) * exp(-RATE * t) / k
    knee = barrier.knee(K, WEIGHT, LIMIT) / K * k
    gradient = barrier.gradient(xi, k, WEIGHT, LIMIT, knee)

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
