# SPDX-License-Identifier: Apache-2.0
"""Joints, axes and tip of a chain against pinocchio; clearance of its links."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from plants import points
from random_arm import CONFIG, PANDA, UR5E, configuration, pinocchio_model, random_urdf

from blf_dsc_controller.arms.geometry import Clearance, distance, skeleton, tip_radius
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


def panda(radius=0.07, floor=0.0):
    text = (CONFIG / 'panda.urdf').read_text()
    return Clearance(read_chain(text, 'panda_link0', 'panda_hand_tcp', PANDA), radius, floor)


def test_distance_is_the_minimum_over_all_points_of_both_lines():
    along = np.linspace(0.0, 1.0, 300)[:, np.newaxis]
    for a, b, c, d in np.random.default_rng(0).normal(size=(100, 4, 3)):
        first, second = a + (b - a) * along, c + (d - c) * along
        minimum = np.linalg.norm(first[:, np.newaxis] - second, axis=-1).min()
        assert distance(a, b, c, d) == pytest.approx(minimum, abs=1e-3)


@pytest.mark.parametrize(
    ('line', 'other', 'expected'),
    [
        ([(0, 0, 0), (1, 0, 0)], [(2, 1, 0), (3, 1, 0)], 2**0.5),  # parallel
        ([(0, 0, 0), (1, 0, 0)], [(0.5, -1, 0), (0.5, 1, 0)], 0.0),  # crossing
        ([(0, 0, 0), (0, 0, 0)], [(-1, 2, 0), (1, 2, 0)], 2.0),  # a point
        ([(0, 0, 0), (0, 0, 0)], [(0, 0, 3), (0, 0, 3)], 3.0),  # two points
    ],
)
def test_distance_of_parallel_crossing_and_degenerate_lines(line, other, expected):
    assert distance(*np.array([*line, *other], dtype=float)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ('posture', 'is_free'),
    [
        ((0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, 0.0), True),
        ((0.0, 0.0, 0.0, -3.0, 0.0, 0.2, 0.0), False),  # the hand in the upper arm
        ((0.0, 1.7, 0.0, -0.5, 0.0, 1.0, 0.0), False),  # below the floor
    ],
)
def test_panda_must_not_touch_itself_or_the_floor(posture, is_free):
    assert (panda().room(np.array(posture)).min() >= 0.0) == is_free


def test_lower_floor_and_thinner_links_leave_more_room():
    low = np.array((0.0, 1.7, 0.0, -0.5, 0.0, 1.0, 0.0))
    assert panda(floor=-1.0).room(low).min() > 0.0
    folded = np.array((0.0, 0.0, 0.0, -3.0, 0.0, 1.5, 0.0))
    assert panda(radius=0.03).room(folded).min() > panda().room(folded).min()


def test_links_that_touch_in_every_posture_do_not_count():
    """With thick links only a Panda's base and what is beyond its elbow are left."""
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 7))
    assert panda(radius=0.3).room(q).shape[1] < panda().room(q).shape[1]
    assert np.all(panda(radius=0.005).room(q).max(axis=0) > 0.0)


def test_link_with_an_offset_from_its_joints_is_checked_where_it_is():
    """The upper arm of a UR5e is 11 cm beside the line from shoulder to elbow."""
    text = (CONFIG / 'ur5e.urdf').read_text()
    chain = read_chain(text, 'world', 'tool0', UR5E)
    rest = np.zeros(6)
    corners = Clearance(chain, 0.07, 0.0).corners(rest)
    straight = Clearance(chain, 0.2, 0.0).corners(rest)
    assert len(corners) == len(straight) + 1 == 9
    apart = distance(corners[3], corners[3], straight[2], straight[3])
    assert apart == pytest.approx(0.11336, abs=1e-4)
