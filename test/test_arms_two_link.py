# SPDX-License-Identifier: Apache-2.0
"""The two-link arm as URDF and as derived again; tip and clearance of chains."""

from __future__ import annotations

import numpy as np
import plain_law
import pytest
from plants import ARM
from random_arm import chain_of

from blf_dsc_controller.arms.model import arm_model, regressors_at
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.arms.two_link import urdf
from blf_dsc_controller.arms.urdf import frames, read_chain
from blf_dsc_controller.identification.exciting_reference import Clearance, distance
from sim_plant.arm import PointMassArm


def test_urdf_of_two_links_is_the_same_arm():
    """As a chain, whose regressors agree with pinocchio's: Property III for any v and a."""
    lengths, masses = (1.1, 0.7), (0.6, 0.45)
    chain = read_chain(urdf(('a', 'b"<&'), lengths, masses), '', 'tip', ('a', 'b"<&'))
    arm = PointMassArm(*lengths, *masses, g=9.81)
    ours, P = arm_model('two_link', l1=arm.l1, gravity=arm.g), np.empty(3)
    arm.fill_parameters(0.0, P)
    theirs = serial_chain(chain)
    phi = np.column_stack((chain.inertias, np.zeros(2))).ravel()
    states = np.random.default_rng(0).normal(size=(4, 20, 2))
    found, expected = regressors_at(ours, *states) @ P, regressors_at(theirs, *states) @ phi
    np.testing.assert_allclose(found, expected, atol=1e-7)  # points have 1e-9 kg m^2 in it
    np.testing.assert_allclose(frames(chain, np.zeros(2))[-1][:3, 3], (1.8, 0.0, 0.0))


@pytest.mark.parametrize('arm', [ARM, PointMassArm(l1=0.7, l2=1.1, m1=1.3, m2=0.4, g=9.81)])
def test_two_links_are_the_arm_of_section_iv(arm):
    """And of the tests' plain law, and of the simulated arm: M ddq + C dq + G = tau."""
    model, P = arm_model('two_link', l1=arm.l1, gravity=arm.g), np.empty(3)
    arm.fill_parameters(0.0, P)
    for random in map(np.random.default_rng, range(20)):
        q, dq, v, a = random.normal(size=(4, 2))
        H, Yp, Yr = np.full((3, 2, 3), np.nan)
        model.regressors(q, dq, v, a, H, Yp, Yr)
        np.testing.assert_allclose(plain_law.regressor(model.r, q, dq, v, a), H, atol=1e-13)
        M, C, G = plain_law.dynamics(P, model.r, q, dq)
        np.testing.assert_allclose(H @ P, M @ a + C @ v + G, atol=1e-12)
        arm.accelerate(0.0, q, dq, v, a)
        np.testing.assert_allclose(M @ a + C @ dq + G, v, atol=1e-9)
        np.testing.assert_allclose(Yp @ P, M @ dq, atol=1e-12)
        np.testing.assert_allclose(Yr @ P, G - C.T @ dq, atol=1e-12)
    assert model.parameter_names == ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')
    assert model.parameter_units == ('kg m^2',) * 3
    inner, outer = arm.m1 + arm.m2, arm.m2
    assert pytest.approx([inner * arm.l1**2, outer * arm.l2**2, outer * arm.l1 * arm.l2]) == P


def panda(radius=0.07, floor=0.0):
    return Clearance(chain_of('panda'), radius, floor)


def test_distance_is_the_minimum_over_all_points_of_both_lines():
    along = np.linspace(0.0, 1.0, 300)[:, np.newaxis]
    for a, b, c, d in np.random.default_rng(0).normal(size=(100, 4, 3)):
        first, second = a + (b - a) * along, c + (d - c) * along
        minimum = np.linalg.norm(first[:, np.newaxis] - second, axis=-1).min()
        assert distance(a, b, c, d) == pytest.approx(minimum, abs=1e-3)
    for line, other, expected in (
        ([(0, 0, 0), (1, 0, 0)], [(2, 1, 0), (3, 1, 0)], 2**0.5),  # parallel
        ([(0, 0, 0), (1, 0, 0)], [(0.5, -1, 0), (0.5, 1, 0)], 0.0),  # crossing
        ([(0, 0, 0), (0, 0, 0)], [(-1, 2, 0), (1, 2, 0)], 2.0),  # a point
        ([(0, 0, 0), (0, 0, 0)], [(0, 0, 3), (0, 0, 3)], 3.0),  # two points
    ):
        assert distance(*np.array([*line, *other], dtype=float)) == pytest.approx(expected)


def test_panda_must_not_touch_itself_or_the_floor():
    """Unless the floor is lower, and with more room if the links are thinner."""
    upright = np.array((0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, 0.0))
    folded = np.array((0.0, 0.0, 0.0, -3.0, 0.0, 0.2, 0.0))  # the hand in the upper arm
    low = np.array((0.0, 1.7, 0.0, -0.5, 0.0, 1.0, 0.0))  # below the floor
    assert panda().room(upright).min() >= 0.0
    assert panda().room(folded).min() < 0.0
    assert panda().room(low).min() < 0.0 < panda(floor=-1.0).room(low).min()
    assert panda(radius=0.03).room(folded).min() > panda().room(folded).min()


def test_links_that_touch_in_every_posture_do_not_count():
    """With thick links only a Panda's base and what is beyond its elbow are left."""
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 7))
    assert panda(radius=0.3).room(q).shape[1] < panda().room(q).shape[1]
    assert np.all(panda(radius=0.005).room(q).max(axis=0) > 0.0)


def test_link_with_an_offset_from_its_joints_is_checked_where_it_is():
    """The upper arm of a UR5e is 11 cm beside the line from shoulder to elbow."""
    corners, straight = (
        Clearance(chain_of('ur5e'), radius, 0.0).corners(np.zeros(6)) for radius in (0.07, 0.2)
    )
    assert len(corners) == len(straight) + 1 == 9
    apart = distance(corners[3], corners[3], straight[2], straight[3])
    assert apart == pytest.approx(0.11336, abs=1e-4)
