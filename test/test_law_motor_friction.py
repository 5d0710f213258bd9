# SPDX-License-Identifier: Apache-2.0
"""Friction of the motors by their sensors: found whatever is carried or pushes."""

from __future__ import annotations

import numpy as np
import pytest
from law_part import part

from blf_dsc_controller.law import motor_friction
from blf_dsc_controller.law.motor_friction import Settings, State, Work

# joints, parameters, entries of theta: the last is Coulomb friction
N, P, M = 2, 3, 4
SETTINGS = Settings(
    size=P, filter_pole=30.0, length=200, period=0.01, least_weight=1e-9
)
ROTORS = np.array([0.0, 0.0, 0.25])
THETA = np.array([1.0, -2.0, 0.75, 5.0])
INITIAL = np.array([0.9, -2.5, 0.75, 4.0])
SHARE = np.array([0.3, -0.2, 0.1])  # P_f
R = np.eye(M)


class Observer:
    """`observer.enabled` of the settings of a law."""

    enabled = 1


def new(settings=SETTINGS):
    """An empty state, and scratch."""
    sizes = {'n': N, 'p': P, 'm': M, 'observer': Observer(), 'motors': settings}
    return part(State, **sizes), part(Work, **sizes)


def rows(seconds, seed=0):
    """Rows [X | D] (n, m) of a motion."""
    drawn = np.random.default_rng(seed)
    for _ in range(round(seconds / SETTINGS.period)):
        yield drawn.normal(size=(N, M))


def add(state, X, friction, load=0.0, *, moving=1.0):
    """Add a row of joints with weight 1; motors have `friction` (n,) that D does not describe."""
    links = X[:, :P] @ (THETA[:P] - ROTORS) + load
    u = X[:, :P] @ ROTORS + links + X[:, P:] @ THETA[P:] + friction
    state.sensed2[:] = links
    row = np.column_stack((X, u))
    share = motor_friction.fade(SETTINGS, state, moving)
    for i in range(N):
        g = motor_friction.friction_of_row(state, row, 1.0, i, ROTORS, INITIAL, THETA)
        motor_friction.add_row(state, row, i, g, share)


def solved(state, work):
    """P_f, whose s^2 has come to rest."""
    for _ in range(50):
        motor_friction.solve(SETTINGS, state, work, R)
    return state.solution.copy()


def test_it_is_found_whatever_the_links_carry():
    state, work = new()
    for k, X in enumerate(rows(4.0)):
        add(state, X, X[:, :P] @ SHARE, load=np.array([30.0, -9.0]) * (k > 200))
    np.testing.assert_allclose(solved(state, work), SHARE, atol=1e-6)
    assert state.residual[0] == pytest.approx(0.0, abs=1e-9)


def test_it_is_that_of_least_squares_with_the_prior():
    """Weighted by a = s^2 CORRELATION / T; sums against numpy's."""
    state, work = new()
    drawn = np.random.default_rng(1)
    every = [(X, drawn.normal(size=N)) for X in rows(2.0)]
    for X, friction in every:
        add(state, X, friction)
    found = solved(state, work)
    share = 1.0 / (60.0 + 200.0)  # a tenth of three windows, and a window
    weights = np.cumprod([1.0 - 1.0 / (61.0 + k) for k in range(200)][::-1])[::-1]
    kept = np.append(weights[1:], 1.0)
    shares = kept / (61.0 + np.arange(200))
    assert shares[-1] == pytest.approx(share)
    Phi = sum(
        w * X[:, :P].T @ X[:, :P] for w, (X, _) in zip(shares, every, strict=True)
    )
    b = sum(w * X[:, :P].T @ f for w, (X, f) in zip(shares, every, strict=True))
    square = sum(w * f @ f for w, (_, f) in zip(shares, every, strict=True))
    a = state.residual[0] * 0.2 / 2.0
    expected = np.linalg.solve(Phi + a * np.eye(P), b)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    residual = square - 2.0 * found @ b + found @ Phi @ found
    assert state.residual[0] == pytest.approx(residual)


def test_friction_that_X_does_not_describe_leaves_it_small():
    """A motor that drags with 20 N m: a fifth of a second has hardly a row that is independent."""
    state, work = new()
    for X in rows(0.2):
        add(state, X, np.array([20.0, 0.0]))
    Phi = state.Phi + np.triu(state.Phi, 1).T
    by_rows_alone = np.linalg.solve(Phi, state.b)
    found = solved(state, work)
    assert np.linalg.norm(found) < 0.2 * np.linalg.norm(by_rows_alone)


