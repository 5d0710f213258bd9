# SPDX-License-Identifier: Apache-2.0
"""Regressors of serial chains against pinocchio, on random arms, also with prismatic joints."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from random_arm import CONFIG, PANDA, UR5E, configuration, pinocchio_model, random_urdf

from blf_dsc_controller.arms.batch import inertia_matrices, regressors_at
from blf_dsc_controller.arms.chain_kernels import ROTOR
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.arms.urdf import read_chain
from blf_dsc_controller.compiled.jit import kernel

# The base stands on the floor, is mounted on a wall, or is tilted.
ARMS = {
    'one': (*random_urdf(1, 11), 'base', 'tip', (0.0, 0.0, -9.81)),
    'two': (*random_urdf(2, 12), 'base', 'tip', (0.0, 9.81, 0.0)),
    'three': (*random_urdf(3, 13), 'base', 'tip', (1.0, -3.0, 5.0)),
    'six': (*random_urdf(6, 14), 'base', 'tip', (1.0, -3.0, 5.0)),
    'nine': (*random_urdf(9, 15), 'base', 'tip', (0.0, 0.0, 9.81)),
    'panda': (
        (CONFIG / 'panda.urdf').read_text(),
        PANDA,
        'panda_link0',
        'panda_hand_tcp',
        (0.0, 0.0, -9.81),
    ),
    'ur5e': ((CONFIG / 'ur5e.urdf').read_text(), UR5E, 'world', 'tool0', (9.81, 0.0, 0.0)),
}


class Case:
    """An arm, its inertias phi, a random state, and the same arm in pinocchio."""

    def __init__(self, name):
        text, joints, base, tip, gravity = ARMS[name]
        self.chain = read_chain(text, base, tip, joints)
        self.arm = serial_chain(self.chain, gravity)
        self.n = self.arm.n
        self.random = np.random.default_rng(self.n)
        self.q, self.dq, self.v, self.a = self.random.normal(size=(4, self.n))
        self.rotors = self.random.uniform(0.01, 0.3, self.n)
        self.phi = np.column_stack((self.chain.inertias, self.rotors)).ravel()
        self.model = pinocchio_model(text, joints)
        self.model.gravity.linear[:] = gravity
        self.model.armature[:] = self.rotors
        self.data = self.model.createData()
        self.theirs = configuration(self.model, self.q)

    def H(self, q, dq, v, a):
        H = np.full((self.n, self.arm.p), np.nan)
        self.arm.regressor(q, dq, v, a, H)
        return H

    def momentum(self, q, dq):
        Yp, Yr = np.full((2, self.n, self.arm.p), np.nan)
        self.arm.momentum_regressor(q, dq, Yp, Yr)
        return Yp, Yr

    def matrices(self):
        """M, C and G computed by pinocchio."""
        M = pinocchio.crba(self.model, self.data, self.theirs).copy()
        C = pinocchio.computeCoriolisMatrix(self.model, self.data, self.theirs, self.dq).copy()
        G = pinocchio.computeGeneralizedGravity(self.model, self.data, self.theirs).copy()
        return M, C, G


@pytest.fixture(params=ARMS)
def case(request):
    return Case(request.param)


def test_torque_agrees_with_pinocchio(case):
    """Property III with the Christoffel C, where v and a are not the derivatives of q."""
    M, C, G = case.matrices()
    ours = case.H(case.q, case.dq, case.v, case.a) @ case.phi
    np.testing.assert_allclose(ours, M @ case.a + C @ case.v + G, atol=1e-10)


def test_inverse_dynamics_agree_with_pinocchio(case):
    torque = pinocchio.rnea(case.model, case.data, case.theirs, case.dq, case.a)
    np.testing.assert_allclose(
        case.H(case.q, case.dq, case.dq, case.a) @ case.phi, torque, atol=1e-10
    )


def test_columns_agree_with_the_joint_torque_regressor_of_pinocchio(case):
    theirs = pinocchio.computeJointTorqueRegressor(
        case.model, case.data, case.theirs, case.dq, case.a
    )
    ours = case.H(case.q, case.dq, case.dq, case.a).reshape(case.n, case.n, ROTOR + 1)
    np.testing.assert_allclose(ours[:, :, :ROTOR].ravel(), theirs.ravel(), atol=1e-10)
    np.testing.assert_array_equal(ours[:, :, ROTOR], np.diag(case.a))


def test_momentum_and_rest_agree_with_pinocchio(case):
    M, C, G = case.matrices()
    Yp, Yr = case.momentum(case.q, case.dq)
    np.testing.assert_allclose(Yp @ case.phi, M @ case.dq, atol=1e-10)
    np.testing.assert_allclose(Yr @ case.phi, G - C.T @ case.dq, atol=1e-10)


def test_coriolis_is_in_christoffel_form(case):
    """xi^T (dM/dt - 2 C) xi = 0 (Property I), M' by a central difference."""
    h, zero = 1e-5, np.zeros(case.n)
    ahead, behind = (case.momentum(case.q + s * case.dq, case.v)[0] for s in (h, -h))
    rate = (ahead - behind) @ case.phi / (2.0 * h)  # M' xi, with xi = v
    C_xi = (case.H(case.q, case.dq, case.v, zero) - case.H(case.q, zero, zero, zero)) @ case.phi
    scale = np.linalg.norm(case.v) * np.linalg.norm(rate)
    assert abs(case.v @ (rate - 2.0 * C_xi)) < 1e-7 * max(1.0, scale)


