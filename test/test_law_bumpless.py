# SPDX-License-Identifier: Apache-2.0
"""Learned parameters and friction enter the torque without a bump."""

from __future__ import annotations

import numpy as np
import pytest
from paper_case import configured
from test_law_consistency import run

from blf_dsc_controller.simulation.loop import simulate

LATCH = 6.79  # s
FRICTION = {'disturbance.viscous': [0.3, 0.2], 'disturbance.coulomb': [0.5, 0.3]}
COLUMNS = {'learning.viscous': True, 'learning.coulomb': True}


def test_tracking_error_stays_small_over_the_first_latch():
    """The estimate steps by half of P; without the handover the error reaches 0.42 mrad."""
    bumpless = run(12.0)
    paper = run(12.0, law={'learning.bumpless': False})

    assert bumpless.error[np.searchsorted(bumpless.t, LATCH - 0.1)] > 0.1
    assert bumpless.error[-1] < 1e-3
    assert bumpless.largest(LATCH).max() < 0.02e-3
    assert paper.largest(LATCH).max() > 0.4e-3


def test_disturbance_estimate_is_accurate_a_second_after_the_first_latch():
    end = LATCH + 1.0
    true = 0.1 + 0.1 * np.sin(end)
    errors = [
        np.abs(run(end, law={'learning.bumpless': choice}).controller.state.disturbance - true)
        for choice in (True, False)
    ]
    assert errors[0].max() < 0.02  # N m
    assert errors[1].max() > 0.1


@pytest.mark.parametrize(('preset', 'bound'), [('recommended', 0.01e-3), ('noisy', 0.05e-3)])
def test_learned_friction_is_compensated(preset, bound):
    with_columns = run(30.0, preset=preset, plant=FRICTION, law=COLUMNS)
    without = run(30.0, preset=preset, plant=FRICTION)

    assert with_columns.largest(15.0).max() < bound
    assert without.largest(15.0).max() > 3.0 * bound


def test_disturbance_in_telemetry_includes_friction():
    config = configured('recommended', 30.0, COLUMNS, FRICTION)
    found = simulate(config.controller, config.plant).run()
    disturbance = [f'disturbance {joint}' for joint in found.joints]
    estimated = found.learning.select(disturbance)[found.learning.stamp >= 20e9]
    true = found.truth.select(disturbance)[found.truth.stamp >= 20e9]

    moving = np.abs(found.velocity[found.stamp >= 20e9]).min(axis=1) > 0.1
    assert np.abs(true[moving]).max() > 0.5  # more than the 0.2 N m without friction
    np.testing.assert_allclose(estimated[moving], true[moving], atol=0.02)
