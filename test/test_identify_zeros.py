# SPDX-License-Identifier: Apache-2.0
"""Positions whose zeros are not those of the URDF, as in a DH convention."""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import (
    PANDA_CHAIN,
    PANDA_TEXT,
    measured,
    recording_of,
    reference_of,
    shake,
    truth_of,
)

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification import zeros
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.problems import is_usable, problems_of
from blf_dsc_controller.identification.windows import rows_of

ROBOT = Robot(urdf=PANDA_TEXT, tip='panda_hand_tcp')
QUARTER = 0.5 * np.pi
EVERY = 10  # samples of 1 ms
POSITION, TORQUE = 0, 2  # rows of a state


@pytest.fixture(scope='module')
def states():
    truth = truth_of(PANDA_CHAIN, 1)
    return measured(shake(PANDA_CHAIN, truth, reference_of(PANDA_CHAIN, 2), 15.0), 3)


def identified(states, offsets=()):
    """What is found if positions of joints, by number, are recorded with these offsets."""
    moved = states.copy()
    for joint, offset in dict(offsets).items():
        moved[:, POSITION, joint - 1] += offset
    return identify_arm(recording_of(moved[::EVERY], period=1e-3 * EVERY), ROBOT)


@pytest.mark.parametrize(
    'offsets',
    [{4: QUARTER}, {2: -QUARTER, 6: QUARTER}, {2: QUARTER, 4: QUARTER}],
)
def test_zeros_that_are_quarter_turns_off_are_named_and_not_applied(states, offsets):
    found = identified(states, offsets)
    right = np.zeros(7)
    for joint, offset in offsets.items():
        right[joint - 1] = -offset
    np.testing.assert_allclose(found.other_zeros.offsets, right)
    assert not is_usable(found)
    (problem,) = problems_of(found, 'torque')
    assert problem.startswith('OTHER ZEROS')
    for joint, offset in offsets.items():
        assert f'{-offset:+.5g} rad to panda_joint{joint}' in problem
    # 1 % of noise, which windows smooth; bodies that no arm has explain much as it is
    assert found.other_zeros.error < 1.0
    assert found.score.total[2] > 5.0


def test_friction_explains_the_torques_of_its_own_windows(states, monkeypatch):
    recording = recording_of(states[::EVERY], period=1e-3 * EVERY)
    chain = ROBOT.chain(recording.joints)
    rows = rows_of(recording, base_parameters(chain, ROBOT.gravity).model)
    seen = []
    monkeypatch.setattr(zeros, '_POSTURES', 20)  # one in several windows

    def keep(*given):
        seen.append(given)
        raise LookupError

    monkeypatch.setattr(zeros, '_Gravity', keep)
    with pytest.raises(LookupError):
        zeros.likely_zeros(recording, ROBOT)
    ((_, _, _, u, friction),) = seen
    assert len(u) >= 20
    for own, columns in zip(u, friction, strict=True):
        (k,) = np.flatnonzero((rows.u(0.0) == own).all(axis=1))
        for column in columns:
            assert (rows.friction[k] == column).all(axis=1).any()


def test_right_zeros_are_not_doubted(states):
    found = identified(states)
    assert found.other_zeros is None
    assert is_usable(found)


def test_efforts_in_another_order_are_not_taken_for_other_zeros(states):
    efforts = states[:, TORQUE][:, [0, 3, 2, 1, 4, 5, 6]]
    other = np.stack((states[:, 0], states[:, 1], efforts), axis=1)
    found = identified(other)
    assert found.other_zeros is None
    assert not is_usable(found)
