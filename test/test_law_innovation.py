# SPDX-License-Identifier: Apache-2.0
"""Whether a row is what those before it predict: its innovation, and the noise of the rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import multivariate_normal, multivariate_t

from blf_dsc_controller.law.innovation import (
    CORRELATION,
    State,
    alarm,
    begin,
    forget_recent,
    has_begun,
    noise_of,
    normalized_square,
    raise_noise,
    row_variance,
    update,
)
from blf_dsc_controller.numerics.algebra import cholesky_factor

PERIOD = 0.01  # s, of the rows
MOST = 500.0  # rows of a window
MEMORY = 10  # rows in 0.1 s


def begun(unmodelled=1.0):
    """Statistics before any row: s^2 is a tenth of what is unmodelled."""
    state = State(*np.zeros((5, 1)))
    assert not has_begun(state)
    begin(state, unmodelled)
    assert has_begun(state)
    return state


def test_square_of_an_innovation_is_that_of_its_covariance():
    """As by numpy; it is 1 on average, whatever is known of theta."""
    random = np.random.default_rng(3)
    n, m, noise, period = 3, 5, 0.5, PERIOD
    a = noise * CORRELATION / period
    squares = []
    for _ in range(2000):
        before = random.normal(size=(random.integers(1, 40), m))
        A = before.T @ before + a * np.eye(m)
        theta = random.multivariate_normal(np.zeros(m), a * np.linalg.inv(A))
        X = random.normal(size=(n, m))
        u = X @ theta + np.sqrt(noise) * random.normal(size=n)
        factor = A.copy()
        cholesky_factor(factor)
        S = noise * np.eye(n) + a * X @ np.linalg.inv(A) @ X.T
        expected = noise * u @ np.linalg.solve(S, u) / n
        given = X.copy(), u.copy(), factor
        square = normalized_square(*given, period, np.zeros((n, n)))
        assert square == pytest.approx(expected, rel=1e-9)
        squares.append(square / noise)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.05)


def test_rows_that_fit_ever_worse_are_noise_and_those_of_a_change_are_not():
    for squares, expected in (
        (np.full(400, 0.3), False),
        (0.1 + 0.9 * np.linspace(0.0, 1.0, 400) ** 2, False),
        (np.append(np.full(200, 0.1), np.full(20, 2.5)), True),
    ):
        state = begun()
        found = [update(state, each, 1.0, 1.0, PERIOD, MOST) for each in squares]
        assert any(found) == expected
    assert np.argmax(found) - 200 < 10


@pytest.mark.parametrize(
    ('mean', 'rows', 'expected'),
    [
        (0.0, 0.0, 0.1),  # as assumed, before any row
        (0.5, 0.0, 0.1),
        (0.5, MOST, 0.5),  # as measured, over a window
        # a hundred assumed rows, fewer as the window fills: 50 beside 250
        (0.5, 250.0, 0.5 + 50.0 / 300.0 * (0.1 - 0.5)),
        (0.0, MOST, 0.001),  # a thousandth of what is unmodelled at least
    ],
)
def test_noise_goes_from_what_is_assumed_to_what_is_measured(mean, rows, expected):
    assert noise_of(mean, rows, 1.0, MOST) == pytest.approx(expected)
    assert noise_of(7.0 * mean, rows, 7.0, MOST) == pytest.approx(7.0 * expected)


def test_row_of_a_change_hardly_raises_the_noise():
    """It counts as three times s^2, however large it is; less counts as it is."""
    found = []
    for square in (0.3, 1.0, 1e6):  # s^2 is 0.1
        state = begun()
        update(state, square, 1.0, 1.0, PERIOD, MOST)
        found.append(float(state.mean[0]))
    assert found == pytest.approx([0.3, 0.3, 0.3])
    state = begun()
    update(state, 0.2, 1.0, 1.0, PERIOD, MOST)
    assert state.mean[0] == pytest.approx(0.2)


def test_rest_is_no_evidence_that_rows_fit():
    """A row at rest has no share: neither the noise nor the last rows change in ten seconds."""
    state = begun()
    for _ in range(200):
        update(state, 0.3, 1.0, 1.0, PERIOD, MOST)
    before = [float(value[0]) for value in state]
    for _ in range(1000):
        assert not update(state, 0.0, 0.0, 1.0, PERIOD, MOST)
    assert [float(value[0]) for value in state] == before


@pytest.mark.parametrize('share', [1.0, 0.25, 0.01])
def test_noise_is_that_of_moving_rows_whatever_their_weight(share):
    """Rows of a weight w have w^2 of the square, and say the same of s^2."""
    state = begun()
    for _ in range(round(600 / share)):
        assert not update(state, 0.3 * share, share, 1.0, PERIOD, MOST)
    assert state.noise[0] == pytest.approx(0.3, rel=0.01)
    assert state.recent[0] == pytest.approx(0.3, rel=0.01)


def test_rows_before_any_motion_leave_what_is_assumed():
    state = begun()
    assert not update(state, 0.0, 0.0, 1.0, PERIOD, MOST)
    assert state.noise[0] == 0.1


@pytest.mark.parametrize(
    ('rows', 'factor', 'changed'),
    [
        (MOST, 7.9, False),
        (MOST, 8.1, True),
        (0.0, 12.3, False),  # s^2 is assumed, and doubted: 12.4 by `as_improbable`
        (0.0, 12.5, True),
    ],
)
def test_arm_has_changed_from_eight_times_the_noise_on_average_over_a_tenth_of_a_second(
    rows, factor, changed
):
    state = begun()
    state.rows[0] = rows
    state.mean[0] = state.recent[0] = 0.1  # s^2: rows that fit
    square = 0.1 * (1.0 + MEMORY * (factor - 1.0))  # moves that average to the factor
    assert update(state, square, 1.0, 1.0, PERIOD, MOST) == changed
    forget_recent(state)
    assert not update(state, 0.1, 1.0, 1.0, PERIOD, MOST)


def test_rows_of_a_correlated_residual_count_as_fewer():
    """With a correlation of 0.2 s and a row each 10 ms, twenty as one."""
    state = begun()
    assert row_variance(state, PERIOD) == pytest.approx(20.0 * 0.1)


def as_improbable(rows, n=6):
    """The F of n innovations, t by so many independent rows, as improbable as normal 8."""

    def fall(distribution, square):
        x = np.full(n, np.sqrt(square))
        return distribution.logpdf(np.zeros(n)) - distribution.logpdf(x)

    known = fall(multivariate_normal(np.zeros(n)), 8.0)
    doubted = multivariate_t(np.zeros(n), df=n * rows)
    return brentq(lambda F: fall(doubted, F) - known, 1.0, 100.0)


@pytest.mark.parametrize('rows', [0.0, 50.0, 200.0, MOST])
def test_change_by_a_noise_of_few_rows_is_as_improbable_as_by_that_of_a_window(rows):
    """By scipy; a hundred assumed rows count, fewer as the window fills."""
    state = begun()
    state.rows[0] = rows
    counted = rows + 100.0 * (1.0 - rows / MOST)
    few, window = (
        as_improbable(each * PERIOD / CORRELATION) for each in (counted, MOST)
    )
    expected = 8.0 * 0.1 * few / window
    assert alarm(state, PERIOD, MOST) == pytest.approx(expected)


def test_noise_of_a_window_shorter_than_what_is_assumed_is_not_trusted_more():
    """Of half a second, whose rows are fewer than the assumed ones."""
    state = begun()
    assert alarm(state, PERIOD, 50.0) == pytest.approx(8.0 * 0.1)


@pytest.mark.parametrize(
    ('recent', 'raised'),
    [
        (5.0, 5.0),
        (0.01, 0.1),  # never lowered
    ],
)
def test_raised_noise_is_that_of_the_last_rows_and_falls_within_seconds(recent, raised):
    """The mean square is that of the rows, as if it had not been raised."""
    state, other = begun(), begun()
    state.recent[0] = recent
    raise_noise(state)
    assert state.noise[0] == raised
    for each in (state, other):
        forget_recent(each)
        for _ in range(round(2.0 / PERIOD)):
            assert not update(each, 0.05, 1.0, 1.0, PERIOD, MOST)
    assert state.noise[0] == pytest.approx(max(raised / np.e, other.noise[0]), rel=0.01)
    assert state.mean[0] == other.mean[0]
