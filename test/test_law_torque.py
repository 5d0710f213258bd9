# SPDX-License-Identifier: Apache-2.0
"""The torque: barrier, bound that narrows, surface; the law against a plain one; its limits."""

from __future__ import annotations

from cmath import cos, tan
from math import exp, pi, sin

import numpy as np
import pytest
from closed_loop_case import arbitrary, closed_loop, controller, plant, quick, recommended
from paper_case import P
from plain_law import PlainLaw, R, dynamics
from plants import QUIET

from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.settings import COMPENSATIONS, EFFORT, UPDATES
from blf_dsc_controller.law.torque import LEVEL_CUT, RATE_CUT, find_applied, saturate

BOUND, WEIGHT, LIMIT = 0.002, 1000.0, 2e4
KNEE = barrier.knee(BOUND, WEIGHT, LIMIT)
RECOMMENDED = (BOUND, WEIGHT, LIMIT, KNEE)


def printed_potential(xi, bound):
    """Equation (3); takes complex xi."""
    return bound**2 / pi * tan(pi * xi * xi / (2.0 * bound**2))


def printed_torque(xi, bound):
    """The entries of -tau_c below (16); takes complex xi."""
    return xi / cos(pi * xi * xi / (2.0 * bound**2)) ** 2


def each(function, errors, *arguments):
    """Values of a function of one error at many."""
    return np.array([function(xi, *arguments) for xi in errors])


def test_barrier_inside_the_knee_is_that_of_the_paper_times_the_weight():
    inside = np.linspace(-0.99, 0.99, 51) * KNEE  # 0 among them
    for ours, printed in (
        (barrier.potential, printed_potential),
        (barrier.gradient, printed_torque),
    ):
        expected = WEIGHT * each(printed, inside, BOUND).real
        np.testing.assert_allclose(each(ours, inside, *RECOMMENDED), expected, rtol=1e-12)
    # A complex step is exact to rounding.
    slope = WEIGHT * each(printed_torque, inside + 1e-30j, BOUND).imag / 1e-30
    np.testing.assert_allclose(each(barrier.slope, inside, BOUND, WEIGHT), slope, rtol=1e-12)


def test_barrier_continues_past_the_knee_at_the_largest_slope():
    for weight in (1.0, 1000.0, 2e4):
        knee = barrier.knee(BOUND, weight, LIMIT)
        assert 0.0 <= knee < BOUND
        assert barrier.slope(knee, BOUND, weight) == pytest.approx(LIMIT, rel=1e-9)
    xi = np.linspace(-3.0 * BOUND, 3.0 * BOUND, 4001)
    slope = np.diff(each(barrier.gradient, xi, *RECOMMENDED)) / np.diff(xi)
    past = np.minimum(np.abs(xi[1:]), np.abs(xi[:-1])) >= KNEE
    assert slope.min() >= WEIGHT * (1.0 - 1e-9)
    assert slope.max() <= LIMIT * (1.0 + 1e-9)
    np.testing.assert_allclose(slope[past], LIMIT, rtol=1e-9)
    # The potential is its integral: with h = 1e-8 rad the third derivative (below 1e11 N m/rad^3)
    # adds 1e-6 N m to ~10.
    h, errors = 1e-8, np.append(np.linspace(-3.0, 3.0, 51) * BOUND, [-KNEE, KNEE])
    below, above = (each(barrier.potential, errors + side, *RECOMMENDED) for side in (-h, h))
    gradient = each(barrier.gradient, errors, *RECOMMENDED)
    np.testing.assert_allclose((above - below) / (2.0 * h), gradient, rtol=1e-6, atol=1e-6)


K0, K, RATE = 0.02, 0.0015, 2.0
NARROWING = {'bound': np.full(2, K), 'initial_bound': np.full(2, K0), 'funnel_rate': RATE}
START = (2.2935 + 0.015, 1.6961 - 0.012)


