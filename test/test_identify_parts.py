# SPDX-License-Identifier: Apache-2.0
"""The parts of the identification: rows without accelerations, physical least squares, the URDF."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
from random_arm import CONFIG, PANDA, pinocchio_model, random_urdf
from shaken_arm import GRAVITY, PANDA_CHAIN, PANDA_TEXT, PERIOD, changed

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.urdf import attached, read_chain
from blf_dsc_controller.identification.corrected_urdf import corrected_urdf
from blf_dsc_controller.identification.prior import Cone, solve
from blf_dsc_controller.identification.recording import Recording, rows_of

UNIT = np.array([pseudo_inertia(e) for e in np.eye(10)])  # E_a of sum_a ten_a E_a


# At 10 ms the error is that of interpolating torques between samples: (w h)^2 / 8 of them.
@pytest.mark.parametrize(('period', 'tolerance'), [(0.001, 1e-5), (0.01, 1e-3)])
def test_rows_hold_for_an_exact_motion(period, tolerance):
    """X P = u with the torques of a smooth motion; no acceleration is given."""
    parameters = base_parameters(PANDA_CHAIN, GRAVITY)
    model = parameters.model
    P = parameters.of(PANDA_CHAIN.inertias, np.full(7, 0.1))
    delay = 0.004
    t = np.arange(0.0, 4.0, period)[:, None]
    speed = np.linspace(1.0, 3.0, 7)
    torque, H = np.zeros((len(t), 7)), np.zeros((7, model.p))
    for k, angle in enumerate(speed * (t - delay)):
        dq = speed * np.cos(angle)
        model.regressor(np.sin(angle), dq, dq, -(speed**2) * np.sin(angle), H)
        torque[k] = H @ P
    gap = np.zeros(len(t), dtype=bool)
    gap[len(t) // 2] = True
    rows = rows_of(Recording(PANDA, period, np.sin(speed * t), torque, gap, ''), model)
    residual = rows.X[:, :, : model.p] @ P - rows.u(delay)
    inner = slice(1, -1)  # at both ends the torque has no delayed values
    scale = np.abs(torque).max(axis=0)
    assert (np.abs(residual[inner]) < tolerance * scale).all()
    # No window contains the gap.
    assert np.abs(rows.time - t[len(t) // 2]).min() >= 0.1


def test_rate_is_the_derivative_of_the_right_hand_side():
    t = np.arange(0.0, 4.0, PERIOD)[:, None]
    torque = np.sin(np.linspace(1.0, 9.0, 7) * t)
    gap = np.zeros(len(t), dtype=bool)
    model = base_parameters(PANDA_CHAIN, GRAVITY).model
    rows = rows_of(Recording(PANDA, PERIOD, torque, torque, gap, ''), model)
    by_difference = (rows.u(0.002) - rows.u(-0.002)) / 0.004
    np.testing.assert_allclose(rows.rate(0.0)[1:-1], by_difference[1:-1], atol=1e-3)


def test_nearest_physical_body_is_found():
    """The J >= 0 nearest in the Frobenius norm is known: the eigenvalues clipped at zero."""
    target = np.diag([1.0, 2.0, -1.0, 3.0])
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    target = rotation @ target @ rotation.T
    A = 1e3 * UNIT.reshape(10, 16).T  # so large that |z|^2 and mu hardly count
    z = solve(A, 1e3 * target.ravel(), [Cone(0, np.zeros((4, 4)), UNIT)], inertia_of(np.eye(4)))
    expected = rotation @ np.diag([1.0, 2.0, 0.0, 3.0]) @ rotation.T
    np.testing.assert_allclose(pseudo_inertia(z), expected, atol=2e-3)
    assert np.linalg.eigvalsh(pseudo_inertia(z))[0] > 0.0


def test_solution_far_from_the_bounds_is_least_squares():
    random = np.random.default_rng(1)
    A, b = random.normal(size=(20, 3)), random.normal(size=20)
    far = [Cone(k, np.array([[1e3]]), np.array([[[1.0]]])) for k in range(3)]
    expected = np.linalg.solve(A.T @ A + np.eye(3), A.T @ b)
    np.testing.assert_allclose(solve(A, b, far, np.zeros(3)), expected, atol=1e-3)


@pytest.mark.parametrize('seed', range(4))
def test_corrected_random_urdf_has_the_given_bodies(seed):
    """With links fixed to links, links without inertias and empty tags."""
    text, joints = random_urdf(4, seed)
    chain = read_chain(text, 'base', 'tip', joints)
    bodies = changed(chain, np.random.default_rng(seed))
    friction = np.arange(1.0, 5.0)
    new = corrected_urdf(text, chain, bodies, friction, 0.1 * friction, 'a -- b')
    again = read_chain(new, 'base', 'tip', joints)
    np.testing.assert_allclose(again.inertias, bodies, rtol=1e-9, atol=1e-9)
    assert [joint.damping for joint in again.joints] == friction.tolist()
    model = pinocchio_model(new, joints)
    inertias = np.array([inertia.toDynamicParameters() for inertia in list(model.inertias)[1:]])
    np.testing.assert_allclose(inertias, bodies, rtol=1e-9, atol=1e-9)


def test_rest_of_the_file_is_unchanged():
    text = PANDA_TEXT.replace('<mass value="0.73" />', '<mass value="0.73" /><!-- a guess -->')
    text = text.replace('name="panda_link1"', "name='panda_link1'  note='a > b'", 1)
    friction = np.ones(7)
    new = corrected_urdf(text, PANDA_CHAIN, 1.1 * PANDA_CHAIN.inertias, friction, friction, 'note')
    changed_parts = r'<inertial>.*?</inertial>|\s*<dynamics[^>]*>|<!--\nnote\n-->\n|\s+(?=</joint>)'

    def rest(urdf):
        return re.sub(changed_parts, '', urdf, flags=re.DOTALL)

    assert rest(new) == rest(text)
    assert new.count('<dynamics damping="1" friction="1" />') == 7
    for kept in ('panda_link0', 'panda_leftfinger', 'panda_rightfinger'):
        link = rf'<link name="{kept}">.*?</link>'
        assert re.search(link, new, re.DOTALL)[0] == re.search(link, text, re.DOTALL)[0]
    model = mujoco.MjModel.from_xml_string(new)
    moved = sum(joint.inertia[0] for joint in PANDA_CHAIN.joints)
    assert model.body_mass.sum() == pytest.approx(1.1 * moved, rel=1e-6)


def test_correcting_twice_duplicates_nothing():
    friction = np.ones(7)
    once = corrected_urdf(PANDA_TEXT, PANDA_CHAIN, PANDA_CHAIN.inertias, friction, friction, '')
    chain = read_chain(once, 'panda_link0', 'panda_hand_tcp', PANDA)
    np.testing.assert_allclose(chain.inertias, PANDA_CHAIN.inertias, atol=1e-10)
    twice = corrected_urdf(once, chain, chain.inertias, friction, friction, '')
    assert twice.count('<inertial>') == once.count('<inertial>')
    assert twice.count('<dynamics') == 7


def test_links_after_the_last_joint_are_fixed_or_held():
    fixed, held = attached(PANDA_TEXT, 'panda_link7', PANDA)
    assert fixed == ['panda_link8', 'panda_hand', 'panda_hand_tcp']
    assert held[3, 3] == pytest.approx(0.03)  # two fingers
    assert attached((CONFIG / 'ur5e.urdf').read_text(), 'wrist_3_link', ())[0][-1] == 'tool0'


def test_other_readers_see_only_the_new_inertias_and_friction(tmp_path):
    """Frames, limits and names as before, in pinocchio, MuJoCo and yourdfpy."""
    yourdfpy = pytest.importorskip('yourdfpy', reason='needs pip install blf_dsc_controller[view]')
    inertias = changed(PANDA_CHAIN, np.random.default_rng(5))
    text = corrected_urdf(PANDA_TEXT, PANDA_CHAIN, inertias, np.full(7, 0.5), np.full(7, 0.2), '')
    before, after = (pinocchio_model(each, PANDA) for each in (PANDA_TEXT, text))
    assert list(before.names) == list(after.names)
    for old, new in zip(before.jointPlacements, after.jointPlacements, strict=True):
        np.testing.assert_array_equal(old.homogeneous, new.homogeneous)
    for limit in ('upperPositionLimit', 'velocityLimit', 'effortLimit'):
        np.testing.assert_array_equal(getattr(before, limit), getattr(after, limit))
    masses = [body.mass for body in list(after.inertias)[1:]]
    np.testing.assert_allclose(masses, inertias[:, 0], rtol=1e-9)
    old, new = (mujoco.MjModel.from_xml_string(each) for each in (PANDA_TEXT, text))
    np.testing.assert_array_equal(old.jnt_range, new.jnt_range)
    np.testing.assert_allclose(new.dof_damping[:7], 0.5)
    np.testing.assert_allclose(new.dof_frictionloss[:7], 0.2)
    (tmp_path / 'arm.urdf').write_text(text)
    robot = yourdfpy.URDF.load(str(tmp_path / 'arm.urdf'), load_meshes=False)
    assert robot.validate()
    for joint, inertia in zip(PANDA_CHAIN.joints, inertias, strict=True):
        fingers = attached(PANDA_TEXT, joint.link, PANDA)[1][3, 3]
        assert robot.link_map[joint.link].inertial.mass == pytest.approx(inertia[0] - fingers)
        assert float(robot.joint_map[joint.name].dynamics.damping) == pytest.approx(0.5)
        assert robot.joint_map[joint.name].limit.upper == pytest.approx(joint.upper)
