# SPDX-License-Identifier: Apache-2.0
"""The virtual control (15), (18) without 0/0, and the filter (13) without discretisation error."""

from __future__ import annotations

from math import cos, exp, pi, sin

import numpy as np
import pytest
from closed_loop_case import REFERENCE, controller, recommended

from blf_dsc_controller.law import surface
from blf_dsc_controller.reference import terms as reference

BOUND, K, MU, DQR = 0.002, 150.0, 20.0, -0.3


def virtual_control(xi1):
    return surface.virtual_control(xi1, BOUND, K, MU, DQR)


@pytest.mark.parametrize('xi1', [*np.linspace(-0.999, -0.01, 9), *np.linspace(0.01, 0.999, 9)])
def test_virtual_control_matches_the_paper_away_from_zero(xi1):
    xi1 *= BOUND
    s = pi * xi1**2 / (2.0 * BOUND**2)
    tau_aux = -K * BOUND**2 / (xi1 * pi) * sin(s) * cos(s)

    assert virtual_control(xi1) == pytest.approx(tau_aux - MU * xi1 + DQR, rel=1e-13)


def test_virtual_control_at_zero_error_is_the_reference_velocity():
    assert virtual_control(0.0) == DQR


@pytest.mark.parametrize('xi1', [1e-12, 1e-9, 1e-7])
def test_virtual_control_near_zero_is_linear(xi1):
    # The sinc's next term is (pi xi1^2 / k_c^2)^2 / 6, 1e-17 at 1e-7 rad.
    without_reference = surface.virtual_control(xi1, BOUND, K, MU, 0.0)
    assert without_reference == pytest.approx(-(K / 2.0 + MU) * xi1, rel=1e-14)
    assert surface.virtual_control(-xi1, BOUND, K, MU, 0.0) == -without_reference


@pytest.mark.parametrize('xi1', [BOUND, 1.2 * BOUND, 10.0 * BOUND])
def test_only_the_linear_part_remains_at_and_beyond_the_bound(xi1):
    assert virtual_control(xi1) == DQR - MU * xi1
    assert virtual_control(-xi1) == DQR + MU * xi1


def test_barrier_part_falls_to_zero_at_the_bound_continuously():
    # sinc(pi (1 - e)^2) = 2 e to first order.
    e = 1e-9
    part = DQR - MU * BOUND * (1.0 - e) - virtual_control(BOUND * (1.0 - e))
    assert part == pytest.approx(K / 2.0 * BOUND * 2.0 * e, abs=1e-15)


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