def bound(t):
    """k(t) and k'/k."""
    wider = (K0 - K) * exp(-RATE * t)
    return K + wider, -RATE * wider / (K + wider)


def test_bound_narrows_at_its_rate_and_the_knee_with_it():
    changes = {name: np.resize(value, 3) for name, value in NARROWING.items()}
    knee = np.full(3, barrier.knee(K, WEIGHT, LIMIT))
    settings, _, signals = arbitrary(0, **changes | {'knee': knee, 'funnel_rate': RATE})
    for t in (0.0, 0.3, 2.0):
        barrier.update_bound(settings, signals, t)
        expected = np.transpose([bound(t)] * 3)
        np.testing.assert_allclose((signals.bound, signals.narrowing), expected, rtol=1e-13)
        slope = barrier.slope(signals.knee[0], signals.bound[0], WEIGHT)
        assert slope == pytest.approx(LIMIT, rel=1e-9)
    for rate in (0.0, 3.0):  # a constant one remains as it is to the last bit
        final = settings.bound
        constant = settings._replace(funnel_rate=rate, initial_bound=final)
        barrier.update_bound(constant, signals, 1.234)
        found = signals.bound, signals.knee, signals.narrowing
        np.testing.assert_array_equal(found, (final, constant.knee, np.zeros(3)))


def test_rate_of_the_potential_accounts_for_the_narrowing_bound():
    """V' = dV/dxi (xi' - xi k'/k) + 2 (k'/k) V, inside the knee and past it, for a share of k."""
    knee = barrier.knee(K, WEIGHT, LIMIT) / K

    def at(t, share):
        k, _ = bound(t)
        xi = share * k * (1.0 + 0.1 * np.sin(5.0 * t))
        return xi, barrier.potential(xi, k, WEIGHT, LIMIT, knee * k)

    h = 1e-6
    for share in (0.1, 0.5, 0.75, 1.3, -0.6, -2.0):
        for t in (0.0, 0.4, 1.5):
            dxi, rate = np.subtract(at(t + h, share), at(t - h, share)) / (2.0 * h)
            (k, narrowing), (xi, V) = bound(t), at(t, share)
            gradient = barrier.gradient(xi, k, WEIGHT, LIMIT, knee * k)
            expected = gradient * (dxi - xi * narrowing) + 2.0 * narrowing * V
            assert rate == pytest.approx(expected, rel=1e-6)


def test_lyapunov_function_decreases_while_the_bound_narrows():
    """(31) for the moving bound, with a known model and no disturbance; the loop stays within."""
    model_known = {'initial_estimate': np.array([*P, 0.0, 0.0]), 'Gamma': np.zeros(5)}
    quiet = {'gamma': np.zeros(2), 'truth_known': 1, 'true_parameters': P}
    law = controller(recommended(**NARROWING | model_known | quiet))
    arm = plant(start=START, constant=QUIET, amplitude=QUIET)
    V, ratios = [], []
    for sample in closed_loop(law, arm, 2.0):
        np.testing.assert_allclose(law.sample.bound, bound(sample.t)[0], rtol=1e-12)
        ratios.append(np.abs(law.sample.xi1 / law.sample.bound).max())
        M, _, _ = dynamics(P, R, sample.measurement[:2], sample.measurement[2:4])
        V.append(law.sample.lyapunov[0] + 0.5 * law.signals.xi2 @ M @ law.signals.xi2)
    # At the first sample alpha2 jumps to the virtual control: V2 starts there.
    assert np.diff(V).max() < 1e-6 * V[0]
    assert V[-1] < 1e-3 * V[0]
    assert ratios[0] == pytest.approx(0.75, rel=1e-3)  # 15 of 20 mrad
    assert max(ratios) < 0.8


