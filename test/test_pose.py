# SPDX-License-Identifier: Apache-2.0
"""Straight lines of the tip to a pose: against pinocchio's kinematics, and with a moving arm."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('pink', reason='needs pink')

import pinocchio

import blf_dsc_controller as blf
from blf_dsc_controller import MotionFailedError
from blf_dsc_controller.drive.pose import Poses

CONFIG = blf.load_loop('panda').controller
START = np.array([-0.04, 0.09, 0.01, -1.41, -0.26, 2.16, -0.52])  # rad
NEAR = 1e-4  # m and rad, of the solver
TURN = pinocchio.exp3(np.array([0.0, 0.0, 0.4]))


@pytest.fixture(scope='module')
def poses():
    return Poses(CONFIG)


def test_pose_is_that_of_pinocchio(poses):
    model = pinocchio.buildModelFromXML(CONFIG.robot.text)
    data = model.createData()
    q = np.zeros(model.nq)  # with the fingers, which the arm's tip does not depend on
    q[:7] = START
    pinocchio.framesForwardKinematics(model, data, q)
    found = data.oMf[model.getFrameId('panda_hand_tcp')]
    np.testing.assert_allclose(poses.at(START).position, found.translation, atol=1e-9)
    np.testing.assert_allclose(poses.at(START).rotation, found.rotation, atol=1e-9)


@pytest.mark.parametrize('turn', [None, TURN])
def test_tip_moves_along_a_line_and_turns_evenly(poses, turn):
    begin = poses.at(START)
    shift = np.array([0.05, 0.1, -0.1])  # m
    rotation = None if turn is None else begin.rotation @ turn
    line = poses.line(START, begin.position + shift, rotation, 0.5)
    assert (np.diff(line.times) > 0.0).all()
    for q in line.positions:
        pose = poses.at(q)
        along = shift * (shift @ (pose.position - begin.position)) / (shift @ shift)
        np.testing.assert_allclose(pose.position - begin.position, along, atol=2 * NEAR)
        turned = pinocchio.log3(begin.rotation.T @ pose.rotation)
        np.testing.assert_allclose(turned[:2], 0.0, atol=2 * NEAR)
    np.testing.assert_allclose(pose.position, begin.position + shift, atol=2 * NEAR)
    wanted = 0.0 if turn is None else 0.4
    assert turned[2] == pytest.approx(wanted, abs=2 * NEAR)


def test_simulated_arm_moves_its_tip_to_a_pose():
    """To 2 mm: the preset's bound allows far more, its errors at rest are below that."""
    with blf.Drive('panda', robot='simulated') as arm:
        there = arm.pose.position + np.array([0.0, 0.05, -0.05])
        arm.move_to_pose(there)
        np.testing.assert_allclose(arm.pose.position, there, atol=0.002)
        with pytest.raises(MotionFailedError, match='cannot be at'):
            arm.move_to_pose([2.0, 0.0, 0.0])
        np.testing.assert_allclose(arm.pose.position, there, atol=0.002)
