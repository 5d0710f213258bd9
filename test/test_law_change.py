# SPDX-License-Identifier: Apache-2.0
"""When the arm has changed, which windows are split, latched, or forgotten: each part alone."""

from __future__ import annotations

import numpy as np
import pytest
from law_part import part

from blf_dsc_controller.law import change, excitation, window
from blf_dsc_controller.law.innovation import Prior
from blf_dsc_controller.numerics.algebra import cholesky_factor

N, M, LENGTH = 2, 3, 40  # joints, entries of theta, rows of a window
DT = 0.01  # s, with a row in each sample
THETA = np.array([1.0, -0.5, 0.3])
SIZES = window.Settings(
    length=LENGTH, row_interval=1, interval=5, regularization=1e-6, prior_weight=1e-9
)
LATCHES = excitation.Settings(
    excitation_threshold=0.01,
    learning_start=1.0,
    starts_full=1,
    change_detection=1,
    residual_floor=0.02,
    anchor_weight=0.1,
)
PRIOR = Prior(np.zeros(M), np.eye(M))


class Parts:
    """A window of rows, its latch, and what detects a change."""

    def __init__(self):
        sizes = {'n': N, 'm': M, 'p': M, 'window': SIZES}
        self.sliding = window.Window(
            SIZES, part(window.State, **sizes), part(window.Work, **sizes)
        )
        window.reset_direction(self.sliding.state)
        self.latch = part(excitation.State, **sizes)
        self.latch.active[:] = 1.0
        self.change = part(change.State, **sizes)
        self.work = part(change.Work, **sizes)

    def push(self, theta, count, noise=0.0, seed=0):
        """Add random rows of an arm."""
        for row in rows_of(theta, count, noise, seed):
            window.push_row(self.sliding.state, row)

    def residual(self):
        """Mean square residual of the whole window, whose solution is left in its scratch."""
        window.find_excitation(self.sliding, PRIOR, self.latch.active, 4)
        work = self.sliding.work
        window.solve(SIZES, work, PRIOR.information, self.latch.active)
        running, rows = self.sliding.state.running, self.sliding.state.rows[0]
        return excitation.window_residual(running, work.solution) / rows


@pytest.fixture
def parts():
    return Parts()


def rows_of(theta, count, noise=0.0, seed=0):
    """Random rows [X | u] (count, N, M + 1) of an arm."""
    random = np.random.default_rng(seed)
    X = random.normal(size=(count, N, M))
    u = X @ theta + noise * random.normal(size=(count, N))
    return np.concatenate((X, u[:, :, np.newaxis]), axis=2)


@pytest.mark.parametrize(
    ('rows', 'prior', 'predicted'),
    [
        (LENGTH - 1, 1e-9, True),
        (LENGTH, 1e-9, True),  # however many there are
        (LENGTH, 0.0, False),  # a planar arm, without a prior
    ],
)
def test_rows_are_compared_with_those_before_where_there_is_a_prior(
    parts, rows, prior, predicted
):
    parts.sliding.state.rows[0] = rows
    sliding = parts.sliding._replace(settings=SIZES._replace(prior_weight=prior))
    assert change.is_predicted(sliding) == predicted


@pytest.mark.parametrize(
    ('latched', 'square', 'changed'),
    [
        (1.0, 7.9, False),  # of the residual, which it may exceed eightfold
        (1.0, 8.1, True),
        (0.0, 8.1, False),  # there is no solution
    ],
)
def test_last_rows_contradict_a_solution_past_eight_times_its_residual(
    parts, latched, square, changed
):
    residual = 1.0  # (N m)^2, above the floor
    parts.latch.latched[0], parts.latch.residual[0] = latched, residual
    parts.latch.solution[:] = THETA
    (row,) = rows_of(THETA, 1)
    row[0, M] += np.sqrt(square * residual)
    found = change.compare_with_solution(
        LATCHES, parts.change, parts.work, parts.latch, row, 0.1
    )
    assert found == changed
    if latched:
        np.testing.assert_allclose(parts.work.innovation, [square**0.5, 0.0], atol=1e-9)


def test_mean_square_of_the_last_rows_is_over_a_tenth_of_a_second(parts):
    (row,) = rows_of(THETA, 1)
    row[:, M] += 1.0  # an error of 1 N m in each joint
    for _ in range(10):
        error = parts.work.innovation
        change.compare_row(parts.change, row, THETA, DT, error)
    assert parts.change.recent_residual[0] == pytest.approx(2.0 * (1.0 - 0.9**10))


@pytest.mark.parametrize(('changed', 'found'), [(THETA, False), (THETA + 0.5, True)])
def test_rows_of_another_arm_contradict_those_before(parts, changed, found):
    """In a window that is not full; the same arm's rows, with the same noise, do not."""
    contradicted = False
    arms = np.concatenate(
        (rows_of(THETA, 25, 0.05, seed=1), rows_of(changed, 12, 0.05, seed=2))
    )
    for k, row in enumerate(arms):
        contradicted = contradicted or change.compare_with_rows(
            parts.change,
            parts.work,
            parts.sliding,
            PRIOR,
            row.copy(),
            1.0,
            0.02,
            k + 1,
            DT,
        )
        window.push_row(parts.sliding.state, row)
    assert contradicted == found


