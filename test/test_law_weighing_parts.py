# SPDX-License-Identifier: Apache-2.0
"""The parts of the weighing, on rows of an arm whose load is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from blf_dsc_controller.compiled.layout import size_of, view_of
from blf_dsc_controller.law import weighing
from blf_dsc_controller.law.innovation import CORRELATION, Prior
from blf_dsc_controller.law.sums import add_products
from blf_dsc_controller.law.weighing import (
    BEFORE,
    DEVIATION,
    LATEST,
    LOAD,
    MASS,
    NEWER,
    Settings,
    State,
    Work,
)

N, M = 2, 5  # joints, entries of theta
DT = 0.01  # s, with a row in each sample
RANDOM = np.random.default_rng(1)
INERTIAL = 3  # of them, base parameters; the others are Coulomb friction
SCALE = RANDOM.normal(size=(4, LOAD))
SCALE[:, 0] = 1.0, 0.1, 0.2, -0.1  # z = (1, 0, ..., 0) is 1 kg with its moments [kg m]
SCALE = np.hstack((SCALE, np.zeros((4, N))))
FRICTION = 0.3  # N m, standard deviation of breakaway torques
LOST = 0.1  # likewise of the share of the torque in a gear that is lost
CHANGED = 0.2  # N m, likewise of how friction has changed
K = M + 2 * N  # entries of theta, breakaway torques and shares
SINCE = LOAD + N
SIZE = K + 1


def columns():
    """[N D | E], with zeros where a load adds nothing."""
    filled = np.zeros((SIZE, SINCE))
    filled[:M, :LOAD] = RANDOM.normal(size=(M, 4)) @ SCALE[:, :LOAD]
    filled[INERTIAL:M, LOAD:] = CHANGED * np.eye(N)
    return filled


SETTINGS = Settings(
    size=SIZE,
    inertial=INERTIAL,
    since=SINCE,
    unknowns=K + SINCE,
    window=200,
    row_interval=1,
    pole=20.0,
    motion_scale=0.05,
    unmodelled=0.01,
    load_friction=LOST**-2,
    breakaway=np.full(N, FRICTION**-2),
    columns=columns(),
    scale=SCALE,
)
PRIOR = Prior(RANDOM.normal(size=M), np.diag(RANDOM.uniform(0.5, 2.0, M)))
SWIFT = np.array([1.0, -1.0])  # rad/s


def part(layout):
    """An empty state, or scratch."""
    sizes = SimpleNamespace(n=N, weighing=SETTINGS)
    return view_of(layout)(np.zeros(size_of(layout)(sizes)), sizes)


def rows_of(theta, count, noise=0.0, seed=1):
    """Random rows [X | u] (count, N, M + 1) of an arm."""
    random = np.random.default_rng(seed)
    X = random.normal(size=(count, N, M))
    u = X @ theta + noise * random.normal(size=(count, N))
    return np.concatenate((X, u[:, :, np.newaxis]), axis=2)


def with_friction(rows, shares, shapes):
    """Rows (count, N, SIZE) with columns of breakaway and lost torque, whose shapes are given.

    Shares (2 N,) and shapes (count, 2 N) are those of breakaway, then those of torques.
    """
    columns = shapes[:, np.newaxis] * np.hstack((np.eye(N), np.eye(N)))
    u = rows[:, :, M:] + (columns @ shares)[:, :, np.newaxis]
    return np.concatenate((rows[:, :, :M], columns, u), axis=2)


def test_solution_is_the_joint_least_squares_of_arm_and_load():
    """As numpy solves the stacked rows with all priors; deviations from the inverse."""
    state = part(State)
    work = part(Work)
    NDE = SETTINGS.columns[:M]
    D = SETTINGS.scale
    noise = 0.04
    period = CORRELATION / 7.0  # so that seven rows count as one
    z = RANDOM.normal(size=SINCE)
    theta = PRIOR.estimate + 0.1 * RANDOM.normal(size=M)
    loaded = theta + NDE @ z
    shares = np.repeat((FRICTION, LOST), N) * RANDOM.normal(size=2 * N)
    stacked = []
    for which, count, model in (
        (BEFORE, 90, theta),
        (NEWER, 40, loaded),
        (LATEST, 20, loaded),
    ):
        rows = with_friction(
            rows_of(model, count, noise, which),
            shares,
            RANDOM.normal(size=(count, 2 * N)),
        )
        for row in rows:
            add_products(row, state.sums[which])
        X, u = rows[:, :, :K].reshape(-1, K), rows[:, :, K].ravel()
        held = np.zeros((len(X), SINCE)) if which == BEFORE else X[:, :M] @ NDE
        stacked.append(np.column_stack((X, held, u)))
    state.complete[0] = 1.0
    state.age[0] = 5.0
    grown = 5.0 / 20.0  # of the variance of changed friction
    state.innovation.noise[0] = noise**2
    weighing.solve(SETTINGS, state, work, PRIOR, period)
    a = 7.0 * noise**2
    H = np.eye(K + SINCE)
    H[:M, :M] = PRIOR.information
    H[M:K, M:K] = np.diag(np.repeat((FRICTION, LOST), N) ** -2.0)
    H[K + LOAD :, K + LOAD :] /= grown
    *A, u = np.vstack(stacked).T
    g = np.array(A) @ u + a * H @ np.append(PRIOR.estimate, np.zeros(2 * N + SINCE))
    H = np.array(A) @ np.transpose(A) + a * H
    expected = np.linalg.solve(H, g)
    np.testing.assert_allclose(state.solution, expected, rtol=1e-6, atol=1e-9)

    weighing.describe(SETTINGS, state, work, period)
    mass, *moments = D @ expected[K:]
    centre = np.array(moments) / mass
    C = a * D @ np.linalg.inv(H)[K:, K:] @ D.T
    J = np.column_stack((-centre, np.eye(3))) / mass
    np.testing.assert_allclose(state.load[:4], (mass, *centre), rtol=1e-6)
    deviation = np.sqrt(np.append(C[0, 0], np.diag(J @ C @ J.T)))
    np.testing.assert_allclose(state.load[4:], deviation, rtol=1e-5)


@pytest.mark.parametrize('rows', [10, 13, 20])
def test_load_is_solved_for_every_tenth_of_a_second(rows):
    """With a row each 10 ms it is after every tenth; between, the last solution stays."""
    state = part(State)
    for row in rows_of(PRIOR.estimate + 0.1, 30):
        longer = np.insert(row, [M] * 2 * N, 0.0, axis=1)
        add_products(longer, state.sums[LATEST])
    weighing.refresh(SETTINGS, state, part(Work), PRIOR, rows, DT)
    assert bool(state.solution.any()) == (rows % 10 == 0)


class Arm:
    """An arm of which rows are added, with something in its hand."""

    def __init__(self):
        self.state, self.work = part(State), part(Work)
        self.theta = PRIOR.estimate + 0.1
        self.samples = self.changes = 0

    def moves(self, seconds, load=0.0, velocity=SWIFT, lost=0.0, changed=0.0):
        """Add rows of a load [kg]; return its mass [kg] by the weighing.

        Gears lose a share of their torque, which they always move against, and friction
        has `changed` [N m].
        """
        theta = self.theta + load * SETTINGS.columns[:M, 0]
        friction = np.repeat((0.0, changed), (INERTIAL, M - INERTIAL))
        count = round(seconds / DT)
        for row in rows_of(theta + friction, count, 0.01, self.samples):
            self.samples += 1
            torque = row[:, :INERTIAL] @ theta[:INERTIAL]
            signs = np.sign(torque)
            row[:, M] += lost * torque
            sample = weighing.Sample(
                row, np.zeros(N), signs, velocity, self.samples, self.changes, DT
            )
            weighing.add_row(SETTINGS, self.state, self.work, PRIOR, sample)
        return self.state.load[MASS]

    @property
    def knows(self):
        """Whether a mass is known."""
        return self.state.load[DEVIATION] > 0.0


def test_row_has_columns_of_its_own_for_breakaway_and_lost_torque_of_each_joint():
    """Of the torque in the gear, that of the base parameters with the load, at its sign."""
    (given,) = rows_of(PRIOR.estimate, 1)
    row = np.full((N, SIZE), np.nan)
    state, held = part(State), np.zeros(INERTIAL)
    state.solution[:] = RANDOM.normal(size=K + SINCE)
    weighing.find_held(SETTINGS, state, held)
    load = SETTINGS.columns[:INERTIAL, :LOAD] @ state.solution[K : K + LOAD]
    np.testing.assert_allclose(held, state.solution[:INERTIAL] + load)
    signs = np.array([0.9, -0.4])
    for carried in (held, -held):  # friction does not drive where the gear pulls
        sample = weighing.Sample(given, np.array([0.7, -0.2]), signs, SWIFT, 0, 0, DT)
        weighing.extend_row(sample, carried, row)
        torque = given[:, :INERTIAL] @ carried
        shapes = np.append([0.7, -0.2], np.abs(torque) * signs)
        (expected,) = with_friction(
            given[np.newaxis], np.zeros(2 * N), shapes[np.newaxis]
        )
        np.testing.assert_allclose(row, expected)


def test_share_of_slow_rows_is_that_of_their_weights():
    """Of their weight in the window times the one here, each a half at its own speed."""
    scale = SETTINGS.motion_scale
    for speed in (0.02, 0.1, 2.0):
        row = np.ones((N, SIZE))
        weighing.weight_row(row, np.full(N, speed))
        moving = speed**2 / (speed**2 + scale**2)
        share = weighing.counted_share(np.full(N, speed), scale)
        assert share == pytest.approx(moving * np.mean(row[:, 0] ** 2))


def test_load_that_no_change_was_told_of_is_weighed_by_its_rows():
    """To four deviations; 3 s are the first window, and 1 s is more than is kept apart."""
    arm = Arm()
    arm.moves(3.0)
    assert arm.state.complete[0] == 1.0
    mass = arm.moves(1.0, 1.0)
    assert mass == pytest.approx(1.0, abs=4.0 * arm.state.load[DEVIATION])
    assert arm.state.load[DEVIATION] < 0.1
    mass = arm.moves(1.0, 0.0)  # it is put down
    assert mass == pytest.approx(0.0, abs=4.0 * arm.state.load[DEVIATION])


@pytest.mark.parametrize(
    ('seconds', 'complete'),
    [
        (0.7, 0.0),
        (1.2, 1.0),
    ],  # less and more than 0.5 s of motion, after 0.3 s and 0.3 s
)
def test_change_in_the_first_window_ends_the_rows_before_if_they_are_enough(
    seconds, complete
):
    arm = Arm()
    arm.moves(seconds)
    arm.changes += 1
    arm.moves(DT, 1.0)
    assert arm.state.complete[0] == complete
    assert (arm.state.rows[BEFORE] > 0.0) == bool(complete)
    assert not arm.knows
    assert weighing.held_mass(arm.state) == (0.0, np.inf if complete else 0.0)


@pytest.mark.parametrize(('seconds', 'ends'), [(0.5, False), (6.0, True)])
def test_noise_of_half_a_second_is_doubted(seconds, ends):
    """Rows with 8.4 times the noise so far end a part after a window, and not at first."""
    arm = Arm()
    arm.moves(seconds)
    noise = arm.state.innovation.noise[0]
    arm.state.innovation.recent[0] = 9.3 * noise
    arm.moves(DT)
    assert 8.0 < arm.state.innovation.recent[0] / noise < 9.0 or ends
    assert (arm.state.wait[0] > 0.0) == ends


@pytest.mark.parametrize(
    'friction', [{}, {'lost': LOST}, {'changed': CHANGED}, {'changed': -CHANGED}]
)
def test_interval_holds_if_friction_grows_with_the_load_or_changes(friction):
    """By one standard deviation of what is assumed: the mass is off by less than two of its own.

    Without the columns it was off by 23 and by 66.
    """
    arm = Arm()
    arm.moves(3.0, lost=friction.get('lost', 0.0))
    arm.state.age[0] = 20.0  # s, in which friction may have changed
    arm.changes += 1
    mass = arm.moves(1.5, 1.0, **friction)
    assert arm.state.load[DEVIATION] < 2.0 * LOST  # of 1 kg
    assert mass == pytest.approx(1.0, abs=2.0 * arm.state.load[DEVIATION])


def test_time_is_counted_in_which_friction_may_change():
    """From the last moment at which an empty hand was learned anew."""
    arm = Arm()
    arm.moves(1.5, 1.0)
    assert arm.state.age[0] == 0.0
    arm.changes += 1
    arm.moves(1.5)
    assert arm.state.age[0] == pytest.approx(1.5 - DT)
    arm.changes += 1
    arm.moves(1.0, 1.0)  # what was held before is nothing
    assert arm.state.age[0] == pytest.approx(1.0 - DT)


def test_hand_that_held_something_at_first_is_empty_once_it_is_put_down():
    """What is held then counts from the lightest, whatever the first window held."""
    arm = Arm()
    arm.moves(1.5, 1.0)
    arm.changes += 1
    assert arm.moves(1.5) == pytest.approx(-1.0, abs=0.05)
    arm.changes += 1
    assert arm.moves(1.5, 1.0) == pytest.approx(1.0, abs=0.05)


def test_rows_of_an_empty_hand_join_those_before_until_they_make_a_window():
    arm = Arm()
    arm.moves(1.5)
    before = arm.state.rows[BEFORE]
    arm.changes += 1
    arm.moves(1.5)
    assert arm.state.rows[BEFORE] == before
    arm.changes += 1
    arm.moves(DT)
    assert before + 50.0 < arm.state.rows[BEFORE] < before + 150.0


def test_rows_at_rest_count_little_and_are_no_motion():
    """1e-6 of the weight of rows that move; none of a thousand is one of the window."""
    arm = Arm()
    arm.moves(10.0, velocity=np.full(N, 3e-7))
    assert arm.state.rows.sum() < 1e-4
    assert arm.state.complete[0] == 0.0


def test_rows_are_kept_apart_and_then_used_in_two_halves():
    state = part(State)
    state.complete[0] = 1.0
    for _ in range(10):
        state.rows[LATEST] += 15.0
        weighing.promote(SETTINGS, state)
    # 150 rows: 15 are kept apart; a half of 105 was full, and 30 are of the next
    assert state.rows.tolist() == [0.0, 105.0, 30.0, 15.0, 0.0]
