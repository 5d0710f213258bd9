# SPDX-License-Identifier: Apache-2.0
"""An exciting reference: as predicted, within limits, and what it is good for."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.params_file import load_loop
from blf_dsc_controller.configuration.reference import MotionLimits
from blf_dsc_controller.law.exciting_reference import ExcitationProblem, search
from blf_dsc_controller.reference.limits import MotionError
from blf_dsc_controller.simulation.loop import simulate

P = np.array([1.0, 0.32, 0.4])
SIGMA = ControllerConfig().learning.excitation_threshold


def excitation(name):
    reference = load_loop(name).controller.reference
    names = ('offset', 'amplitude', 'frequency', 'phase')
    parameters = {one: getattr(reference, one) for one in names}
    return ExcitationProblem(ControllerConfig(), P, 0.8, 2).evaluate(parameters)


@cache
def run(name, phase=0.0):
    """Samples of 16 s: the window of 2 pi s is then full of the reference alone."""
    loop = load_loop(name)
    disturbance = replace(loop.plant.disturbance, phase=(phase, phase))
    plant = replace(loop.plant, disturbance=disturbance, duration=16.0)
    return simulate(loop.controller, plant)


def parameter_error(record):
    return np.linalg.norm(record.sample(-1).estimate[:3] - P) / np.linalg.norm(P)


@pytest.mark.parametrize('name', ['recommended', 'excitation'])
def test_predicted_excitation_is_the_loop_s(name):
    """The loop's is sampled, and of the arm's own motion, which is within a milliradian."""
    measured = run(name).sample(-1).lambda_min[0]
    assert excitation(name).lambda_min == pytest.approx(measured, rel=0.01)


def test_chosen_reference_excites_far_more_than_the_paper_s():
    paper, chosen = excitation('recommended').lambda_min, excitation('excitation').lambda_min
    assert SIGMA < paper < 2.0 * SIGMA
    # A bias column alone brings an eigenvalue of 1: with these columns there is no more to have.
    assert 0.99 < chosen <= 1.0


def test_chosen_reference_keeps_the_limits_and_is_tracked_within_the_bound():
    assert excitation('excitation').ratios.max() <= 1.0
    record = run('excitation')
    xi1, bound = record.samples[:, 4:6], record.samples[:, 12:14]
    assert np.abs(xi1 / bound).max() < 1.0


def test_chosen_reference_tells_the_worst_disturbance_from_the_parameters():
    """A cosine of the paper's frequency looks like one of its parameters there, and not here."""
    quarter = 0.5 * np.pi
    assert parameter_error(run('recommended', quarter)) > 0.1
    assert parameter_error(run('excitation', quarter)) < 0.01


def test_search_keeps_its_limits_is_repeatable_and_beats_where_it_starts():
    config = replace(ControllerConfig(), limits=MotionLimits(velocity=(0.5, 0.8)))
    problem = ExcitationProblem(config, P, 0.5, 1)
    x, again = (search(problem, 3, 1) for _ in range(2))
    np.testing.assert_array_equal(x, again)
    reached = problem.evaluate(problem.parameters(x))
    assert reached.ratios.max() <= 1.0
    assert reached.ratios[1].max() > 0.9  # the velocity is what holds it back
    random = np.random.default_rng(0)
    for _ in range(20):
        other = problem.evaluate(problem.parameters(random.normal(0.0, 0.2, 6)))
        if other.ratios.max() <= 1.0:
            assert other.lambda_min < reached.lambda_min


def test_without_torque_to_spare_none_is_found():
    still = replace(
        ControllerConfig(),
        limits=MotionLimits(position_lower=(0.0, 0.0), position_upper=(0.5, 0.5)),
    )
    with pytest.raises(MotionError, match='in 1 searches'):
        search(ExcitationProblem(still, P, 0.1, 1), 0, 1)


def test_the_tool_writes_a_preset_that_loads(tmp_path, capsys):
    path = tmp_path / 'mine.yaml'
    assert main(['excite', str(path), '--harmonics', '1', '--starts', '1']) == 0
    reference = load_loop(path).controller.reference
    assert reference.frequency == (1.0, 1.0)
    assert reference.phase == (0.0, -0.5 * np.pi)
    assert len(reference.amplitude) == 4
    assert main(['excite', str(path)]) == 1
    assert 'exists already' in capsys.readouterr().err
    assert main(['excite', str(tmp_path / 'other.yaml'), '--guess', '1.0']) == 1
    assert '--guess has 1 values' in capsys.readouterr().err
