# SPDX-License-Identifier: Apache-2.0
"""The reference is the sum of its tones, and its derivatives are derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.core import reference

OFFSET = (0.5, -1.0, 2.0)
FREQUENCY, PHASE = (1.0, 2.7), (0.3, -1.1)
AMPLITUDE = ((0.3, 0.1), (0.0, -0.2), (0.25, 0.05))  # a row for each joint
VECTOR = reference.sinusoids_vector(OFFSET, np.ravel(AMPLITUDE), FREQUENCY, PHASE)


def sampled(t):
    out = np.full((3, 3), np.nan)
    reference.sinusoids(VECTOR, t, *out)
    return out


@pytest.mark.parametrize('t', [0.0, 1.234, 60.0])
def test_reference_is_the_sum_of_its_tones(t):
    qr, _, _ = sampled(t)
    expected = [
        offset
        + sum(a * np.cos(w * t + phase) for a, w, phase in zip(row, FREQUENCY, PHASE, strict=True))
        for offset, row in zip(OFFSET, AMPLITUDE, strict=True)
    ]
    np.testing.assert_allclose(qr, expected, atol=1e-15)


@pytest.mark.parametrize('t', [0.0, 1.234, 60.0])
def test_derivatives_are_those_of_the_reference(t):
    # Five points of step 1e-3: truncation and rounding stay below 1e-12.
    h = 1e-3
    points = np.array([sampled(t + side * h) for side in (-2, -1, 1, 2)])
    rate = (points[0] - 8.0 * points[1] + 8.0 * points[2] - points[3]) / (12.0 * h)
    _, dqr, ddqr = sampled(t)

    np.testing.assert_allclose(dqr, rate[0], atol=1e-11)
    np.testing.assert_allclose(ddqr, rate[1], atol=1e-11)


def test_papers_reference_is_at_rest_at_the_start():
    vector = reference.sinusoids_vector((1.9935, 1.3961), (0.3, 0.3), (1.0,), (0.0,))
    qr, dqr, ddqr = np.full((3, 2), np.nan)
    reference.sinusoids(vector, 0.0, qr, dqr, ddqr)
    np.testing.assert_allclose(qr, [2.2935, 1.6961], rtol=1e-15)
    np.testing.assert_array_equal(dqr, 0.0)
    np.testing.assert_allclose(ddqr, -0.3, rtol=1e-15)
