# SPDX-License-Identifier: Apache-2.0
"""Results that no recording of this arm should give are refused by name."""

from __future__ import annotations

import numpy as np
import pytest
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
from blf_dsc_controller.identification.problems import (
    is_usable,
    problems_of,
    verdict_of,
)

# Beyond the fourth joint it is one body, and all is found in a fifth of the CPU time.
N = 4
ROBOT = Robot(urdf=PANDA_TEXT, tip='panda_link4')
CHAIN = ROBOT.chain(PANDA[:N])
TRUTH = truth_of(CHAIN, 1)
EVERY = 10  # samples of 1 ms
TORQUE = 2  # row of a state


def recorded(states):
    return recording_of(states[::EVERY], PANDA[: states.shape[2]], period=1e-3 * EVERY)


@pytest.fixture(scope='module')
def states():
    return measured(shake(CHAIN, TRUTH, reference_of(CHAIN, 2), 15.0), 3)


def problems(states, robot=ROBOT):
    found = identify_arm(recorded(states), robot)
    named = list(problems_of(found, 'torque'))
    assert verdict_of(found, 'torque').startswith('REFUSED' if named else 'ACCEPTED')
    return named


@pytest.fixture(scope='module')
def found(states):
    return identify_arm(recorded(states), ROBOT)


def test_a_sound_result_is_accepted_with_its_error(found):
    assert not list(problems_of(found, 'torque'))
    verdict = verdict_of(found, 'torque')
    assert verdict.startswith(f'ACCEPTED: {found.score.total[2]:.3g} % of the torque')
    assert 'up to a common factor of the torque sensors' in verdict


def test_a_joint_outside_of_its_range_is_named(states):
    limits = 'lower="-3.0718" upper="-0.0698"'
    assert PANDA_TEXT.count(limits) == 1
    robot = Robot(
        urdf=PANDA_TEXT.replace(limits, 'lower="0.5" upper="2.5"'), tip='panda_link4'
    )
    (problem,) = problems(states, robot)
    assert problem.startswith('OUTSIDE OF ITS RANGE: panda_joint4 is at -')
    assert 'but has a range of 0.5 to 2.5 in the URDF' in problem


def test_an_offset_as_large_as_the_torque_is_named(states):
    moved = states.copy()
    moved[:, TORQUE, 1] += 60.0
    (problem,) = problems(moved)
    assert problem.startswith('panda_joint2 HAS AN OFFSET OF 6')
    assert 'counterbalance' in problem


def test_exchanged_efforts_are_named(states):
    other = states.copy()
    other[:, TORQUE, [1, 2]] = states[:, TORQUE, [2, 1]]
    named = [each for each in problems(other) if 'IS NOT EXPLAINED' in each]
    assert [each.split()[0] for each in named] == ['panda_joint2', 'panda_joint3']


def test_efforts_times_a_factor_are_accepted_only_if_they_are_right(states):
    more = states * [[1.0], [1.0], [1.25]]
    found = identify_arm(recorded(more), ROBOT)
    assert verdict_of(found, 'torque').startswith('ACCEPTED IF EFFORTS ARE IN N m: ')


@pytest.mark.parametrize(('factor', 'half'), [(20.0, 0.1), (0.05, 0.1), (1.0, 100.0)])
def test_a_mass_that_changes_tenfold_or_is_unknown_is_named(found, factor, half):
    at = 10  # of the second body
    values = found.values.copy()
    values[at] *= factor
    covariance = found.covariance.copy()
    covariance[at, at] = (half / 1.96) ** 2
    other = found._replace(values=values, covariance=covariance)
    (problem,) = problems_of(other, 'torque')
    assert problem.startswith(
        f'THE MASS OF panda_link2 IS {values[at]:.3g} +- {half:.2g} kg instead of 0.647'
    )
    assert not is_usable(other)


def test_a_small_torque_keeps_its_sign_unless_friction_is_clear():
    """The last joint, without friction, recorded the other way round, and 1 % as large."""
    small = TRUTH._replace(
        viscous=TRUTH.viscous * [1, 1, 1, 0], coulomb=TRUTH.coulomb * [1, 1, 1, 0]
    )
    moved = measured(shake(CHAIN, small, reference_of(CHAIN, 2), 15.0), 3)
    large = np.abs(moved[:, TORQUE]).max()
    moved[:, TORQUE, 3] *= -0.01 * large / np.abs(moved[:, TORQUE, 3]).max()
    assert identify_arm(recorded(moved), ROBOT).reversed == ()
