# SPDX-License-Identifier: Apache-2.0
"""Joints, axes and tip of a chain against pinocchio, and how far the tip can be off."""

from __future__ import annotations

import numpy as np
import pinocchio
from plants import points
from random_arm import configuration, pinocchio_model, random_urdf

from blf_dsc_controller.arms.geometry import skeleton, tip_radius
from blf_dsc_controller.arms.two_link import urdf
from blf_dsc_controller.arms.urdf import read_chain

JOINTS = ('joint1', 'joint2')
TEXT = urdf('arm', JOINTS, (1.0, 0.8), (1.0, 1.0), (0.0, 0.0))
TWO_LINK = read_chain(TEXT, 'base_link', 'tip', JOINTS)


def test_corners_and_axes_agree_with_pinocchio():
    text, joints = random_urdf(6, 5)
    chain = read_chain(text, 'base', 'tip', joints)
    assert {joint.kind for joint in chain.joints} >= {'revolute', 'prismatic'}
    q = np.random.default_rng(0).uniform(-1.0, 1.0, 6)
    corners, axes = skeleton(chain, q)
    model = pinocchio_model(text, joints)
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, configuration(model, q))
    np.testing.assert_array_equal(corners[0], np.zeros(3))
    for i, joint in enumerate(chain.joints):
        np.testing.assert_allclose(corners[i + 1], data.oMi[i + 1].translation, atol=1e-12)
        np.testing.assert_allclose(axes[i], data.oMi[i + 1].rotation @ joint.axis, atol=1e-12)
    tip = data.oMf[model.getFrameId('tip')].translation
    np.testing.assert_allclose(corners[-1], tip, atol=1e-12)


def test_tip_radius_is_the_sum_of_what_each_joint_moves_the_tip():
    text, joints = random_urdf(6, 5)
    chain = read_chain(text, 'base', 'tip', joints)
    random = np.random.default_rng(0)
    q, bound, h = random.uniform(-1.0, 1.0, 6), random.uniform(1e-3, 2e-3, 6), 1e-5
    moved = [
        [skeleton(chain, q + sign * h * axis)[0][-1] for sign in (1.0, -1.0)] for axis in np.eye(6)
    ]
    reach = np.linalg.norm(np.subtract(*np.moveaxis(moved, 1, 0)), axis=1) / (2.0 * h)
    np.testing.assert_allclose(tip_radius(chain, q, bound), reach @ bound, rtol=1e-8)


def test_straight_arm_attains_the_tip_radius():
    chain = TWO_LINK
    straight, errors = np.array([0.4, 0.0]), np.array([1e-6, 2e-6])
    off = skeleton(chain, straight + errors)[0][-1] - skeleton(chain, straight)[0][-1]
    np.testing.assert_allclose(np.linalg.norm(off), tip_radius(chain, straight, errors), rtol=1e-5)


def test_arm_drawn_without_a_urdf_is_that_of_section_iv():
    corners, axes = skeleton(TWO_LINK, np.array([0.7, -1.9]))
    np.testing.assert_allclose(corners[1:], points(1.0, 0.8, (0.7, -1.9)), atol=1e-15)
    np.testing.assert_allclose(axes, [[0.0, -1.0, 0.0]] * 2, atol=1e-15)
