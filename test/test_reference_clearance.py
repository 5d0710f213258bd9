# SPDX-License-Identifier: Apache-2.0
"""Clearance of the links: distances, which pairs count, and the floor."""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import CONFIG, PANDA, UR5E

from blf_dsc_controller.arms.geometry import Clearance, distance
from blf_dsc_controller.arms.urdf import read_chain

PI = np.pi


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
        ((0.0, 0.0, 0.0, -PI / 2, 0.0, PI / 2, 0.0), True),
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
