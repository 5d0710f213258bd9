# SPDX-License-Identifier: Apache-2.0
"""The known disturbance of a simulated arm, alone."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from law_part import part

from blf_dsc_controller.law import truth

# constant, amplitude [N m], frequency [rad/s] and phase of two joints
DISTURBANCE = np.array([[1.0, -2.0], [0.5, 4.0], [pi, 2.0 * pi], [0.0, 0.5 * pi]])


@pytest.mark.parametrize(
    ('known', 'feed_forward', 't', 'expected'),
    [
        (1, 0, 0.0, (1.0, 2.0)),  # the second one begins at its crest
        (1, 0, 0.5, (1.5, -6.0)),  # a quarter and half of a period later
        (0, 1, 0.5, (1.5, -6.0)),  # what is fed forward need not be known for (29)
        (0, 0, 0.5, (0.0, 0.0)),  # unknown: it stays what it was
    ],
)
def test_known_disturbance_is_a_constant_and_a_sinusoid_of_each_joint(
    known, feed_forward, t, expected
):
    settings = truth.Settings(known, feed_forward, np.zeros(3), DISTURBANCE)
    work = part(truth.Work, n=2)
    truth.update_disturbance(settings, work, t)
    np.testing.assert_allclose(work.disturbance, expected, atol=1e-12)
