# SPDX-License-Identifier: Apache-2.0
"""Arms against pinocchio and plain formulas; base parameters, and their prior.

Rules of URDFs.
"""

from __future__ import annotations

import numpy as np
import pinocchio
import plain_law
import pytest
from plants import ARM
from random_arm import (
    ARMS,
    PANDA,
    PANDA_CHAIN,
    PANDA_TEXT,
    chain_of,
    configuration,
    pinocchio_model,
)

from blf_dsc_controller.arms.base_parameters import (
    base_parameters,
)
from blf_dsc_controller.arms.inertia import inertia_of
from blf_dsc_controller.arms.model import arm_model, inertia_matrices
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.arms.urdf import frames, read_chain
from sim_plant.arm import PointMassArm, rigid_arm, rigid_bodies


class Case:
    """An arm with a tilted base in a random state, and the same arm in pinocchio."""

    gravity = (1.0, -3.0, 5.0)

    def __init__(self, name):
        text, joints, _, end = ARMS[name]
        self.chain, n = chain_of(name), len(joints)
        self.random = np.random.default_rng(n)
        self.q, self.dq, self.v, self.a = self.random.normal(size=(4, n))
        self.rotors = self.random.uniform(0.01, 0.3, n)
        self.phi = np.column_stack((self.chain.inertias, self.rotors)).ravel()
        self.arm = serial_chain(self.chain, self.gravity)
        bodies = rigid_bodies(
            self.chain, self.gravity, self.chain.inertias, self.rotors
        )
        self.plant = rigid_arm(bodies)
        self.plant.memory[:] = np.nan
        self.model = pinocchio_model(text, joints)
        self.model.gravity.linear[:] = self.gravity
        self.model.armature[:] = self.rotors
        self.data, self.tip = self.model.createData(), self.model.getFrameId(end)
        self.theirs = self.model, self.data, configuration(self.model, self.q)


def same(ours, theirs, rounding=1e-12):
    np.testing.assert_allclose(ours, theirs, rtol=rounding, atol=rounding)


@pytest.mark.parametrize('name', ARMS)
def test_chain_and_its_placements_agree_with_pinocchio(name):
    """As read, as points and axes of the view, and as the tip of the plant."""
    case = Case(name)
    model = case.model
    chain = case.chain
    n = len(case.q)
    position, jacobian = np.zeros(3), np.zeros((3, n))
    case.plant.fill_tip(case.q, position, jacobian)
    assert [joint.name for joint in chain.joints] == list(model.names[1:])
    same(chain.tip_placement, model.frames[case.tip].placement.homogeneous)
    pinocchio.framesForwardKinematics(*case.theirs)
    placements = np.array(frames(chain, case.q))
    corners = placements[:, :3, 3]
    axes = np.array(
        [
            at[:3, :3] @ joint.axis
            for at, joint in zip(placements[1:-1], chain.joints, strict=True)
        ]
    )
    same(corners[0], np.zeros(3))
    same(corners[-1], case.data.oMf[case.tip].translation)
    for i, joint in enumerate(chain.joints):
        placed = case.data.oMi[i + 1]
        same(joint.inertia, model.inertias[i + 1].toDynamicParameters())
        same(joint.placement, model.jointPlacements[i + 1].homogeneous)
        same(corners[i + 1], placed.translation)
        same(axes[i], placed.rotation @ joint.axis)
    same(position, corners[-1])
    world = pinocchio.LOCAL_WORLD_ALIGNED
    theirs = pinocchio.computeFrameJacobian(*case.theirs, case.tip, world).reshape(
        6, -1
    )
    same(jacobian, theirs[:3])
    turns = [joint.kind != 'prismatic' for joint in chain.joints]
    same(axes[turns].T, theirs[3:, turns])


@pytest.mark.parametrize('name', ARMS)
def test_regressors_and_accelerations_agree_with_pinocchio(name):
    """Property III with the Christoffel C, where v and a are not the derivatives of q.

    The plant's accelerations are from another derivation, which shares only the
    geometry.
    """
    case = Case(name)
    q = case.q
    dq = case.dq
    v = case.v
    a = case.a
    n = len(case.q)
    arm = case.arm
    M = pinocchio.crba(*case.theirs).copy()
    C = pinocchio.computeCoriolisMatrix(*case.theirs, dq).copy()
    G = pinocchio.computeGeneralizedGravity(*case.theirs).copy()
    H, Yp, Yr = np.full((3, n, arm.p), np.nan)
    arm.regressor(q, dq, v, a, H)
    same(H @ case.phi, M @ a + C @ v + G, 1e-10)
    arm.momentum_regressor(q, dq, Yp, Yr)
    same(Yp @ case.phi, M @ dq, 1e-10)
    same(Yr @ case.phi, G - C.T @ dq, 1e-10)
    arm.regressor(q, dq, dq, a, H)
    by_entry = H.reshape(n, n, 11)
    expected = pinocchio.computeJointTorqueRegressor(*case.theirs, dq, a)
    same(by_entry[:, :, :10].ravel(), expected.ravel(), 1e-10)
    np.testing.assert_array_equal(by_entry[:, :, 10], np.diag(a))
    same(inertia_matrices(arm, case.phi, np.stack((q + 0.5, q)))[1], M, 1e-10)
    ddq = v.copy()
    case.plant.accelerate(0.0, q, dq, ddq, ddq)  # in place
    same(ddq, pinocchio.aba(*case.theirs, dq, v), 1e-10)


# The two-link arm.


