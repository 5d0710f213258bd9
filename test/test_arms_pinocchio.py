# SPDX-License-Identifier: Apache-2.0
"""Arms of a URDF against pinocchio: the chain, the controller's regressors, the plant's bodies."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from closed_loop_case import MODEL
from random_arm import ARMS, chain_of, configuration, pinocchio_model

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.model import inertia_matrices, regressors_at
from blf_dsc_controller.arms.serial_chain import ROTOR, serial_chain
from blf_dsc_controller.arms.urdf import frames
from sim_plant.arm import motion_of, rigid_arm, rigid_bodies


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
        bodies = rigid_bodies(self.chain, self.gravity, self.chain.inertias, self.rotors)
        self.plant = rigid_arm(bodies)
        self.plant.memory[:] = np.nan
        self.now = motion_of(self.plant.memory, bodies)
        self.model = pinocchio_model(text, joints)
        self.model.gravity.linear[:] = self.gravity
        self.model.armature[:] = self.rotors
        self.data, self.tip = self.model.createData(), self.model.getFrameId(end)
        self.theirs = self.model, self.data, configuration(self.model, self.q)


def same(ours, theirs, rounding=1e-12):
    np.testing.assert_allclose(ours, theirs, rtol=rounding, atol=rounding)


@pytest.mark.parametrize('name', ARMS)
def test_chain_and_its_placements_agree_with_pinocchio(name):
    """As read, as points and axes of the view, and as bodies of the plant."""
    case = Case(name)
    model, chain, n = case.model, case.chain, len(case.q)
    position, jacobian = np.zeros(3), np.zeros((3, n))
    case.plant.fill_tip(case.q, position, jacobian)
    assert [joint.name for joint in chain.joints] == list(model.names[1:])
    same(chain.tip_placement, model.frames[case.tip].placement.homogeneous)
    pinocchio.framesForwardKinematics(*case.theirs)
    placements = np.array(frames(chain, case.q))
    corners = placements[:, :3, 3]
    axes = np.array(
        [at[:3, :3] @ joint.axis for at, joint in zip(placements[1:-1], chain.joints, strict=True)]
    )
    same(corners[0], np.zeros(3))
    same(corners[-1], case.data.oMf[case.tip].translation)
    for i, joint in enumerate(chain.joints):
        placed = case.data.oMi[i + 1]
        same(joint.inertia, model.inertias[i + 1].toDynamicParameters())
        same(joint.placement, model.jointPlacements[i + 1].homogeneous)
        same(corners[i + 1], placed.translation)
        same(case.now.origin[i + 1], placed.translation)
        same(case.now.rotation[i + 1], placed.rotation)
        same(axes[i], placed.rotation @ joint.axis)
    same(position, corners[-1])
    world = pinocchio.LOCAL_WORLD_ALIGNED
    theirs = pinocchio.computeFrameJacobian(*case.theirs, case.tip, world).reshape(6, -1)
    same(jacobian, theirs[:3])
    turns = [joint.kind != 'prismatic' for joint in chain.joints]
    same(axes[turns].T, theirs[3:, turns])


@pytest.mark.parametrize('name', ARMS)
def test_regressors_and_accelerations_agree_with_pinocchio(name):
    """Property III with the Christoffel C, where v and a are not the derivatives of q.

    The plant's accelerations are from another derivation, which shares only the geometry.
    """
    case = Case(name)
    q, dq, v, a, n, arm = case.q, case.dq, case.v, case.a, len(case.q), case.arm
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
    by_entry = H.reshape(n, n, ROTOR + 1)
    expected = pinocchio.computeJointTorqueRegressor(*case.theirs, dq, a)
    same(by_entry[:, :, :ROTOR].ravel(), expected.ravel(), 1e-10)
    np.testing.assert_array_equal(by_entry[:, :, ROTOR], np.diag(a))
    same(inertia_matrices(arm, case.phi, np.stack((q + 0.5, q)))[1], M, 1e-10)
    ddq = v.copy()
    case.plant.accelerate(0.0, q, dq, ddq, ddq)  # in place
    same(ddq, pinocchio.aba(*case.theirs, dq, v), 1e-10)


@pytest.mark.parametrize('model', [Case('six').arm, MODEL])
def test_regressors_computed_at_once_or_in_a_batch_equal_the_separate_ones(model):
    states = np.random.default_rng(1).normal(size=(5, 4, model.n))
    H = regressors_at(model, *np.moveaxis(states, 1, 0))
    for state, batched in zip(states, H, strict=True):
        separate, together = np.full((2, 3, model.n, model.p), np.nan)
        model.regressor(*state, separate[0])
        model.momentum_regressor(*state[:2], *separate[1:])
        model.regressors(*state, *together)
        np.testing.assert_array_equal(together, separate)
        np.testing.assert_array_equal(batched, separate[0])


def test_payload_at_the_tip_is_that_of_the_plant_and_of_the_base_parameters():
    """A truth that differs from the URDF: links 20 % heavier, 2 kg at the tip."""
    case = Case('panda')
    inertias = 1.2 * case.chain.inertias
    for i, heavier in enumerate(inertias, start=1):
        case.model.inertias[i] = pinocchio.Inertia.FromDynamicParameters(heavier)
    point = case.chain.tip_placement[:3, 3]
    case.model.inertias[7] += pinocchio.Inertia(2.0, point, np.zeros((3, 3)))
    base = base_parameters(case.chain, case.gravity)
    arm = rigid_arm(rigid_bodies(case.chain, case.gravity, inertias, case.rotors, base))
    ddq, H = np.zeros(7), np.zeros((7, base.model.p))
    arm.accelerate(2.0, case.q, case.dq, case.v, ddq)
    same(ddq, pinocchio.aba(*case.theirs, case.dq, case.v), 1e-10)
    base.model.regressor(case.q, case.dq, case.dq, ddq, H)
    same(H @ (base.of(inertias, case.rotors) + 2.0 * base.load), case.v, 1e-9)
