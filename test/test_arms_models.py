# SPDX-License-Identifier: Apache-2.0
"""Arms against pinocchio and plain formulas; base parameters of chains, and their prior."""

from __future__ import annotations

import numpy as np
import pinocchio
import plain_law
import pytest
from closed_loop_case import MODEL
from plants import ARM
from random_arm import ARMS, chain_of, configuration, pinocchio_model

from blf_dsc_controller.arms.base_parameters import (
    CENTRE,
    base_parameters,
    deviations,
    payload_inertia,
    prior_factor,
)
from blf_dsc_controller.arms.model import arm_model, inertia_matrices, regressors_at
from blf_dsc_controller.arms.serial_chain import ROTOR, serial_chain
from blf_dsc_controller.arms.two_link import urdf
from blf_dsc_controller.arms.urdf import frames, inertia_of, pseudo_inertia, read_chain
from sim_plant.arm import PointMassArm, motion_of, rigid_arm, rigid_bodies


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


# The two-link arm.


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


# Base parameters.

WALL = (0.0, 9.81, 0.0)


def test_chosen_columns_keep_their_values_names_and_units():
    chain, (q, dq) = chain_of('three'), np.random.default_rng(0).normal(size=(2, 3))
    chosen = [(0, ROTOR), (1, 0), (1, 3), (1, ROTOR), (2, 9), (2, ROTOR)]
    part, whole = serial_chain(chain, WALL, chosen), serial_chain(chain, WALL)
    columns = [body * (ROTOR + 1) + entry for body, entry in chosen]
    # Wider, as with disturbance columns beside them.
    rows, every = np.full((2, 3, 8), np.nan), np.full((2, 3, whole.p), np.nan)
    part.momentum_regressor(q, dq, *rows)
    whole.momentum_regressor(q, dq, *every)
    np.testing.assert_array_equal(rows[:, :, :6], every[:, :, columns])
    assert np.isnan(rows[:, :, 6:]).all()
    assert part.parameter_names == ('rotor1', 'm2', 'm*cz2', 'rotor2', 'Izz3', 'rotor3')
    first, *others = ('kg' if j.kind == 'prismatic' else 'kg m^2' for j in chain.joints)
    assert part.parameter_units == (first, 'kg', 'kg m', others[0], 'kg m^2', others[1])
    assert {joint.kind for joint in chain.joints} > {'prismatic'}


PANDA, UR5E, *RANDOM = map(chain_of, ('panda', 'ur5e', 'three', 'nine'))
CHAINS = [PANDA, UR5E, *RANDOM]


@pytest.mark.parametrize('chain', CHAINS)
def test_base_parameters_are_the_smallest_set_that_gives_the_same_torques(chain):
    base = base_parameters(chain, WALL)
    whole = serial_chain(chain, WALL)
    n, p = base.model.n, base.model.p
    random = np.random.default_rng(5)
    inertias, joint_rotors = random.normal(size=(n, 10)), random.normal(size=n)
    P, phi = base.of(inertias, joint_rotors), np.column_stack((inertias, joint_rotors)).ravel()
    H, rows = np.zeros((n, p)), np.zeros((p, n, whole.p))
    for full in rows:
        q, dq, v, a = random.normal(size=(4, n))
        whole.regressor(q, dq, v, a, full)
        base.model.regressor(q, dq, v, a, H)
        np.testing.assert_allclose(H @ P, full @ phi, rtol=1e-8, atol=1e-8)
    singular = np.linalg.svd(rows.reshape(-1, whole.p), compute_uv=False)
    assert singular[p - 1] > 1e-3
    assert singular[p] < 1e-7  # pi / 2 has ten digits in the UR5e's file


def test_base_parameters_agree_with_the_literature():
    """43 for a Panda (Gaz et al., 2019), 36 for an arm like the UR; rotors except at the base."""
    for chain, inertial, rotors in ((PANDA, 43, 5), (UR5E, 36, 4)):
        names = base_parameters(chain).model.parameter_names
        found = sum(name.startswith('rotor') for name in names)
        assert (len(names) - found, found) == (inertial, rotors)
    base = base_parameters(PANDA)
    sums = dict(zip(base.model.parameter_names, base.combinations, strict=True))
    assert sums['Ixx7'] == 'Ixx7 - Iyy7'
    assert sums['m*cx7'] == 'm*cx7'
    assert sums['m*cx6'] == 'm*cx6 + 0.088 m7'
    assert not any(name.startswith(('m7', 'm*cz', 'Iyy')) for name in sums)


@pytest.mark.parametrize('chain', CHAINS)
def test_prior_covers_heavier_links_moved_centres_and_the_payload(chain):
    """A deviation in a single respect has a distance of at most 1, larger ones have more."""
    base, T = base_parameters(chain, WALL), np.eye(4)
    T[0, 3] = CENTRE / 100.0  # small, as this holds to first order only
    rotors, tip = np.full(base.model.n, 0.02), np.append(chain.tip_placement[:3, 3], 1.0)
    L = prior_factor(chain, base, 3.0, rotors)

    def distance(body, changed, rotor=0.02):
        inertias, others = chain.inertias, rotors.copy()
        inertias[body], others[-1] = changed, rotor
        off = base.of(inertias, others) - base.of(chain.inertias, rotors)
        return np.linalg.norm(np.linalg.lstsq(L, off, rcond=None)[0])  # the least that gives it

    for i, ten in enumerate(chain.inertias):
        assert distance(i, 1.3 * ten) < 1.0 + 1e-6
        assert distance(i, inertia_of(T @ pseudo_inertia(ten) @ T.T)) < 1.05 / 100.0
    load = inertia_of(3.0 * np.outer(tip, tip))
    assert distance(-1, ten + load) < 1.5  # a point mass, where an extended body is expected
    assert distance(-1, ten + 10.0 * load) > 2.0
    assert distance(-1, ten, rotor=0.04) < 1.0 + 1e-6


def test_prior_without_payload_is_tighter():
    base = base_parameters(UR5E)
    loaded, empty = (prior_factor(UR5E, base, load, np.full(6, 0.02)) for load in (5.0, 0.0))
    assert np.linalg.matrix_rank(empty) == base.model.p
    assert np.linalg.eigvalsh(loaded @ loaded.T - empty @ empty.T)[0] > -1e-12
    tool = base.model.parameter_names.index('m*cx6')
    assert np.linalg.norm(empty[tool]) == pytest.approx(0.365 * CENTRE)


def test_prior_of_a_ball_is_the_same_in_every_direction():
    J, turn = payload_inertia(2.0), np.eye(4)
    turn[:3, :3] = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    ten = deviations(J, 0.3, CENTRE)
    turned = np.transpose([inertia_of(turn @ pseudo_inertia(d) @ turn.T) for d in ten.T])
    np.testing.assert_allclose(turned @ turned.T, ten @ ten.T, atol=1e-15)
