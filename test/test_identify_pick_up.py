# SPDX-License-Identifier: Apache-2.0
"""Loads that change within a recording: found, weighed, and named where nobody said so."""

from __future__ import annotations

import numpy as np
import pytest
from nights import at_night
from random_arm import (
    PANDA_CHAIN,
    PANDA_TEXT,
    holding,
    measured,
    recording_of,
    reference_of,
    shake,
    truth_of,
)

from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.problems import is_usable, problems_of
from blf_dsc_controller.identification.summary import load_table
from blf_dsc_controller.identification.windows import Carried

ROBOT = Robot(urdf=PANDA_TEXT, tip='panda_hand_tcp')
TRUTH = truth_of(PANDA_CHAIN, 1)
MASS = 2.0  # kg
EVERY = 5  # samples of 1 ms
DURATION = 40.0  # s
FIND = float('nan')


@pytest.fixture(scope='module')
def motions():
    """States (2, N, 3, n) of one motion without and with a load."""
    reference = reference_of(PANDA_CHAIN, 2)
    return np.stack(
        [
            shake(PANDA_CHAIN, holding(TRUTH, m), reference, DURATION)
            for m in (0.0, MASS)
        ]
    )


def recorded(motions, begin, end):
    """Return a recording in which the load is carried from `begin` to `end` [s]."""
    time = 1e-3 * np.arange(motions.shape[1])
    carries = (time >= begin) & (time < end)
    states = np.where(carries[:, None, None], motions[1], motions[0])
    return recording_of(measured(states, 3)[::EVERY], period=1e-3 * EVERY)


CASES = [
    Carried(20.0, np.inf),
    Carried(12.0, 25.0),
    Carried(-np.inf, 22.0),
]


@pytest.mark.parametrize('carried', [CASES[1], *at_night((CASES[0],), (CASES[2],))])
def test_load_that_changes_is_found_and_weighed(motions, carried):
    found = identify_arm(recorded(motions, *carried), ROBOT, picked_up=FIND)
    np.testing.assert_allclose(found.carried, carried, atol=0.6)
    value, deviation = found.load
    assert abs(value[0] - MASS) < min(3.0 * deviation[0], 0.05 * MASS)
    assert deviation[0] < 0.02 * MASS
    assert found.score.total[2] < 2.0
    assert not list(problems_of(found, 'torque'))
    assert found.carried.when in next(load_table(found))


def test_load_that_changes_unsaid_is_named_and_the_result_refused(motions):
    found = identify_arm(recorded(motions, *CASES[1]), ROBOT)
    assert not is_usable(found)
    (problem,) = problems_of(found, 'torque')
    assert problem.startswith('THE LOAD CHANGES: ')
    assert ' 2 kg from ' in problem
    assert '--payload' in problem


def test_load_that_stays_is_not_said_to_change(motions):
    whole = Carried(-np.inf, np.inf)
    assert is_usable(identify_arm(recorded(motions, *whole), ROBOT))
    asked = identify_arm(recorded(motions, np.inf, np.inf), ROBOT, picked_up=FIND)
    assert 'none that shows' in next(load_table(asked))
    assert is_usable(asked)