@pytest.mark.parametrize(('rows', 'changed'), [(2, False), (500, True)])
def test_noise_of_few_rows_is_doubted(parts, rows, changed):
    """Eleven times the noise so far is no change after two rows, and is one after a window."""
    found = False
    sliding = parts.sliding._replace(settings=SIZES._replace(length=500))
    for k, row in enumerate(rows_of(THETA, rows, 0.05)):
        if k == rows - 1:
            now = parts.change.innovation
            now.recent[0] = 12.2 * now.noise[0]  # 11 in the mean with this row
        found = change.compare_with_rows(
            parts.change,
            parts.work,
            sliding,
            PRIOR,
            row.copy(),
            1.0,
            0.02,
            k + 1,
            DT,
        )
    assert found == changed


def test_first_motion_after_a_rest_is_no_change(parts):
    """Rows at rest are all zeros.  As rows that fit, they would leave no noise to compare with."""
    rest = np.zeros((200, N, M + 1))
    arms = np.concatenate(
        (rows_of(THETA, 60, 0.05, 1), rest, rows_of(THETA, 60, 0.05, 2))
    )
    for k, row in enumerate(arms):
        share = float(row.any())
        assert not change.compare_with_rows(
            parts.change,
            parts.work,
            parts.sliding,
            PRIOR,
            row.copy(),
            share,
            0.02,
            k + 1,
            DT,
        )
        window.push_row(parts.sliding.state, row)


def test_change_forgets_the_window_and_the_latch_and_the_estimate_is_the_anchor(parts):
    parts.push(THETA, LENGTH)
    parts.change.innovation.noise[0] = 0.1
    parts.change.innovation.recent[0] = 7.0
    parts.change.recent_residual[0] = 3.0
    parts.latch.latched[0] = parts.latch.best_lambda[0] = 1.0
    parts.latch.least_residual[0] = 0.5
    change.count_change(
        parts.change, parts.latch, parts.sliding, PRIOR, 2.0 * THETA, DT
    )
    state = parts.sliding.state
    assert (state.rows[0], state.cursor[0]) == (0.0, 0.0)
    assert not state.running.any()
    assert (parts.change.changes[0], parts.change.contradiction[0]) == (1.0, 3.0)
    assert parts.change.recent_residual[0] == 0.0
    assert parts.change.innovation.recent[0] == 0.0
    assert (parts.latch.latched[0], parts.latch.best_lambda[0]) == (0.0, 0.0)
    assert parts.latch.least_residual[0] == 0.5  # noise is that of the same arm
    np.testing.assert_array_equal(parts.latch.anchor, 2.0 * THETA)
    np.testing.assert_allclose(parts.change.rows_fit, PRIOR.estimate, atol=1e-12)


@pytest.mark.parametrize(
    ('spans', 'raised'),
    [
        ((40, 3, 3, 3), (False, False, True, True)),  # something pushes
        ((40, 3), (False, False)),  # a load came on in two steps
        ((40, 3, 40, 3, 40), (False,) * 5),  # loads, one after the other
        ((40, 3, 3, 40, 3), (False, False, True, False, False)),
    ],
)
def test_third_change_in_a_row_is_no_other_arm(parts, spans, raised):
    """Each comes after so many rows, and is 5 (N m)^2 off."""
    noise = parts.change.innovation.noise
    found = []
    for span in spans:
        parts.push(THETA, span)
        noise[0], parts.change.innovation.recent[0] = 0.1, 5.0
        change.count_change(parts.change, parts.latch, parts.sliding, PRIOR, THETA, DT)
        found.append(noise[0] == 5.0)
    assert tuple(found) == raised
    assert parts.change.changes[0] == len(spans)


@pytest.mark.parametrize(
    ('rows', 'least', 'split', 'residual', 'asked'),
    [
        (LENGTH, 0.0, 0.0, 0.081, True),  # past four times the floor
        (LENGTH, 0.0, 0.0, 0.079, False),
        (LENGTH - 1, 0.0, 0.0, 0.081, False),  # not full
        (LENGTH, 0.01, 0.0, 0.081, False),  # another one is the measure
        (LENGTH, 0.0, 0.2, 0.11, False),  # split before, and not half as large since
        (LENGTH, 0.0, 0.2, 0.09, True),
    ],
)
def test_first_full_window_is_compared_with_its_parts(
    parts, rows, least, split, residual, asked
):
    parts.sliding.state.rows[0] = rows
    parts.latch.least_residual[0], parts.latch.split_residual[0] = least, split
    found = excitation.is_in_question(LATCHES, parts.latch, parts.sliding, residual)
    assert found == asked


