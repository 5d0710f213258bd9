# SPDX-License-Identifier: Apache-2.0
"""The position loops that users of soft arms report, and this law: figures of STUDIES.md."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

pytest.importorskip('mujoco', reason='needs MuJoCo: pip install mujoco')


@pytest.fixture
def holding():
    return importlib.import_module('benchmark.holding')


def test_a_position_loop_sags_as_users_report_and_this_law_does_not(holding):
    """Within a degree of the page's angles; the gears behind the encoders are what is left."""
    sagging = holding.with_position_loop(holding.OPENARM)
    degrees = -np.degrees([each.position for each in sagging])
    np.testing.assert_allclose(degrees, [18.8, 28.9, 39.0, 49.4, 60.6], atol=1.0)
    assert holding.share(sagging, 0.0) == pytest.approx(0.65, abs=0.02)
    held = holding.with_this_law(holding.OPENARM)
    assert max(each.error for each in held) == pytest.approx(3.6e-3, rel=0.1)


def test_a_gravity_model_that_falls_short_leaves_an_error_and_this_law_does_not(
    holding,
):
    low = holding.with_position_loop(holding.WIDOWX)
    assert max(each.error for each in low) == pytest.approx(7.2e-3, rel=0.1)
    held = holding.with_this_law(holding.WIDOWX)
    assert max(each.error for each in held) == pytest.approx(4.0e-3, rel=0.1)
