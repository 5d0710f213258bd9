# SPDX-License-Identifier: Apache-2.0
"""Coulomb friction is learned from its flips: an unknown sine of the reference is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paper_case import configured

from blf_dsc_controller import load_loop, simulate
from blf_dsc_controller.configuration.nodes import locate
from blf_dsc_controller.law import friction
from blf_dsc_controller.law.factory import controller_of, estimate_names
from blf_dsc_controller.studies.monte_carlo import load_study
from blf_dsc_controller.studies.report import compare
from blf_dsc_controller.studies.runs import run_chunk

TONE = 3.7699111843077517  # rad/s, last of the preset ur5e
BROKEN = [*(('monte_carlo_ur5e', run) for run in (51, 179, 200, 274)), ('monte_carlo_panda', 423)]
"""Runs in which friction learned from the window alone, 0.37 to 0.9 of 0.73 to 1.23 N m on light
drives, or partial windows that are not taken back, leave a bound that is kept without learning."""


def test_sine_at_a_frequency_of_the_reference_is_not_learned_as_friction():
    wrist = slice(3, 6)
    true = np.array([0.9, 0.9, 0.9])  # N m; the controller begins with 1.1 N m
    plant = {
        'duration': 15.0,
        'events.begin': [100.0],
        'disturbance.coulomb': [6.0, 6.0, 6.0, *true],
        'disturbance.stribeck': 0.0,
        'disturbance.amplitude': [0.0, 0.0, 0.0, 1.2, 1.2, 1.2],
        'disturbance.frequency': [TONE] * 6,
        'disturbance.phase': [0.0, 0.0, 0.0, 5.0, 5.0, 5.0],
    }
    loop = load_loop('ur5e', {'sim_plant': plant})
    record = simulate(loop.controller, loop.plant)
    run = record.run()
    assert not run.stops
    state = record.controller.state
    first = estimate_names(loop.controller).index('coulomb shoulder_pan_joint')
    learned, window = (
        theta[first : first + 6][wrist] / true for theta in (state.estimate, state.solution)
    )
    np.testing.assert_allclose(learned, 1.0, atol=0.2)
    assert (np.abs(window - 1.0) > 0.6).all()


@pytest.mark.parametrize(('name', 'run'), BROKEN)
def test_learning_breaks_no_bound_that_it_once_broke(name, run):
    study = load_study(locate(name))
    study = replace(study, settings=replace(study.settings, runs=run + 1))
    found = compare(study, run_chunk(study, run, 1))
    assert found['kept'] == {'with': 1, 'without': 1}
    assert found['above'] == []


def test_friction_is_not_forgotten_at_rest():
    """The sums age by what reversals tell, not by time."""
    learning = {'learning.coulomb': True, 'learning.viscous': True}
    law = controller_of(configured('recommended', 1.0, learning).controller)
    law.state.latched[0] = 1.0
    law.state.flip_sums[:] = [[0.4, 0.1], [1.0, 1.0]]
    before = law.state.flip_sums.copy()
    for _ in range(10_000):
        friction.measure_flips(law.settings, law.state, 0.001)
    np.testing.assert_array_equal(law.state.flip_sums, before)
    law.state.latched[0] = 0.0
    friction.measure_flips(law.settings, law.state, 0.001)
    assert law.state.since_latch[0] == 0.0


def test_other_friction_is_learned_within_some_reversals():
    """However long the arm has moved before."""
    law = controller_of(configured('recommended', 1.0, {'learning.coulomb': True}).controller)
    settings, state = law.settings, law.state
    state.latched[0] = 1.0
    column = friction.first_coulomb(settings)
    for k in range(30_000):
        sign, coulomb = (-1.0) ** (k // 300), 1.0 if k < 24_000 else 2.0  # N m
        state.filter2[0, column], state.filter2[0, -1] = sign, coulomb * sign
        friction.measure_flips(settings, state, 0.001)
    assert state.flip_sums[0, 0] / state.flip_sums[1, 0] == pytest.approx(2.0, abs=0.1)