def test_rest_forgets_nothing():
    state, work = new()
    for X in rows(2.0):
        add(state, X, X[:, :P] @ SHARE)
    before = state.Phi.copy()
    for _ in range(1000):
        add(state, np.zeros((N, M)), np.zeros(N), moving=0.0)
    np.testing.assert_array_equal(state.Phi, before)
    np.testing.assert_allclose(solved(state, work), SHARE, atol=1e-6)


def test_friction_that_changes_is_followed_within_some_windows():
    """Means over three windows: e^-4 of the old one is left after twelve."""
    state, work = new()
    for X in rows(12.0):
        add(state, X, X[:, :P] @ SHARE)
    for X in rows(24.0, seed=1):
        add(state, X, -X[:, :P] @ SHARE)
    np.testing.assert_allclose(solved(state, work), -SHARE, rtol=0.1)


def test_it_follows_its_solution_at_the_rate_of_the_learning():
    state, work = new()
    state.solution[:] = SHARE
    gain = np.array([0.5, 0.5, 0.25, 9.0])
    for _ in range(1000):
        motor_friction.follow(state, work, 2.0, gain, 1e-3)
    left = 1.0 - np.exp([-1.0, -1.0, -0.5])
    np.testing.assert_allclose(state.absorbed, SHARE * left, rtol=1e-3)
    last = 1e-3 * 2.0 * gain[:P] * (SHARE - work.before)
    np.testing.assert_allclose(state.absorbed - work.before, last, rtol=1e-9)


COLUMN = Settings(size=M, filter_pole=30.0, length=200, period=0.01, least_weight=1e-9)
"""That of a law whose last column is viscous friction."""


def followed(state, active=1.0):
    """Return the rate of theta^ by the columns that the sensors show."""
    rate = np.full(M, 9.0)
    shown = np.array([1.0] * P + [active])
    motor_friction.follow_columns(state, INITIAL, shown, THETA, rate)
    return rate


def test_columns_of_friction_are_found_whatever_pushes_the_arm():
    """6 N m s/rad; the estimate is 5, the initial one 4.  The sensors show the pushes, too."""
    state, work = new(COLUMN)
    for k, X in enumerate(rows(4.0)):
        push = np.array([30.0, -9.0]) * (k > 200)
        add(state, X, X[:, :P] @ SHARE + X[:, P:] @ [1.0], load=push)
    np.testing.assert_allclose(solved(state, work), [*SHARE, 2.0], atol=1e-6)
    np.testing.assert_allclose(followed(state), [9.0, 9.0, 9.0, 1.0], atol=1e-6)


def test_rejected_column_stays():
    state, _ = new(COLUMN)
    state.solution[P] = 2.0
    assert followed(state, active=0.0).tolist() == [9.0, 9.0, 9.0, 9.0]


def test_without_rows_columns_are_as_before_the_start():
    state, _ = new(COLUMN)
    assert followed(state).tolist() == [9.0, 9.0, 9.0, INITIAL[P] - THETA[P]]


def test_what_else_is_known_of_friction_leaves_that_of_its_own_column():
    state, _ = new()
    state.absorbed[:] = SHARE
    X = next(rows(0.01))
    links = X[:, :P] @ (THETA[:P] - ROTORS)
    state.sensed2[:] = links
    friction = X[:, :P] @ SHARE + X[:, P:] @ [7.0]
    row = np.column_stack((X, X[:, :P] @ ROTORS + links + friction))
    for i in range(N):
        e = motor_friction.unexplained(state, row[i], i, ROTORS, THETA, P)
        assert e == pytest.approx(7.0 * X[i, P])
        e = motor_friction.unexplained(state, row[i], i, ROTORS, THETA, -1)
        assert e == pytest.approx(2.0 * X[i, P])


def test_poles_of_the_sensors_are_emptied_with_those_of_the_rows():
    state, _ = new()
    motor_friction.pass_poles(SETTINGS, state, np.array([3.0, -1.0]), 0.1)
    motor_friction.forget(state)
    assert not state.sensed1.any()
    assert not state.sensed2.any()


def test_sensors_pass_the_poles_of_a_row():
    state, _ = new()
    sensed = np.array([3.0, -1.0])
    for _ in range(1000):
        motor_friction.pass_poles(SETTINGS, state, sensed, 1e-4)
    t = 30.0 * 0.1
    np.testing.assert_allclose(
        state.sensed2, sensed * (1.0 - (1.0 + t) * np.exp(-t)), rtol=5e-3
    )