def test_virtual_control_is_that_of_the_paper_without_its_singularity():
    gain, mu, dqr = 150.0, 20.0, -0.3

    def ours(xi1, dqr=dqr):
        return barrier.virtual_control(xi1, BOUND, gain, mu, dqr)

    assert ours(0.0) == dqr
    for xi1 in BOUND * np.linspace(0.01, 0.999, 18) * np.tile([1.0, -1.0], 9):
        s = pi * xi1**2 / (2.0 * BOUND**2)
        tau_aux = -gain * BOUND**2 / (xi1 * pi) * np.sin(s) * np.cos(s)
        assert ours(xi1) == pytest.approx(tau_aux - mu * xi1 + dqr, rel=1e-13)
    for xi1 in (1e-12, -1e-9, 1e-7):  # linear: the next term is 1e-17 at 1e-7 rad
        assert ours(xi1, 0.0) == pytest.approx(-(gain / 2.0 + mu) * xi1, rel=1e-14)
    # At the bound only mu is left: sinc(pi (1 - e)^2) = 2 e to first order.
    e = 1e-9
    part = dqr - mu * BOUND * (1.0 - e) - ours(BOUND * (1.0 - e))
    assert part == pytest.approx(gain / 2.0 * BOUND * 2.0 * e, abs=1e-15)
    for xi1 in (BOUND, -1.1 * BOUND, 10.0 * BOUND):
        assert ours(xi1) == dqr - mu * xi1
    for x in (1e-6, -5e-5, np.nextafter(1e-4, 0.0), 1e-4, 0.1, -2.0):
        assert barrier.sinc(x) == pytest.approx(sin(x) / x, abs=3e-16)


# The window is not a multiple of the interval, and learning lasts nearly a second. For so short
# a window the condition number of Phi is 1e7; rho = 10 keeps the amplified rounding below 1e-12,
# but would spoil the inverse iteration, so every window counts as excited.
SHORT = {'window': 497, 'interval': 7, 'learning_start': 0.6, 'rho': 10.0, 'sigma': -1.0}
ROUNDING = 1e-12
AT_STATE = COMPENSATIONS.index('state')
GRADIENT = UPDATES.index('gradient')
CASES = {
    'newton': ({}, {}),
    'gradient': ({'update': GRADIENT, 'kappa': 2.0}, {}),
    "the paper's compensation": ({'compensation': AT_STATE}, {}),
    'no bias columns': ({'bias': False}, {}),
    'damping and leakage': ({'d2': np.array([300.0, 200.0]), 'eta': 0.5}, {}),
    'effort': ({'torque_source': EFFORT}, {'delay': 2, 'position_noise': 1e-6}),
    'torque limit': ({'torque_limit': np.array([10.0, 4.0])}, {}),
    'torque rate limit': ({'rate_limit': np.array([500.0, 0.0])}, {}),
    'both limits': (
        {'torque_limit': np.array([10.5, 4.0]), 'rate_limit': np.array([500.0, 90.0])},
        {},
    ),
    'bound that narrows': (
        {'initial_bound': np.full(2, 0.01), 'funnel_rate': 3.0},
        {'start': (2.2975, 1.690)},
    ),
    'at the ball': ({'radius': 0.9, 'Gamma': np.array([0.2, 1.0, 3.0, 0.5, 0.5])}, {}),
    'window not full': ({'window': 2000, 'learning_start': 0.5}, {}),
    'half the rate': ({}, {'sample_time': 2e-3}),
    'past the bound': ({'slope_limit': np.full(2, 5e3)}, {'start': (2.297, 1.692)}),
}


@pytest.mark.parametrize(('gains', 'arm'), CASES.values(), ids=CASES)
def test_law_matches_the_plain_one_in_closed_loop(gains, arm):
    """Torque, estimate and d^3 agree with the oracle in every sample."""
    law, arm = controller(quick(**SHORT | gains)), plant(**arm)
    plain = PlainLaw(law.settings)
    for sample in closed_loop(law, arm, 1.5):
        reference = law.signals.qr, law.signals.dqr, law.signals.ddqr
        torque = plain.update(sample.t, arm.period_ns * 1e-9, *reference, sample.measurement)
        plain.tau = law.signals.torque.copy()
        for ours, theirs in (
            (law.signals.torque, torque),
            (law.state.estimate, plain.theta),
            (law.state.disturbance, plain.d3),
        ):
            np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=ROUNDING)
    assert law.state.latched[0] == 1.0
    assert plain.latched is not None