@pytest.mark.parametrize(
    'arm', [ARM, PointMassArm(l1=0.7, l2=1.1, m1=1.3, m2=0.4, g=9.81)]
)
def test_two_links_are_the_arm_of_section_iv(arm):
    """And of the tests' plain law, and of the simulated arm: M ddq + C dq + G = tau."""
    model = arm_model(l1=arm.l1, gravity=arm.g)
    P = np.empty(3)
    arm.fill_parameters(0.0, P)
    for random in map(np.random.default_rng, range(20)):
        q, dq, v, a = random.normal(size=(4, 2))
        H, Yp, Yr = np.full((3, 2, 3), np.nan)
        model.regressors(q, dq, v, a, H, Yp, Yr)
        np.testing.assert_allclose(
            plain_law.regressor(model.r, q, dq, v, a), H, atol=1e-13
        )
        M, C, G = plain_law.dynamics(P, model.r, q, dq)
        np.testing.assert_allclose(H @ P, M @ a + C @ v + G, atol=1e-12)
        arm.accelerate(0.0, q, dq, v, a)
        np.testing.assert_allclose(M @ a + C @ dq + G, v, atol=1e-9)
        np.testing.assert_allclose(Yp @ P, M @ dq, atol=1e-12)
        np.testing.assert_allclose(Yr @ P, G - C.T @ dq, atol=1e-12)


# Base parameters.

WALL = (0.0, 9.81, 0.0)


UR5E_CHAIN, *RANDOM = map(chain_of, ('ur5e', 'three', 'nine'))
CHAINS = [PANDA_CHAIN, UR5E_CHAIN, *RANDOM]


@pytest.mark.parametrize('chain', CHAINS)
def test_base_parameters_are_the_smallest_set_that_gives_the_same_torques(chain):
    base = base_parameters(chain, WALL)
    whole = serial_chain(chain, WALL)
    n, p = base.model.n, base.model.p
    random = np.random.default_rng(5)
    inertias = random.normal(size=(n, 10))
    joint_rotors = random.normal(size=n)
    P = base.of(inertias, joint_rotors)
    phi = np.column_stack((inertias, joint_rotors)).ravel()
    H = np.zeros((n, p))
    rows = np.zeros((p, n, whole.p))
    for full in rows:
        q, dq, v, a = random.normal(size=(4, n))
        whole.regressor(q, dq, v, a, full)
        base.model.regressor(q, dq, v, a, H)
        np.testing.assert_allclose(H @ P, full @ phi, rtol=1e-8, atol=1e-8)
    singular = np.linalg.svd(rows.reshape(-1, whole.p), compute_uv=False)
    assert singular[p - 1] > 1e-3
    assert singular[p] < 1e-7  # pi / 2 has ten digits in the UR5e's file


# Chains are read from a URDF by its rules; unusable files are rejected with a remedy.


def test_gripper_is_carried_for_every_tip_and_its_fingers_are_held():
    whole = panda(PANDA_TEXT)
    last = whole.joints[6]
    assert last.inertia[0] == pytest.approx(0.735522 + 0.73 + 2 * 0.015)
    assert last.fixed == ('panda_link8', 'panda_hand', 'panda_hand_tcp')
    alone = panda(changed('<mass value="0.015" />', '<mass value="0" />')).joints[6]
    fingers = inertia_of(last.held)
    assert fingers[0] == pytest.approx(2 * 0.015)
    np.testing.assert_allclose(
        fingers[:4], (last.inertia - alone.inertia)[:4], atol=1e-12
    )
    assert not any(joint.held.any() for joint in whole.joints[:6])
    shorter = read_chain(PANDA_TEXT, 'panda_link0', 'panda_link7', PANDA)
    np.testing.assert_allclose(shorter.joints[6].inertia, last.inertia)


def panda(text):
    return read_chain(text, 'panda_link0', 'panda_hand_tcp', PANDA)


def changed(old, new, count=-1):
    assert old in PANDA_TEXT
    return PANDA_TEXT.replace(old, new, count)


def test_zero_tensor_rounding_below_zero_and_the_namespace_of_an_expanded_file_are_accepted():
    given = 'ixx="0.001" iyy="0.0025" izz="0.0017"'
    for izz in ('0', '-2e-35'):
        assert (
            panda(changed(given, f'ixx="0" iyy="0" izz="{izz}"')).joints[6].inertia[0]
            > 0.73
        )
    text = changed(
        '<robot name', '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name'
    )
    assert len(panda(text).joints) == 7


def tree(*chains):
    """Return a URDF of chains of revolute joints `name1`, `name2`, ...: (name, parent, n)."""
    links, joints = ['base'], []
    for name, first, n in chains:
        for k in range(1, n + 1):
            parent = first if k == 1 else links[-1]
            links.append(f'{name}{k}')
            joints.append(
                f'<joint name="{name}_joint{k}" type="revolute"><parent link="{parent}" />'
                f'<child link="{links[-1]}" /></joint>'
            )
    inertial = '<inertial><mass value="1" /></inertial>'
    bodies = [f'<link name="{link}">{inertial}</link>' for link in links]
    return f'<robot name="tree">{"".join(bodies + joints)}</robot>'


@pytest.mark.parametrize('joint', ['jointGripper', 'left_finger_joint', 'wrist'])
def test_last_joint_that_is_called_a_gripper_is_taken_for_one(joint):
    text = tree(('arm', 'base', 4)).replace('arm_joint4', joint)
    found = read_chain(text, '', '', ()).gripper
    assert found == ('' if joint == 'wrist' else joint)
