# SPDX-License-Identifier: Apache-2.0
"""What P^ absorbs of friction: found whatever is carried, small where X does not describe it."""

from __future__ import annotations

import numpy as np
import pytest
from law_part import part

from blf_dsc_controller.law import motor_friction
from blf_dsc_controller.law.motor_friction import Settings, State, Work

N, P, M = 2, 3, 4  # joints, parameters, entries of theta: the last is friction
SETTINGS = Settings(filter_pole=30.0, length=200, period=0.01, least_weight=1e-9)
ROTORS = np.array([0.0, 0.0, 0.25])
THETA = np.array([1.0, -2.0, 0.75, 5.0])
SHARE = np.array([0.3, -0.2, 0.1])  # P_f
R = np.eye(M)


class Observer:
    """`observer.enabled` of the settings of a law."""

    enabled = 1


def new():
    """An empty state, and scratch."""
    sizes = {'n': N, 'p': P, 'm': M, 'observer': Observer()}
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
        g = motor_friction.unexplained(state, row, 1.0, i, ROTORS, THETA)
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


def test_sensors_pass_the_poles_of_a_row():
    state, _ = new()
    sensed = np.array([3.0, -1.0])
    for _ in range(1000):
        motor_friction.pass_poles(SETTINGS, state, sensed, 1e-4)
    t = 30.0 * 0.1
    np.testing.assert_allclose(
        state.sensed2, sensed * (1.0 - (1.0 + t) * np.exp(-t)), rtol=5e-3
    )
