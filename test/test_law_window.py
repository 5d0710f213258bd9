# SPDX-License-Identifier: Apache-2.0
"""The sliding window equals the direct sum over its rows: always, for any shape, without drift."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from blf_dsc_controller.law import window


class Window:
    """A window, its history, and for comparison a running sum that is never restarted."""

    def __init__(self, n, m, length):
        self.ring = np.zeros((length, n, m + 1))
        self.running, self.fresh, self.half, self.naive = np.zeros((4, m + 1, m + 1))
        self.cursor = 0
        self.history = []

    def push(self, row):
        oldest = self.ring[self.cursor].copy()
        self.naive += terms(row) - terms(oldest)
        rows = len(self.history)
        self.cursor = window.push_row(
            self.ring, self.cursor, self.running, self.fresh, self.half, row, rows
        )
        self.history = [*self.history, row][-len(self.ring) :]

    def direct(self):
        """Sum over the rows in the window, in the order they came."""
        return sum(map(terms, self.history))

    def newer_part(self):
        """Sum over the newer part of the rows, and their number."""
        newer = np.zeros_like(self.running)
        rows = window.newer_part(self.cursor, len(self.ring), self.fresh, self.half, newer)
        return newer, rows

    def average(self):
        m = len(self.running) - 1
        Phi, b = np.full((m, m), np.nan), np.full(m, np.nan)
        window.average_window(self.running, len(self.history), Phi, b)
        return Phi, b


def terms(row):
    """[X | u]^T [X | u] (m + 1, m + 1), of which the window keeps the upper triangle."""
    return np.triu(sum(np.outer(joint, joint) for joint in row))


@settings(max_examples=40)
@given(
    st.integers(1, 4), st.integers(1, 7), st.integers(1, 9), st.integers(1, 40), st.integers(0, 99)
)
def test_window_equals_the_direct_sum_whether_full_or_not(n, m, length, pushes, seed):
    random = np.random.default_rng(seed)
    sliding = Window(n, m, length)
    for _ in range(pushes):
        sliding.push(random.normal(size=(n, m + 1)))
        np.testing.assert_allclose(sliding.running, sliding.direct(), atol=1e-13 * n * pushes)

    assert sliding.cursor == pushes % length
    rows = np.array(sliding.history)
    X, u = rows[:, :, :-1], rows[:, :, -1]
    Phi, b = sliding.average()
    np.testing.assert_allclose(
        Phi, np.einsum('kia,kib->ab', X, X) / len(rows), atol=1e-13 * n * pushes
    )
    np.testing.assert_array_equal(Phi, Phi.T)
    np.testing.assert_allclose(b, np.einsum('kia,ki->a', X, u) / len(rows), atol=1e-13 * n * pushes)


@pytest.mark.parametrize('length', [2, 3, 12, 13])
def test_window_is_split_into_exact_parts_and_goes_on_with_the_newer_one(length):
    """At each position of the ring; what was removed never returns."""
    for begin in range(length):
        random = np.random.default_rng(begin)
        sliding = Window(2, 3, length)
        for _ in range(length + begin):
            sliding.push(random.normal(size=(2, 4)))
        newer, rows = sliding.newer_part()
        assert length // 4 <= rows <= length - length // 4
        assert 0 < rows < length
        sliding.history = sliding.history[-rows:]
        np.testing.assert_allclose(newer, sliding.direct(), atol=1e-12)

        sliding.running[:] = newer
        for _ in range(3 * length):
            sliding.push(random.normal(size=(2, 4)))
            np.testing.assert_allclose(sliding.running, sliding.direct(), atol=1e-12)
        newer, rows = sliding.newer_part()
        np.testing.assert_allclose(newer, sum(map(terms, sliding.history[-rows:])), atol=1e-12)


def test_sum_equals_that_of_the_ring_exactly_at_every_wrap():
    """At each wrap every bit is that of a new sum over the ring, so nothing can drift."""
    random = np.random.default_rng(3)
    sliding = Window(2, 3, 25)
    for push in range(1, 200 * 25 + 1):
        sliding.push(random.normal(size=(2, 4)))
        if push % 25 == 0:
            np.testing.assert_array_equal(sliding.running, sliding.direct())
            np.testing.assert_array_equal(sliding.fresh, 0.0)
    assert not np.array_equal(sliding.naive, sliding.direct())


def test_large_transient_leaves_no_trace_after_a_wrap():
    """Terms of 1e16 round at 1; a running sum keeps that error forever, the window for one wrap."""
    random = np.random.default_rng(4)
    sliding = Window(2, 3, 10)
    for push in range(60):
        sliding.push(random.normal(size=(2, 4)) * (1e8 if push < 15 else 1.0))
    exact = sliding.direct()

    assert np.abs(sliding.naive - exact).max() > 1.0
    np.testing.assert_array_equal(sliding.running, exact)


@pytest.mark.parametrize('length', [1, 7])
def test_constant_rows_average_to_themselves_from_the_first_row_on(length):
    row = np.array([[1.0, 2.0, 5.0], [0.5, -1.0, 3.0]])
    sliding = Window(2, 2, length)
    for _ in range(3 * length):
        sliding.push(row)
        Phi, b = sliding.average()
        np.testing.assert_allclose(Phi, row[:, :2].T @ row[:, :2], rtol=1e-14)
        np.testing.assert_allclose(b, row[:, :2].T @ row[:, 2], rtol=1e-14)
