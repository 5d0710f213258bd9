# SPDX-License-Identifier: Apache-2.0
"""Efforts that are not what they are said to be: units, signs, mounting, limits, turns."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from nights import at_night
from random_arm import (
    PANDA,
    PANDA_CHAIN,
    PANDA_TEXT,
    measured,
    recording_of,
    reference_of,
    shake,
    truth_of,
)

from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.problems import is_usable, problems_of
from blf_dsc_controller.identification.summary import notes_of

ROBOT = Robot(urdf=PANDA_TEXT, tip='panda_hand_tcp')
TRUTH = truth_of(PANDA_CHAIN, 1)
TORQUE = 2  # row of a state
EVERY = 5  # samples of 1 ms


def moved(truth=TRUTH, reach=None, seed=2):
    """States (N, 3, n) at 200 Hz of a motion, which may be at most so wide [rad]."""
    reference = reference_of(PANDA_CHAIN, seed)
    if reach is not None:
        amplitude = reach / tones if (tones := len(reference.amplitude)) else 0.0
        reference = reference._replace(
            amplitude=np.full_like(reference.amplitude, amplitude)
        )
    return measured(shake(PANDA_CHAIN, truth, reference, 20.0), 3)[::EVERY]


def recorded(states):
    return recording_of(states, period=1e-3 * EVERY)


def with_torque(states, torque):
    changed = states.copy()
    changed[:, TORQUE] = torque
    return changed


@pytest.fixture(scope='module')
def wide():
    return moved()


@pytest.fixture(scope='module')
def right(wide):
    """What is found where efforts are what they are said to be."""
    return identify_arm(recorded(wide), ROBOT)


@pytest.fixture(scope='module')
def narrow():
    """Half a radian: the torque is mostly the mean of gravity and friction."""
    return moved(reach=0.5)


# those nearest to 1 are the hardest to see
FACTORS = (0.1, 10.0, 1000.0) if os.environ.get('NIGHTLY') else (0.1, 10.0)


@pytest.mark.parametrize('motion', ['narrow', *at_night('wide')])
def test_efforts_in_other_units_are_refused_and_right_ones_are_not(
    motion, right, request
):
    states = request.getfixturevalue(motion)
    found = right if motion == 'wide' else identify_arm(recorded(states), ROBOT)
    assert not list(problems_of(found, 'torque'))
    assert found.gravity == pytest.approx(1.0, abs=0.3)  # masses are off by 30 %
    for factor in FACTORS:
        other = with_torque(states, factor * states[:, TORQUE])
        wrong = identify_arm(recorded(other), ROBOT)
        assert not is_usable(wrong)
        named = 'IS DOUBLE' if factor > 1.0 else 'IS MISSING'
        assert named in next(problems_of(wrong, 'torque'))


def heavier_on_the_other_side():
    """The last body 4 times as heavy, its centre 10 cm beyond the axis of joint 6."""
    bodies = PANDA_CHAIN.inertias.copy()
    centre = bodies[-1, 1:4] / bodies[-1, 0]
    T = np.eye(4)
    T[:3, 3] = -2.0 * centre
    T[0, 3] -= 0.2
    bodies[-1] = inertia_of(4.0 * T @ pseudo_inertia(bodies[-1]) @ T.T)
    return TRUTH._replace(inertias=bodies)


def test_right_signs_stay_where_links_are_heavier_than_the_urdf_says():
    """Of joint 6 and 7, gravity of the URDF points the other way."""
    found = identify_arm(recorded(moved(heavier_on_the_other_side())), ROBOT)
    assert not found.reversed
    assert not any('ANOTHER MOUNTING' in each for each in problems_of(found, 'torque'))
    share = found.score.errors[2] / found.score.torque
    assert (share[5:] < 0.05).all()  # of torques with 1 % of noise


MOUNTINGS = {
    'ceiling': (0.0, 0.0, 9.81),
    'wall': (9.81, 0.0, 0.0),
    'tilted': (0.0, 6.94, -6.94),
}


@pytest.mark.parametrize('given', ['tilted', *at_night('ceiling', 'wall')])
def test_wrong_mounting_is_named_instead_of_reversed_efforts(wide, given):
    """The arm stands upright, though it is said to be mounted otherwise."""
    robot = replace(ROBOT, gravity=MOUNTINGS[given])
    other = wide * [[1.0], [1.0], [-1.0]]
    for states, is_reversed in ((wide, False), (other, True)):
        found = identify_arm(recorded(states[:2000]), robot)
        (problem,) = problems_of(found, 'torque')
        assert problem.startswith('ANOTHER MOUNTING')
        assert '--gravity 0 0 -9.81,' in problem
        assert found.reversed == (PANDA if is_reversed else ())


@pytest.mark.parametrize(
    'given',
    ['ceiling', *at_night('wall', 'tilted')],
)
def test_wrong_mounting_is_not_taken_for_a_load_or_other_joints(wide, given):
    short = wide[:2000]
    wrong = identify_arm(recorded(short), replace(ROBOT, gravity=MOUNTINGS[given]))
    left = np.linalg.norm(wrong.score.errors[2]) / np.linalg.norm(wrong.score.torque)
    assert left > 0.1
    assert not is_usable(wrong)
    (named,) = problems_of(wrong, 'torque')
    assert '--gravity 0 0 -9.81' in named


def test_rows_with_clipped_torques_are_left_out_and_said(wide, right):
    """At 0.7 of each joint's peak; where they are not left out, the error is 10 times as large."""
    torque = wide[:, TORQUE]
    limit = 0.7 * np.abs(torque).max(axis=0)
    states = with_torque(wide, np.clip(torque, -limit, limit))
    found = identify_arm(recorded(states), ROBOT)
    assert (found.clipped > 0.0).all()
    assert not right.clipped.any()
    assert found.score.total[2] < 2.0 * right.score.total[2]
    said = [note for note in notes_of(found) if 'is clipped' in note]
    assert len(said) == 7
    assert not any('is clipped' in note for note in notes_of(right))


def test_joint_whose_effort_has_another_unit_than_the_others_is_named(wide):
    states = wide * np.ones(7)
    states[:, TORQUE, 3] *= 0.2
    found = identify_arm(recorded(states), ROBOT)
    named = [line for line in problems_of(found, 'torque') if 'DOES NOT FIT' in line]
    assert any(line.startswith(PANDA[3]) for line in named)
    assert not is_usable(found)
