# SPDX-License-Identifier: Apache-2.0
"""The parts of the external torque: its filter, covariance, tare and noise."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import law_part
import numpy as np
import pytest

from blf_dsc_controller.law import external_torque
from blf_dsc_controller.law.external_torque import Settings, State, Work
from blf_dsc_controller.numerics.algebra import cholesky_factor

DT = 1e-3  # s
SETTINGS = Settings(
    bandwidth=30.0,
    window=500,
    row_interval=10,
    coulomb_velocity=0.02,
    row_variance=0.01,
    unmodelled=np.array([0.5, 0.1]),
)
N, M = 2, 3  # joints, entries of theta


part = partial(law_part.part, n=N, m=M, contact=SimpleNamespace(enabled=1))


def update_noise(state, work, *, is_touched=False):
    """Update s^2 by a sample."""
    external_torque.update_noise(SETTINGS, state, work, is_touched)


@pytest.fixture
def state():
    """That after the first window, with S = 1 and nothing known of theta's errors."""
    state = part(State)
    state.latch_time[0] = 1.0
    state.noise[:] = 1.0
    state.spread[:] = np.eye(N)
    cholesky_factor(state.spread)
    return state


def test_arm_with_friction_at_breakaway_alone_has_no_external_torque():
    """u = X theta + friction, after 20 time constants of the filter: e^-20 is left."""
    state = part(State)
    theta, friction = np.array([1.0, -2.0, 3.0]), 0.7
    X = np.array([[0.5, 1.0, 0.2], [1.5, -0.3, 0.1]])
    rows = np.column_stack((X, X @ theta + [friction, 0.0]))
    for _ in range(round(20.0 / SETTINGS.bandwidth / DT)):
        for i in range(N):
            breakaway = friction if i == 0 else 0.0
            external_torque.filter_interval(SETTINGS, state, i, rows[i], breakaway, DT)
    external_torque.update_torque(state, theta)
    np.testing.assert_allclose(state.torque, 0.0, atol=1e-7)
    np.testing.assert_allclose(state.filtered[:, :M], X, atol=1e-7)


def test_distance_is_that_of_the_covariance_by_theta_and_noise(state):
    """(r^T S^-1 r)^(1/2) with S = a X A^-1 X^T + diag(s^2), as numpy finds it."""
    random = np.random.default_rng(1)
    X = random.normal(size=(N, M))
    B = random.normal(size=(M, M))
    A = B @ B.T + np.eye(M)
    factor = A.copy()
    cholesky_factor(factor)
    external_torque.update_covariance(state, factor, 0.04, 7.0)
    assert state.latch_time[0] == 7.0
    state.filtered[:, :M] = X
    state.noise[:] = [[0.3, 0.2], [5.0, 6.0], [8.0, 9.0]]  # fast, slow, at rest
    state.reversing[1] = 0.1
    state.torque[:] = 1.0, -2.0
    work = part(Work)
    external_torque.update_spread(SETTINGS, state, work, np.zeros(M))
    by_theta = 0.04 * X @ np.linalg.inv(A) @ X.T
    S = by_theta + np.diag([0.3, 6.0])
    expected = np.sqrt(state.torque @ np.linalg.solve(S, state.torque))
    assert external_torque.whiten_torque(state, work) == pytest.approx(expected)
    for i in range(N):
        assert external_torque.variance_of(SETTINGS, state, work, i) == pytest.approx(
            S[i, i]
        )


@pytest.mark.parametrize('is_touched', [False, True])
def test_noise_is_measured_while_nothing_touches(state, is_touched):
    """The mean square of r = 0.5 N m, within 10 % after a window: e^-1 of 1 % is assumed."""
    state.noise[:] = 0.3
    state.torque[:] = 0.5
    work = part(Work)
    for _ in range(SETTINGS.window * SETTINGS.row_interval):
        update_noise(state, work, is_touched=is_touched)
    expected = 0.3 if is_touched else pytest.approx(0.25, rel=0.1)
    assert state.noise[0, 0] == expected
    assert state.noise[1, 0] == 0.3  # of reversals


def test_noise_is_a_mean_at_first_and_that_of_the_last_window_later(state):
    """The mean square of r = 0.5 N m, and then of 1 N m; a hundredth of a window is assumed."""
    work = part(Work)
    window = SETTINGS.window * SETTINGS.row_interval
    state.noise[:] = 0.9
    state.torque[:] = 0.5
    assumed, few = 0.01 * window, window // 10
    for _ in range(few):
        update_noise(state, work)
    mean = (assumed * 0.9 + few * 0.25) / (assumed + few)
    assert state.noise[0, 0] == pytest.approx(mean)
    state.samples[:] = 10.0 * window
    state.torque[:] = 1.0
    for _ in range(window):
        update_noise(state, work)
    assert state.noise[0, 0] == pytest.approx(1.0 + (mean - 1.0) / np.e, rel=1e-3)


