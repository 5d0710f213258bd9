# SPDX-License-Identifier: Apache-2.0
"""Joints that count from other zeros, or the other way, than in the URDF."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
from nights import at_night
from random_arm import (
    PANDA,
    PANDA_TEXT,
    measured,
    recording_of,
    reference_of,
    shake,
    truth_of,
)

from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.problems import is_usable, problems_of

# By the number of joints: the whole Panda, and the four whose links have most of the weight.
# Beyond these, it is one body, and all is found in a fifth of the CPU time.
ROBOTS = {
    7: Robot(urdf=PANDA_TEXT, tip='panda_hand_tcp'),
    4: Robot(urdf=PANDA_TEXT, tip='panda_link4'),
}
QUARTER = 0.5 * np.pi
EVERY = 10  # samples of 1 ms
POSITION, TORQUE = 0, 2  # rows of a state


@cache
def states_of(n, duration=15.0):
    """States (N, 3, n) of a motion of so many seconds."""
    chain = ROBOTS[n].chain(PANDA[:n])
    return measured(
        shake(chain, truth_of(chain, 1), reference_of(chain, 2), duration), 3
    )


def recorded(states, every=EVERY):
    n = states.shape[2]
    return recording_of(states[::every], PANDA[:n], period=1e-3 * every)


def identified(states, offsets=(), reversed_joints=(), every=EVERY):
    """What is found if positions of joints, by number, are recorded with these offsets.

    Of reversed joints, positions and efforts are recorded negated before that.
    """
    moved = states.copy()
    for joint in reversed_joints:
        moved[:, :, joint - 1] *= -1.0
    for joint, offset in dict(offsets).items():
        moved[:, POSITION, joint - 1] += offset
    return identify_arm(recorded(moved, every), ROBOTS[states.shape[2]])


def added(problem):
    """What a problem adds to the positions of joints, by number, in quarter turns."""
    found = re.findall(r'(\S+) rad to panda_joint(\d)', problem)
    return {int(joint): QUARTER * round(float(q) / QUARTER, 4) for q, joint in found}


@pytest.mark.parametrize(
    ('n', 'offsets'),
    [
        (4, {4: QUARTER}),
        *at_night((4, {2: QUARTER, 4: QUARTER}), (7, {2: -QUARTER, 6: QUARTER})),
    ],
)
def test_zeros_that_are_quarter_turns_off_are_named_and_not_applied(n, offsets):
    found = identified(states_of(n), offsets)
    assert not is_usable(found)
    (problem,) = problems_of(found, 'torque')
    assert problem.startswith('OTHER ZEROS:')
    assert added(problem) == {joint: -offset for joint, offset in offsets.items()}
    # 1 % of noise, which windows smooth; bodies that no arm has explain much as it is
    assert float(re.search(r'the torque error is (\S+) instead', problem)[1]) < 1.0
    assert found.score.total[2] > 5.0


def test_a_joint_that_counts_the_other_way_from_another_zero_is_named():
    found = identified(states_of(4), {4: QUARTER}, [4])
    (problem,) = problems_of(found, 'torque')
    assert problem.startswith('OTHER DIRECTIONS AND ZEROS:')
    assert 'negated of panda_joint4, and if then there is added' in problem
    assert added(problem) == {4: QUARTER}  # recorded: quarter - q


@pytest.mark.nightly
def test_the_zero_of_one_joint_and_the_direction_of_another_are_named():
    """Pairs of joints that may count in any way at once lead elsewhere."""
    found = identified(states_of(7, 20.0), {2: -QUARTER}, [6], every=4)
    (problem,) = problems_of(found, 'torque')
    assert problem.startswith('OTHER DIRECTIONS AND ZEROS:')
    assert 'negated of panda_joint6, and if then' in problem
    assert added(problem) == {2: QUARTER}


def test_a_last_joint_that_counts_the_other_way_is_named():
    """Gravity hardly shows it, and in the error of the whole arm it is lost."""
    found = identified(states_of(7), reversed_joints=[7])
    assert found.score.total[2] < 2.0
    assert not is_usable(found)
    (problem,) = problems_of(found, 'torque')
    assert problem.startswith('OTHER DIRECTIONS:')
    assert 'positions and efforts are negated of panda_joint7.' in problem


def test_right_joints_are_not_doubted():
    found = identified(states_of(7))
    assert is_usable(found)
