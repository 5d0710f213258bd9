# SPDX-License-Identifier: Apache-2.0
"""Straight lines of the tip to a pose, by pinocchio's kinematics; refusals are in a table."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('pink', reason='needs pink')

import pinocchio

import blf_dsc_controller as blf

SHIFT = np.array([0.05, 0.1, -0.1])  # m
TURN = 0.4  # rad
NEAR = 5e-4  # m and rad, of the solver and between two of its postures
RESTS = 0.004  # m and rad; the preset's bound allows far more


@pytest.mark.parametrize('turn', [0.0, TURN])
def test_tip_moves_along_a_line_and_turns_evenly(turn, tmp_path):
    """Nothing that it does is off the line; then the arm rests at the pose."""
    about = pinocchio.exp3(np.array([0.0, 0.0, turn]))
    with blf.Drive('panda', robot='simulated', record=tmp_path / 'bag') as arm:
        begin = arm.pose
        there = begin.position + SHIFT
        arm.move_to_pose(there, begin.rotation @ about if turn else None, speed=1.0)
        np.testing.assert_allclose(arm.pose.position, there, atol=RESTS)
        with pytest.raises(blf.MotionFailedError, match='cannot be at'):
            arm.move_to_pose([2.0, 0.0, 0.0])
        np.testing.assert_allclose(arm.pose.position, there, atol=RESTS)
    run = blf.read_run(tmp_path / 'bag')
    model = pinocchio.buildModelFromXML(blf.load_loop('panda').controller.robot.text)
    data, tip = model.createData(), model.getFrameId('panda_hand_tcp')
    poses = []
    moving = run.reference[np.isfinite(run.reference).all(axis=1)]
    for q in moving[:: len(moving) // 100]:
        # with the fingers, on which the tip does not depend
        pinocchio.framesForwardKinematics(model, data, np.append(q, [0.0, 0.0]))
        poses.append(data.oMf[tip].copy())
    first = poses[0]
    # the arm is not quite at its reference when it begins
    way = there - first.translation
    turning = np.zeros(3)  # where no rotation is given
    if turn:
        turning = pinocchio.log3(first.rotation.T @ begin.rotation @ about)
    for pose in poses:
        moved = pose.translation - first.translation
        done = moved @ way / (way @ way)
        np.testing.assert_allclose(moved, done * way, atol=NEAR)
        turned = pinocchio.log3(first.rotation.T @ pose.rotation)
        np.testing.assert_allclose(turned, done * turning, atol=NEAR)
    assert done == pytest.approx(1.0, abs=0.05)
