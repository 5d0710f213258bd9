# SPDX-License-Identifier: Apache-2.0
"""The plant of any chain against pinocchio and MuJoCo, and against the controller's regressor."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from random_arm import CONFIG, PANDA, UR5E, configuration, pinocchio_model, random_urdf

from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.arms.urdf import read_chain
from blf_dsc_controller.compiled.jit import kernel
from sim_plant.rigid_body import acceleration, locate, motion_of, motion_size, rigid_bodies, tip

TILTED_GRAVITY = (1.0, -3.0, 5.0)
ARMS = {
    'one': (*random_urdf(1, 21), 'base', 'tip'),
    'two': (*random_urdf(2, 22), 'base', 'tip'),
    'four': (*random_urdf(4, 23), 'base', 'tip'),
    'nine': (*random_urdf(9, 24), 'base', 'tip'),
    'panda': ((CONFIG / 'panda.urdf').read_text(), PANDA, 'panda_link0', 'panda_hand_tcp'),
    'ur5e': ((CONFIG / 'ur5e.urdf').read_text(), UR5E, 'world', 'tool0'),
}


class Case:
    """An arm in a random state, and its model in pinocchio."""

    def __init__(self, name, gravity=TILTED_GRAVITY):
        self.text, joints, base, self.tip = ARMS[name]
        self.chain = read_chain(self.text, base, self.tip, joints)
        self.n = len(joints)
        random = np.random.default_rng(self.n)
        self.q, self.dq, self.torque = random.normal(size=(3, self.n))
        self.rotors = random.uniform(0.01, 0.3, self.n)
        self.arm = rigid_bodies(self.chain, gravity, self.chain.inertias, self.rotors)
        self.now = motion_of(np.full(motion_size(self.arm), np.nan), self.arm)
        self.model = pinocchio_model(self.text, joints)
        self.model.gravity.linear[:] = gravity
        self.model.armature[:] = self.rotors
        self.data = self.model.createData()
        self.model_q = configuration(self.model, self.q)

    def acceleration(self, payload=0.0):
        ddq = self.torque.copy()
        locate(self.arm, self.q, self.dq, self.now)
        acceleration(self.arm, self.now, payload, ddq, ddq)  # in place
        return ddq

    def jacobian(self):
        """Jacobian of the tip in the base frame (3, n)."""
        frame = self.model.getFrameId(self.tip)
        reference = pinocchio.LOCAL_WORLD_ALIGNED
        arguments = self.model, self.data, self.model_q, frame, reference
        return pinocchio.computeFrameJacobian(*arguments).reshape(6, -1)[:3]


@pytest.fixture(params=ARMS)
def case(request):
    return Case(request.param)


def test_acceleration_matches_the_articulated_body_algorithm(case):
    expected = pinocchio.aba(case.model, case.data, case.model_q, case.dq, case.torque)
    np.testing.assert_allclose(case.acceleration(), expected, rtol=1e-10, atol=1e-10)


def test_tip_and_body_placements_match_pinocchio(case):
    locate(case.arm, case.q, case.dq, case.now)
    pinocchio.framesForwardKinematics(case.model, case.data, case.model_q)
    position, jacobian = np.zeros(3), np.zeros((3, case.n))
    tip(case.arm, case.now, position, jacobian)
    expected = case.data.oMf[case.model.getFrameId(case.tip)].translation
    np.testing.assert_allclose(position, expected, atol=1e-12)
    np.testing.assert_allclose(jacobian, case.jacobian(), atol=1e-12)
    for i in range(case.n + 1):
        np.testing.assert_allclose(case.now.origin[i], case.data.oMi[i].translation, atol=1e-12)
        np.testing.assert_allclose(case.now.rotation[i], case.data.oMi[i].rotation, atol=1e-12)


def test_controllers_regressor_reproduces_the_torque(case):
    """H(q, dq, dq, ddq) P = torque, from two derivations that share only the geometry."""
    ddq = case.acceleration()
    model = serial_chain(case.chain, TILTED_GRAVITY)
    H = np.zeros((case.n, model.p))
    model.regressor(case.q, case.dq, case.dq, ddq, H)
    phi = np.column_stack((case.chain.inertias, case.rotors)).ravel()
    np.testing.assert_allclose(H @ phi, case.torque, rtol=1e-9, atol=1e-9)


def test_acceleration_accounts_for_other_inertias_and_a_payload():
    """A truth that differs from the URDF: links 20 % heavier, 2 kg at the tip."""
    case = Case('panda')
    point = case.chain.tip_placement[:3, 3]
    inertias = 1.2 * case.chain.inertias
    case.arm = rigid_bodies(case.chain, TILTED_GRAVITY, inertias, case.rotors)
    for i in range(case.n):
        heavier = 1.2 * case.chain.inertias[i]
        case.model.inertias[i + 1] = pinocchio.Inertia.FromDynamicParameters(heavier)
    case.model.inertias[case.n] += pinocchio.Inertia(2.0, point, np.zeros((3, 3)))
    expected = pinocchio.aba(case.model, case.data, case.model_q, case.dq, case.torque)
    np.testing.assert_allclose(case.acceleration(2.0), expected, rtol=1e-10, atol=1e-10)


@kernel
def compiled(arm, vector, q, dq, torque, ddq):
    now = motion_of(vector, arm)
    locate(arm, q, dq, now)
    acceleration(arm, now, 2.0, torque, ddq)


def test_compiled_kernels_match_python():
    case = Case('four')
    ddq = np.zeros(case.n)
    vector = np.zeros(motion_size(case.arm))
    compiled(case.arm, vector, case.q, case.dq, case.torque, ddq)
    np.testing.assert_array_equal(ddq, case.acceleration(2.0))