def test_torque_is_the_rate_of_momentum_plus_the_rest(case):
    """d/dt(Yp P) + Yr P = H(q, dq, dq, ddq) P, column by column, along a motion."""
    h = 1e-5
    ahead, behind = (
        case.momentum(case.q + s * case.dq + 0.5 * s * s * case.a, case.dq + s * case.a)[0]
        for s in (h, -h)
    )
    ours = (ahead - behind) / (2.0 * h) + case.momentum(case.q, case.dq)[1]
    expected = case.H(case.q, case.dq, case.dq, case.a)
    np.testing.assert_allclose(ours, expected, atol=1e-7 * max(1.0, np.abs(expected).max()))


@kernel
def all_three(model, q, dq, v, a, separate, together):
    model.regressor(q, dq, v, a, separate[0])
    model.momentum_regressor(q, dq, separate[1], separate[2])
    model.regressors(q, dq, v, a, together[0], together[1], together[2])


def test_kernels_agree_with_python_together_and_apart():
    case = Case('six')
    separate, together = np.full((2, 3, case.n, case.arm.p), np.nan)
    all_three(case.arm, case.q, case.dq, case.v, case.a, separate, together)
    np.testing.assert_array_equal(separate[0], case.H(case.q, case.dq, case.v, case.a))
    np.testing.assert_array_equal(separate[1:], case.momentum(case.q, case.dq))
    np.testing.assert_array_equal(together, separate)


def test_chosen_columns_keep_their_values_names_and_units():
    whole = Case('three')
    chosen = [(0, ROTOR), (1, 0), (1, 3), (2, 9)]
    part = serial_chain(whole.chain, ARMS['three'][-1], chosen)
    columns = [body * (ROTOR + 1) + entry for body, entry in chosen]
    rows = np.full((2, 3, 6), np.nan)  # wider, as with disturbance columns beside them
    part.momentum_regressor(whole.q, whole.dq, *rows)
    np.testing.assert_array_equal(
        rows[:, :, :4], np.array(whole.momentum(whole.q, whole.dq))[:, :, columns]
    )
    assert np.isnan(rows[:, :, 4:]).all()
    assert part.parameter_names == ('rotor1', 'm2', 'm*cz2', 'Izz3')
    rotor = 'kg' if whole.chain.joints[0].kind == 'prismatic' else 'kg m^2'
    assert part.parameter_units == (rotor, 'kg', 'kg m', 'kg m^2')
    assert {joint.kind for joint in whole.chain.joints} > {'prismatic'}


def test_many_states_at_once_give_the_regressors_of_each():
    case = Case('six')
    states = case.random.normal(size=(5, 4, case.n))
    H = regressors_at(case.arm, *np.moveaxis(states, 1, 0))
    np.testing.assert_array_equal(H, [case.H(*state) for state in states])


def test_inertia_matrices_match_pinocchio():
    case = Case('six')
    q = np.stack((case.q + 0.5, case.q))
    M = inertia_matrices(case.arm, case.phi, q)[1]
    np.testing.assert_allclose(M, case.matrices()[0], atol=1e-11)