DT = 2e-3  # s: with 500 N m/s, 1 N m from sample to sample


def cut(demand, last, *, level=10.0, rate=500.0, samples=7.0, added=0.0):
    """Torque and what cut it; the cuts are counted, and any is reported."""
    case = arbitrary(0, n=1, torque_limit=np.array([level]), rate_limit=np.array([rate]))
    _, state, signals = case
    state.samples[0], state.torque[0] = samples, last
    state.level_cuts[0] = state.rate_cuts[0] = 0.0
    signals.demand[0], signals.added[0] = demand, added
    saturated = saturate(*case, DT)
    cuts = signals.cuts[0]
    assert saturated == (cuts > 0.0)
    assert cuts == LEVEL_CUT * state.level_cuts[0] + RATE_CUT * state.rate_cuts[0]
    return signals.torque[0], cuts


@pytest.mark.parametrize(
    ('demand', 'last', 'torque', 'cuts'),
    [
        (3.5, 3.0, 3.5, 0.0),
        (4.0, 3.0, 4.0, 0.0),
        (5.0, 3.0, 4.0, RATE_CUT),
        (-5.0, 3.0, 2.0, RATE_CUT),
        (12.0, 9.5, 10.0, LEVEL_CUT),
        (12.0, 5.0, 6.0, LEVEL_CUT + RATE_CUT),
        (-12.0, -9.0, -10.0, LEVEL_CUT),
        (13.0, 14.0, 10.0, LEVEL_CUT + RATE_CUT),  # the level was lowered below the last torque
    ],
)
def test_torque_saturates_at_its_level_and_at_its_rate(demand, last, torque, cuts):
    assert cut(demand, last) == (torque, cuts)


@pytest.mark.parametrize(
    ('demand', 'last', 'command', 'cuts', 'rate'),
    [
        (12.0, 6.0, 6.0, LEVEL_CUT, 1000.0),  # the whole torque is at its limit
        (-7.0, -10.0, -10.0, LEVEL_CUT, 1000.0),  # the command is: with the drive's 4 N m, -6 N m
        (9.0, 5.0, 5.0, 0.0, 1000.0),
        (7.5, 5.0, 4.0, RATE_CUT, 500.0),  # the rate is that of the command
    ],
)
def test_limits_hold_for_the_command_and_for_the_whole_torque(demand, last, command, cuts, rate):
    for sign in (1.0, -1.0):
        found = cut(sign * demand, sign * last, rate=rate, added=sign * 4.0)
        assert found == (sign * command, cuts)


@pytest.mark.parametrize('source', ['command', 'effort without the drive', 'whole effort'])
def test_applied_torque_has_the_mean_of_what_the_drive_adds_at_both_ends(source):
    whole = source == 'whole effort'
    changes = {'torque_source': EFFORT * (source != 'command'), 'effort_is_whole': int(whole)}
    case = _, state, signals = arbitrary(3, drive=0, **changes)
    measurement = np.arange(9.0)
    base = state.torque.copy() if source == 'command' else measurement[6:]
    expected = base + 0.5 * (state.added + signals.added) * (not whole)
    find_applied(*case, measurement)
    np.testing.assert_array_equal(signals.applied, expected)
    np.testing.assert_array_equal(state.added, signals.added)


def test_rate_limit_is_off_at_zero_and_for_the_first_torque():
    assert cut(9.0, -9.0, rate=0.0) == (9.0, 0.0)
    assert cut(9.0, 0.0, samples=0.0) == (9.0, 0.0)
    for rate in (500.0, 0.0):  # NaN must not turn into a torque that looks valid
        assert np.isnan(cut(np.nan, 3.0, rate=rate)[0])