def test_noise_is_what_the_covariance_by_theta_leaves_up_to_four_times_what_it_was(
    state,
):
    """A hundredth of a window is assumed, and a tenth of slow motion and rest.

    They count for one window, and for four.
    """
    window = SETTINGS.window * SETTINGS.row_interval
    state.covariance[:] = np.diag([0.1, 0.1])
    for k, (slow, resting) in enumerate(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))):
        state.reversing[:], state.resting[0] = slow, resting
        assumed = (0.01, 0.1, 0.1)[k] * window
        last = (1.0, 4.0, 4.0)[k] * window
        for r, left in ((0.5, 0.15), (0.2, 0.0), (9.0, 1.2)):
            for samples, count in ((0.0, assumed + 1.0), (9.0 * window, last)):
                state.noise[:], state.samples[:] = 0.3, samples
                state.torque[:] = r
                update_noise(state, part(Work))
                expected = 0.3 + (left - 0.3) / count
                np.testing.assert_allclose(state.noise[k], expected, rtol=1e-9)


@pytest.mark.parametrize(
    ('reversing', 'resting', 'least'),
    [
        (0.0, 0.0, 0.05),
        (0.1, 0.0, np.hypot(0.05, 1.5)),
        (0.1, 1.0, np.hypot(0.05, 0.5)),
    ],
)
def test_noise_of_slow_motion_and_rest_is_at_least_a_share_of_friction(
    state, reversing, resting, least
):
    """0.15 of 10 N m, 0.05 at rest, and a tenth of the unmodelled 0.5 N m in any motion."""
    state.reversing[:] = reversing
    state.resting[:] = resting
    state.noise[:] = 1e-9
    work = part(Work)
    work.coulomb[:] = 10.0
    update_noise(state, work)
    k = external_torque.regime(SETTINGS, state, 0)
    assert np.sqrt(state.noise[k, 0]) == pytest.approx(least)


@pytest.fixture
def tared(state):
    """An arm of X_0 that was tared at rest, and has gone to X since, where it moves."""
    random = np.random.default_rng(2)
    B = random.normal(size=(M, M))
    A = B @ B.T + np.eye(M)
    factor = A.copy()
    cholesky_factor(factor)
    external_torque.update_covariance(state, factor, 0.5, 7.0)
    state.filtered[:] = random.normal(size=(N, M + 1))
    state.noise[:] = [[0.3, 0.2], [0.5, 0.6], [0.04, 0.09]]
    state.reversing[:] = 1.0
    state.resting[0] = 1.0
    estimate = random.normal(size=M)
    X_0 = state.filtered.copy()
    external_torque.update_torque(state, estimate)
    external_torque.tare(state, 0.0)
    state.filtered[:] += 0.1 * random.normal(size=(N, M + 1))
    state.resting[0] = 0.0
    state.held[0] = 0.5
    return state, estimate, A, X_0


def test_tare_is_zero_where_the_arm_rests(tared):
    state, estimate, _, X_0 = tared
    state.filtered[:] = X_0
    state.resting[0] = 1.0
    work = part(Work)
    external_torque.forget_tare(state)
    external_torque.update_torque(state, estimate)
    assert (np.abs(state.torque) > 0.05).all()
    external_torque.tare(state, 0.0)
    for _ in range(2):
        external_torque.update_torque(state, estimate)
        np.testing.assert_allclose(state.torque, 0.0, atol=1e-12)
        external_torque.update_spread(SETTINGS, state, work, estimate)
    deviations = [
        np.sqrt(external_torque.variance_of(SETTINGS, state, work, i)) for i in range(N)
    ]
    np.testing.assert_allclose(deviations, 0.1 * SETTINGS.unmodelled)  # the least


def test_tare_says_of_r_what_their_covariance_says(tared):
    """The conditional mean and covariance of Gaussian r given r_0, as numpy finds it."""
    state, estimate, A, X_0 = tared
    work = part(Work)
    external_torque.update_spread(SETTINGS, state, work, estimate)
    external_torque.update_torque(state, estimate)
    P = 0.5 * np.linalg.inv(A)
    X, X_0, rows_0 = state.filtered[:, :M], X_0[:, :M], X_0
    S = X @ P @ X.T + np.diag([0.5, 0.6])  # slow
    S_0 = X_0 @ P @ X_0.T + np.diag([0.04, 0.09])
    C = X @ P @ X_0.T + 0.5 * np.diag([0.04, 0.09])  # of friction
    K = C @ np.linalg.inv(S_0)
    r_0 = X_0 @ estimate - rows_0[:, M]
    expected = X @ estimate - state.filtered[:, M] - K @ r_0
    np.testing.assert_allclose(state.torque, expected)
    left = S - K @ C.T
    for i in range(N):
        variance = external_torque.variance_of(SETTINGS, state, work, i)
        assert variance == pytest.approx(left[i, i])
        assert variance < S[i, i]


def test_rest_after_a_tare_says_nothing_of_the_noise(tared):
    state = tared[0]
    state.torque[:] = 3.0
    for resting in (1.0, 0.0):
        state.resting[0] = resting
        update_noise(state, part(Work))
        assert state.noise[2].tolist() == [0.04, 0.09]
        assert (state.noise[1] > [0.5, 0.6]).all() is np.bool_(not resting)
