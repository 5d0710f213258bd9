# SPDX-License-Identifier: Apache-2.0
"""The sliding window, its excitation, and rejected columns."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import (
    closed_loop,
    controller,
    plant,
    quick,
)
from paper_case import configured, run

from blf_dsc_controller.factory.estimate import estimate_names
from blf_dsc_controller.law import (
    window,
)


class Window:
    """A window, its history, and for comparison a running sum that is never restarted."""

    def __init__(self, n, m, length):
        self.ring = np.zeros((length, n, m + 1))
        self.running, self.fresh, self.half, self.naive = np.zeros((4, m + 1, m + 1))
        self.cursor, self.rows = np.zeros((2, 1))
        self.history = []

    def push(self, row):
        self.naive += terms(row) - terms(self.ring[int(self.cursor[0])])
        window.push_row(self, row)
        self.history = [*self.history, row][-len(self.ring) :]

    def direct(self):
        """Sum over the rows in the window, in the order they came."""
        return sum(map(terms, self.history))


def terms(row):
    """[X | u]^T [X | u] (m + 1, m + 1), of which the window keeps the upper triangle."""
    return np.triu(sum(np.outer(joint, joint) for joint in row))


def means(rows):
    """Phi (m, m) and b (m,) of rows (k, n, m + 1)."""
    X, u = rows[:, :, :-1], rows[:, :, -1]
    return np.einsum('kia,kib->ab', X, X) / len(rows), np.einsum(
        'kia,ki->a', X, u
    ) / len(rows)


def test_sum_does_not_drift():
    """At each wrap every bit is that of a new sum over the ring, also after a large transient.

    Terms of 1e16 round at 1; a running sum keeps that error forever, the window for one wrap.
    """
    random = np.random.default_rng(3)
    sliding = Window(2, 3, 25)
    for push in range(1, 20 * 25 + 1):
        sliding.push(random.normal(size=(2, 4)) * (1e8 if push < 30 else 1.0))
        if push % 25 == 0:
            np.testing.assert_array_equal(sliding.running, sliding.direct())
            np.testing.assert_array_equal(sliding.fresh, 0.0)
    assert np.abs(sliding.naive - sliding.direct()).max() > 1.0


def test_warm_started_iteration_tracks_the_minimum_eigenvalue_in_a_loop():
    """Never below it (a Rayleigh quotient cannot be), and close once the window has filled."""
    law = controller(quick())
    evaluations = [
        (
            law.state.latch.lambda_min[0],
            np.linalg.eigvalsh(law.signals.scratch.window.Phi)[0],
        )
        for sample in closed_loop(law, plant(), 4.0)
        if sample.k > 0 and sample.k % law.settings.window.interval == 0
    ]
    found, exact = np.transpose(evaluations)
    assert np.all(found >= exact - 1e-13)
    filled = slice(1000 // law.settings.window.interval, None)
    np.testing.assert_allclose(found[filled], exact[filled], rtol=1e-3)
    assert np.median(found[filled] / exact[filled] - 1.0) < 1e-6


def learned(preset, duration, learning, arm):
    """Estimates by name at the end of a run, and which columns are still estimated."""
    config = configured(preset, duration, learning, arm)
    state = run(config).controller.state
    names = estimate_names(config.controller)[3:]
    return [
        dict(zip(names, values[3:], strict=True))
        for values in (state.estimate, state.latch.active)
    ]


def test_same_columns_are_accepted_on_a_two_tone_reference():
    """Bias and sine are the whole disturbance: only the trapezoid's T^2 and the leakage remain."""
    estimate, active = learned('two_tone', 9.0, {}, {})
    assert all(active.values())
    for joint in ('joint1', 'joint2'):
        for name, true in (('bias', 0.1), ('sin 1 rad/s', 0.1), ('cos 1 rad/s', 0.0)):
            assert estimate[f'{name} {joint}'] == pytest.approx(true, abs=1e-3)


def test_cosine_columns_are_rejected_on_the_reference_of_the_paper():
    """With exact tracking cos t on both joints is the column of P2: a1 + a2 = -0.6 cos t.

    What is rejected is removed from Phi and b altogether, not merely small.
    """
    learning = {'two_link.frequencies': [1.0], 'two_link.bias': False}
    config = configured('recommended', 7.99, learning)  # ends with an evaluation of Phi
    law = run(config).controller
    names = estimate_names(config.controller)[3:]
    on = law.state.latch.active > 0.0
    rejected = [name for name, kept in zip(names, on[3:], strict=True) if not kept]
    assert rejected
    assert all(name.startswith('cos 1 rad/s') for name in rejected)
    np.testing.assert_allclose(law.state.estimate[~on], 0.0, atol=1e-12)
    Phi, b = means(law.state.window.ring[:, :, np.append(on, True)])
    np.testing.assert_allclose(
        law.signals.scratch.window.Phi[np.ix_(on, on)], Phi, atol=1e-10
    )
    np.testing.assert_allclose(law.signals.scratch.window.b[on], b, atol=1e-10)
    np.testing.assert_array_equal(law.signals.scratch.window.Phi[np.ix_(~on, on)], 0.0)
    np.testing.assert_array_equal(law.signals.scratch.window.b[~on], 0.0)
    assert np.linalg.eigvalsh(Phi)[0] >= law.settings.excitation.excitation_threshold


def test_columns_are_not_checked_before_the_parameters_alone_are_excited():
    """An arm at rest excites nothing, so no column is rejected."""
    still = {'reference.amplitude': [0.0, 0.0], 'reference.offset': [2.2935, 1.6961]}
    _, active = learned(
        'recommended', 8.0, {'two_link.frequencies': [1.0], **still}, {}
    )
    assert all(active.values())
