# SPDX-License-Identifier: Apache-2.0
"""Exciting references: their predicted excitation, limits, clearance and benefit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from random_arm import chain_of, random_urdf

from blf_dsc_controller import ControllerConfig, load_loop, simulate
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.identification.clearance import Clearance, distance
from blf_dsc_controller.identification.exciting_reference import (
    ExcitationProblem,
    search,
)

P = np.array([1.0, 0.32, 0.4])
SIGMA = 0.003


@cache
def run(name, phase=0.0):
    """Record of 16 s: at its end the window of 2 pi s contains only the reference."""
    loop = load_loop(name)
    disturbance = replace(loop.plant.disturbance, phase=(phase, phase))
    plant = replace(loop.plant, disturbance=disturbance, duration=16.0)
    return simulate(loop.controller, plant)


def parameter_error(record):
    return np.linalg.norm(record.sample(-1).estimate[:3] - P) / np.linalg.norm(P)


def test_chosen_reference_excites_far_more_than_that_of_the_paper_within_the_limits():
    paper, chosen = (
        run(name).sample(-1).lambda_min[0] for name in ('recommended', 'excitation')
    )
    assert SIGMA < paper < 2.0 * SIGMA
    # A bias column alone has an eigenvalue of 1: with these columns no more is
    # possible.
    assert 0.99 < chosen <= 1.001
    found = run('excitation').run()
    limits = load_loop('excitation').controller.limits
    assert np.abs(found.error / found.bound).max() < 1.0
    assert (
        np.abs(run('excitation').truths[:, -2:]).max(axis=0) < limits.velocity
    ).all()
    # On the paper's, a cosine of its frequency looks like one of the parameters.
    quarter = 0.5 * np.pi
    assert parameter_error(run('recommended', quarter)) > 0.1
    assert parameter_error(run('excitation', quarter)) < 0.01


# leave a random arm some room
LIGHT = {
    'robot.payload': 0.2,
    'torque.limit': [60.0] * 3,
    'insist': ['torque.limit'],  # twice the URDF's
}


@cache
def chain_problem():
    """A random arm of three joints, with its base high above the floor."""
    urdf = random_urdf(3, seed=5)[0]
    config = build(ControllerConfig, {'robot.urdf': urdf, 'robot.tip': 'tip', **LIGHT})
    return config, ExcitationProblem(config, 1, 0.02, -3.0)


def test_search_keeps_its_limits_is_repeatable_and_beats_random_motions():
    problem = chain_problem()[1]
    x = search(problem, 0, 1)
    np.testing.assert_array_equal(search(problem, 0, 1), x)
    reached = problem.evaluate(problem.parameters(x))
    assert reached.is_allowed
    assert reached.ratios.max() > 0.9  # a limit is active
    random = np.random.default_rng(0)
    others = [
        problem.evaluate(problem.parameters(problem.start(random))) for _ in range(100)
    ]
    allowed = [other.gain for other in others if other.is_allowed]
    assert len(allowed) > 3
    assert max(allowed) < reached.gain


def test_torque_ratio_is_the_larger_with_and_without_the_payload():
    config, problem = chain_problem()
    motion = problem.parameters(np.full(9, 0.1))

    def ratios(payload):
        robot = replace(config.robot, payload=payload)
        return (
            ExcitationProblem(replace(config, robot=robot), 1).evaluate(motion).ratios
        )

    light, heavy = ratios(0.0), ratios(0.2)
    assert (heavy >= light * (1.0 - 1e-12)).all()
    assert (heavy[3] > 1.001 * light[3]).any()


def test_tool_writes_a_preset_for_an_arm_from_a_urdf_that_keeps_it_from_the_floor(
    tmp_path, capsys
):
    (tmp_path / 'arm.urdf').write_text(random_urdf(3, seed=5)[0])
    config = tmp_path / 'arm.yaml'
    config.write_text(
        '/**:\n  ros__parameters:\n    robot: {tip: tip, payload: 0.2, '
        f'urdf: {tmp_path}/arm.urdf}}\n    torque.limit: [60.0, 60.0, 60.0]\n'
        '    insist: [torque.limit]\n'
        '    limits.velocity: [0.1, 0.1, 0.1]\n'
    )
    out = tmp_path / 'mine.yaml'
    command = [
        'excite',
        str(out),
        '--config',
        str(config),
        '--harmonics',
        '1',
        '--starts',
        '1',
    ]
    assert main([*command, '--radius', '0.02', '--floor', '3.0']) == 1
    assert 'no reference found in 1 searches' in capsys.readouterr().err
    assert main([*command, '--radius', '0.02', '--floor', '-3.0']) == 0
    assert 'a window leaves' in ' '.join(capsys.readouterr().out.split())
    config.write_text(config.read_text() + out.read_text())
    loop = load_loop(config).controller
    assert loop.reference.type == 'sinusoids'
    assert loop.reference.phase == (0.0, -0.5 * np.pi)
    amplitude = np.reshape(loop.reference.amplitude, (3, 2))
    speed = np.hypot(*amplitude.T) * loop.reference.frequency[0]
    assert 0.08 < speed.max() <= 0.95 * 0.1 + 1e-4
    assert main(['excite', str(out), '--config', 'recommended', '--force']) == 1
    assert 'got model two_link' in capsys.readouterr().err


# Room around an arm.


def panda(radius=0.07, floor=0.0):
    return Clearance(chain_of('panda'), radius, floor)


def test_distance_is_the_minimum_over_all_points_of_both_lines():
    along = np.linspace(0.0, 1.0, 300)[:, np.newaxis]
    for a, b, c, d in np.random.default_rng(0).normal(size=(100, 4, 3)):
        first = a + (b - a) * along
        second = c + (d - c) * along
        minimum = np.linalg.norm(first[:, np.newaxis] - second, axis=-1).min()
        assert distance(a, b, c, d) == pytest.approx(minimum, abs=1e-3)
    for line, other, expected in (
        ([(0, 0, 0), (1, 0, 0)], [(2, 1, 0), (3, 1, 0)], 2**0.5),  # parallel
        ([(0, 0, 0), (1, 0, 0)], [(0.5, -1, 0), (0.5, 1, 0)], 0.0),  # crossing
        ([(0, 0, 0), (0, 0, 0)], [(-1, 2, 0), (1, 2, 0)], 2.0),  # a point
        ([(0, 0, 0), (0, 0, 0)], [(0, 0, 3), (0, 0, 3)], 3.0),  # two points
    ):
        assert distance(*np.array([*line, *other], dtype=float)) == pytest.approx(
            expected
        )


def test_panda_must_not_touch_itself_or_the_floor():
    """Unless the floor is lower, and with more room if the links are thinner."""
    upright = np.array((0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, 0.0))
    folded = np.array((0.0, 0.0, 0.0, -3.0, 0.0, 0.2, 0.0))  # the hand in the upper arm
    low = np.array((0.0, 1.7, 0.0, -0.5, 0.0, 1.0, 0.0))  # below the floor
    assert panda().room(upright).min() >= 0.0
    assert panda().room(folded).min() < 0.0
    assert panda().room(low).min() < 0.0 < panda(floor=-1.0).room(low).min()
    assert panda(radius=0.03).room(folded).min() > panda().room(folded).min()
