# SPDX-License-Identifier: Apache-2.0
"""Contacts: phases, and what a load in the tip explains."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from law_part import part as part_of

from blf_dsc_controller.law import contact
from blf_dsc_controller.law.contact import (
    EXPLAINED,
    TOUCHED,
    Seen,
    Settings,
    State,
    TipLoad,
    Work,
)
from blf_dsc_controller.numerics.algebra import cholesky_factor

H = 8.0  # threshold
DT = 1e-3  # s
SETTINGS = Settings(enabled=1, threshold=H, loads=1, freezes=1)
N, M = 2, 3  # joints, entries of theta


def part(layout):
    """An empty state, or scratch."""
    return part_of(layout, n=N, contact=SETTINGS)


@pytest.fixture
def state():
    """That before anything is large."""
    state = part(State)
    contact.forget_load(state)
    return state


def update(state, r, load, seconds, settings=SETTINGS, dt=DT):
    """Update the contact for some time of a constant r (n,), with S = 1 and X_L = 1 at (0, 0)."""
    work = part(Work)
    spread = np.eye(N)
    cholesky_factor(spread)
    rows = np.zeros((N, M + 1))
    rows[0, 0] = 1.0
    seen = Seen(rows, spread, np.array(r), np.hypot(*r))
    for _ in range(round(seconds / dt)):
        contact.update(settings, state, work, seen, load, dt)


def tip(mass, deviation):
    """A load of z_0 kg that pulls joint 0 by 10 N m per kg, in theta_0."""
    columns = np.zeros((M + 1, 10))
    columns[0, 0] = 10.0
    scale = np.zeros((4, 10))
    scale[0, 0] = 1.0
    return TipLoad(columns, scale, mass, deviation)


@pytest.mark.parametrize(
    ('mass', 'deviation', 'pull', 'expected'),
    [
        (0.0, 0.0, -10.0, EXPLAINED),  # 1 kg is picked up
        (0.0, 0.0, 10.0, TOUCHED),  # no load is lighter than nothing
        (2.0, 0.1, 10.0, EXPLAINED),  # 1 of 2 kg is put down
        (0.2, 0.1, 10.0, TOUCHED),  # 1 of 0.2 kg, eight deviations less than nothing
        (0.8, 0.1, 10.0, EXPLAINED),  # two deviations less
        (0.0, inf, 10.0, EXPLAINED),  # it is unknown what is held
    ],
)
def test_load_explains_no_more_than_is_held(state, mass, deviation, pull, expected):
    """z_0 goes to 1 or -1, and the mass with it, within 2 s: 10 filters of 0.2 s."""
    update(state, [pull, 0.0], tip(mass, deviation), 2.0, dt=5.0 * DT)
    assert state.phase[0] == expected
    loads = SETTINGS._replace(loads=0)
    update(state, [pull, 0.0], tip(mass, deviation), DT, loads)
    assert contact.is_touched(state)


def test_force_that_no_load_explains_is_a_contact_until_it_ends(state):
    update(state, [0.0, 10.0], tip(0.0, 0.0), DT)
    assert contact.is_touched(state)
    update(state, [0.0, 0.0], tip(0.0, 0.0), 0.19)
    assert contact.is_touched(state)
    update(state, [0.0, 0.0], tip(0.0, 0.0), 0.02)
    assert not contact.is_touched(state)


def test_load_must_explain_a_contact_without_a_break(state):
    """0.4 s, and 0.4 s again: it takes 0.5 s; between them r is small for less than 0.2 s."""
    state.phase[0] = TOUCHED
    for _ in range(2):
        update(state, [-10.0, 0.0], tip(0.0, 0.0), 0.4)
        assert contact.is_touched(state)
        update(state, [0.0, 0.0], tip(0.0, 0.0), 0.1)
    assert contact.is_touched(state)
    update(state, [-10.0, 0.0], tip(0.0, 0.0), 0.51)
    assert state.phase[0] == EXPLAINED


def test_only_a_contact_is_explained_by_a_load(state):
    """A load that is held says nothing of what touches the arm later."""
    update(state, [-10.0, 0.0], tip(0.0, 0.0), 1.0)
    assert (state.phase[0], state.explained[0]) == (EXPLAINED, 0.0)
    update(state, [0.0, 10.0], tip(0.0, 0.0), DT)
    update(state, [-10.0, 0.0], tip(0.0, 0.0), 0.4)
    assert contact.is_touched(state)


def test_load_is_filtered_from_r_as_by_bayes(state):
    """z ~ (z_0, P), e = C z + noise: of variance 1 in a sample, of 0.2 s / dt in the filter."""
    random = np.random.default_rng(6)
    work, dt = part(Work), 0.05
    C = work.columns[:] = random.normal(size=(N, 10))
    z = state.load[:] = random.normal(size=10)
    B = random.normal(size=(10, 10))
    P = state.load_covariance[:] = B @ B.T / 10.0
    r = np.array([3.0, -4.0])
    far = contact.filter_load(state, work, r, dt)
    z, P = 0.95 * z, P + 0.05 * (np.eye(10) - P)
    S = C @ P @ C.T
    e = r - C @ z
    assert far == pytest.approx(np.sqrt(e @ np.linalg.solve(S + np.eye(N), e)))
    K = P @ C.T @ np.linalg.inv(S + 4.0 * np.eye(N))
    np.testing.assert_allclose(state.load, z + K @ e)
    np.testing.assert_allclose(state.load_covariance, P - K @ C @ P, atol=1e-12)


def test_columns_of_the_load_are_whitened_as_r_is():
    """-X_L N D by the factor U of S = U^T U: U^-T of it."""
    random = np.random.default_rng(5)
    X, ND, B = (random.normal(size=each) for each in ((N, M), (M + 1, 10), (N, N)))
    S = B @ B.T + np.eye(N)
    spread, work = S.copy(), part(Work)
    cholesky_factor(spread)
    rows = np.column_stack((X, np.full(N, 7.0)))
    contact.fill_load_columns(work, Seen(rows, spread, np.zeros(N), 0.0), ND)
    U = np.linalg.cholesky(S).T
    np.testing.assert_allclose(work.columns, -np.linalg.solve(U.T, X @ ND[:M]))