@pytest.mark.parametrize(
    ('newer', 'noise', 'split'),
    [
        (THETA, (0.5, 0.5), False),
        (THETA + 0.5, (0.0, 0.0), True),
        (THETA, (0.0, 0.5), True),  # one of them alone is explained better
        (THETA, (0.5, 0.0), True),
    ],
)
def test_window_of_two_arms_is_split_and_that_of_one_arm_is_not(
    parts, newer, noise, split
):
    """The scratch has equations and solution of the whole window afterwards."""
    parts.push(THETA, LENGTH // 2, noise[0], seed=1)
    parts.push(newer, LENGTH // 2, noise[1], seed=2)
    residual = parts.residual()
    work, state = parts.sliding.work, parts.sliding.state
    whole = work.Phi.copy(), work.b.copy(), work.factor.copy(), work.solution.copy()
    newer_sums = np.zeros((M + 1, M + 1))
    rows = window.newer_part(state, newer_sums)
    found = excitation.split_window(
        LATCHES, parts.latch, parts.sliding, PRIOR, residual
    )
    assert found == split
    assert state.rows[0] == (rows if split else LENGTH)
    assert parts.latch.split_residual[0] == (residual if split else 0.0)
    if split:
        np.testing.assert_array_equal(np.triu(state.running), np.triu(newer_sums))
    for now, then in zip(
        (work.Phi, work.b, work.factor, work.solution), whole, strict=True
    ):
        np.testing.assert_array_equal(now, then)


def test_residual_of_a_part_is_that_of_least_squares(parts):
    rows = rows_of(THETA, 15, noise=0.3)
    sums = np.triu(sum(row.T @ row for row in rows))
    active = parts.latch.active
    found = excitation.part_residual(parts.sliding, PRIOR, active, sums, 15)
    flat = rows.reshape(-1, M + 1)
    _, squares, _, _ = np.linalg.lstsq(flat[:, :M], flat[:, M], rcond=None)
    assert found == pytest.approx(squares[0] / 15, rel=1e-6)


@pytest.mark.parametrize(
    ('t', 'rows', 'starts_full', 'settled'),
    [
        (1.0, LENGTH, 1, True),
        (0.99, LENGTH, 1, False),  # tau_d + T_a is 1 s
        (1.0, 59, 1, False),  # T_a is 0.6 s
        (1.0, 60, 1, True),
        (0.6, 60, 0, True),
        (0.6, 59, 0, False),
    ],
)
def test_window_must_be_full_or_span_the_settling_time(
    parts, t, rows, starts_full, settled
):
    parts.sliding.state.rows[0] = rows
    latches = LATCHES._replace(starts_full=starts_full)
    assert excitation.has_settled(latches, parts.sliding, t, DT) == settled


@pytest.mark.parametrize(
    ('direction', 'active', 'first', 'worst'),
    [
        ([0.1, -0.9, 0.5], [1.0, 1.0, 1.0], 0, 1),
        ([0.1, -0.9, 0.5], [1.0, 0.0, 1.0], 0, 2),  # rejected already
        ([0.1, 0.5, -0.9], [1.0, 1.0, 0.0], 0, 1),
        ([0.9, 0.1, 0.5], [1.0, 1.0, 1.0], 1, 2),  # a parameter is not rejected
    ],
)
def test_column_with_most_of_the_weakest_direction_is_rejected(
    direction, active, first, worst
):
    assert excitation.strongest(np.array(direction), np.array(active), first) == worst


def test_latch_keeps_the_window_and_the_best_of_full_ones(parts):
    parts.push(THETA, LENGTH - 1)
    parts.residual()
    work = parts.sliding.work
    excitation.latch(parts.latch, parts.sliding, 0.3, 2.5)
    assert (parts.latch.latched[0], parts.latch.latch_time[0]) == (1.0, 2.5)
    assert parts.latch.best_lambda[0] == 0.0  # it is not full
    np.testing.assert_array_equal(parts.latch.Phi, work.Phi)
    np.testing.assert_array_equal(parts.latch.factor, work.factor)
    parts.push(THETA, 1)
    excitation.latch(parts.latch, parts.sliding, 0.3, 3.0)
    excitation.latch(parts.latch, parts.sliding, 0.2, 3.5)
    assert parts.latch.best_lambda[0] == 0.3


def test_factor_of_the_window_is_that_of_its_regularised_matrix(parts):
    parts.push(THETA, LENGTH)
    parts.residual()
    expected = parts.sliding.work.Phi + SIZES.regularization * np.eye(M)
    cholesky_factor(expected)
    upper = np.triu(parts.sliding.work.factor)
    np.testing.assert_allclose(upper, np.triu(expected), rtol=1e-12)


@pytest.mark.parametrize(
    ('least', 'residual', 'expected'),
    [
        (0.0, 0.0, 1.0),  # no window has been full
        (1e3, 0.0, 1.0),  # the configured floor is an upper limit
        (0.0, 2.0, 2.0),
    ],
)
def test_floor_is_what_is_configured_or_less(least, residual, expected):
    """All in units of the configured floor."""
    floor = LATCHES.residual_floor
    found = excitation.explained(LATCHES, least * floor, residual * floor)
    assert found == pytest.approx(expected * floor)
    assert excitation.explained(LATCHES, 1e-6 * floor, 0.0) < floor
