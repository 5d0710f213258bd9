# SPDX-License-Identifier: Apache-2.0
"""Arms against pinocchio and plain formulas; base parameters, and their prior.

Rules of URDFs.
"""

from __future__ import annotations

import re
from math import inf

import numpy as np
import pinocchio
import plain_law
import pytest
from closed_loop_case import MODEL
from plants import ARM
from random_arm import (
    ARMS,
    GRAVITY,
    PANDA,
    PANDA_CHAIN,
    PANDA_TEXT,
    chain_of,
    configuration,
    pinocchio_model,
)

from blf_dsc_controller.arms.base_parameters import (
    CENTRE,
    base_parameters,
    prior_factor,
)
from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.model import arm_model, inertia_matrices, regressors_at
from blf_dsc_controller.arms.serial_chain import ROTOR, serial_chain
from blf_dsc_controller.arms.two_link import urdf
from blf_dsc_controller.arms.urdf import frames, read_chain
from blf_dsc_controller.errors import BlfDscError
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
        bodies = rigid_bodies(
            self.chain, self.gravity, self.chain.inertias, self.rotors
        )
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
        same(case.now.origin[i + 1], placed.translation)
        same(case.now.rotation[i + 1], placed.rotation)
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
    ours = arm_model(l1=arm.l1, gravity=arm.g)
    P = np.empty(3)
    arm.fill_parameters(0.0, P)
    theirs = serial_chain(chain, GRAVITY)
    phi = np.column_stack((chain.inertias, np.zeros(2))).ravel()
    states = np.random.default_rng(0).normal(size=(4, 20, 2))
    found = regressors_at(ours, *states) @ P
    expected = regressors_at(theirs, *states) @ phi
    # points have 1e-9 kg m^2 in it
    np.testing.assert_allclose(found, expected, atol=1e-7)
    np.testing.assert_allclose(frames(chain, np.zeros(2))[-1][:3, 3], (1.8, 0.0, 0.0))


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
    assert model.parameter_names == ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')
    assert model.parameter_units == ('kg m^2',) * 3
    inner, outer = arm.m1 + arm.m2, arm.m2
    assert (
        pytest.approx([inner * arm.l1**2, outer * arm.l2**2, outer * arm.l1 * arm.l2])
        == P
    )


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


def test_base_parameters_agree_with_the_literature():
    """43 for a Panda (Gaz et al., 2019), 36 for an arm like the UR.

    Rotors except at the base.
    """
    for chain, inertial, rotors in ((PANDA_CHAIN, 43, 5), (UR5E_CHAIN, 36, 4)):
        names = base_parameters(chain, GRAVITY).model.parameter_names
        found = sum(name.startswith('rotor') for name in names)
        assert (len(names) - found, found) == (inertial, rotors)
    base = base_parameters(PANDA_CHAIN, GRAVITY)
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
    rotors = np.full(base.model.n, 0.02)
    tip = np.append(chain.tip_placement[:3, 3], 1.0)
    L = prior_factor(chain, base, 3.0, rotors)

    def distance(body, changed, rotor=0.02):
        inertias, others = chain.inertias, rotors.copy()
        inertias[body], others[-1] = changed, rotor
        off = base.of(inertias, others) - base.of(chain.inertias, rotors)
        # the least that gives it
        return np.linalg.norm(np.linalg.lstsq(L, off, rcond=None)[0])

    for i, ten in enumerate(chain.inertias):
        assert distance(i, 1.3 * ten) < 1.0 + 1e-6
        assert distance(i, inertia_of(T @ pseudo_inertia(ten) @ T.T)) < 1.05 / 100.0
    load = inertia_of(3.0 * np.outer(tip, tip))
    # a point mass, where an extended body is expected
    assert distance(-1, ten + load) < 1.5
    assert distance(-1, ten + 10.0 * load) > 2.0
    assert distance(-1, ten, rotor=0.04) < 1.0 + 1e-6


def test_prior_without_payload_is_tighter():
    base = base_parameters(UR5E_CHAIN, GRAVITY)
    loaded, empty = (
        prior_factor(UR5E_CHAIN, base, load, np.full(6, 0.02)) for load in (5.0, 0.0)
    )
    assert np.linalg.matrix_rank(empty) == base.model.p
    assert np.linalg.eigvalsh(loaded @ loaded.T - empty @ empty.T)[0] > -1e-12
    tool = base.model.parameter_names.index('m*cx6')
    assert np.linalg.norm(empty[tool]) == pytest.approx(0.365 * CENTRE)


# Chains are read from a URDF by its rules; unusable files are rejected with a remedy.


def test_limits_are_read_from_the_file_and_infinite_where_they_are_missing():
    def limits(text):
        joint = panda(text).joints[0]
        return joint.lower, joint.upper, joint.velocity, joint.effort

    given = '<limit lower="-2.8973" upper="2.8973" velocity="2.175" effort="87" />'
    unlimited = '<limit effort="0" velocity="0" lower="-9" upper="9" />'
    assert limits(PANDA_TEXT) == (-2.8973, 2.8973, 2.175, 87.0)
    assert limits(changed(given, '', 1)) == (-inf, inf, inf, inf)
    assert limits(changed(given, unlimited, 1)) == (-9.0, 9.0, inf, inf)
    continuous = changed(FIRST_JOINT, FIRST_JOINT.replace('revolute', 'continuous'))
    assert limits(continuous) == (-inf, inf, 2.175, 87.0)


def test_friction_is_read_from_the_file_and_zero_by_default():
    text = changed(AXIS, f'{AXIS}<dynamics damping="3" friction="2" />', 1)
    found = [(joint.damping, joint.friction) for joint in panda(text).joints[:2]]
    assert found == [(3.0, 2.0), (0.0, 0.0)]


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


LINK7 = PANDA_TEXT[PANDA_TEXT.index('<link name="panda_link7">') :]
LINK7_INERTIAL = (
    LINK7[LINK7.index('<inertial>') : LINK7.index('</inertial>')] + '</inertial>'
)
WEIGHTLESS = changed(LINK7_INERTIAL, '').replace(
    '<mass value="0.73" />', '<mass value="0" />'
)

FIRST_JOINT = '"panda_joint1" type="revolute"'
AXIS = '<axis xyz="0 0 1" />'
MASS = '<mass value="0.73" />'
LINK8 = '<link name="panda_link8" />'
WRONG_TEXTS = (  # what is replaced, by what, and the remedy
    (LINK8, '<link name="${name}_link8" />', 'xacro FILE > robot.urdf'),
    (PANDA_TEXT, 'l1: 1.0', 'not a URDF, as it is not valid XML'),
    (PANDA_TEXT, PANDA_TEXT[:6000], '</robot>: if it was cut off, copy it again'),
    (PANDA_TEXT, '<sdf />', 'is <robot>, not <sdf>'),
    (AXIS, f'<mimic joint="j" />{AXIS}', "'panda_joint1' mimics"),
    (
        FIRST_JOINT,
        FIRST_JOINT.replace('revolute', 'floating'),
        'expected fixed, revolute',
    ),
    (
        'finger_joint1" type="prismatic"',
        'finger_joint1" type="floating"',
        "on 'panda_hand' is fl",
    ),
    (
        'effort="87"',
        'effort="-87"',
        'has <limit effort="-87">: it is a magnitude, so give 87',
    ),
    (MASS, '<mass value="-0.73" />', "link 'panda_hand' has a mass of -0.73 kg"),
    ('izz="0.0017"', 'izz="-0.0017"', 'none can be negative'),
    (AXIS, '<axis xyz="0 0 0" />', 'is zero'),
    ('upper="2.8973"', 'upper="-3"', 'empty range, -2.8973 to -3'),
    (MASS, '<mass value="heavy" />', '<mass value="heavy">: expected 1 finite number'),
    (MASS, '<mass value="0,73" />', 'write decimal points, and spaces between numbers'),
    (
        LINK8,
        '<link name="panda_link7" />',
        "each link needs a unique name; got 'panda_link7' 2 times: rename",
    ),
    ('<robot', '\n<?xml version="1.0"?><robot', 'remove what is above its <?xml'),
    ('<robot', '<!DOCTYPE html><html>404</html><robot', 'it is a web page'),
    (LINK8, '', "has the child 'panda_link8', but the links are"),
    (
        'child link="panda_right',
        'child link="panda_left',
        "'panda_leftfinger' is the child of two",
    ),
)
WRONG_CHAINS = (
    ({'tip': 'tool'}, "no link 'tool' for the tip: the links are panda_link0, "),
    ({'tip': 'Panda_Link7'}, "; did you mean 'panda_link7'?"),
    ({'text': '<robot name="a"><group /></robot>', 'joints': ()}, 'perhaps an SRDF'),
    (
        {'tip': '', 'joints': ()},
        'Set robot.tip to the last link of the arm, such as panda_link7',
    ),
    (
        {'text': re.sub('type="[rp]', 'type="x', PANDA_TEXT), 'tip': '', 'joints': ()},
        "no joint moves: 'panda_joint1' is xevolute, ",
    ),
    (
        {'text': '<robot><link name="a" /></robot>', 'tip': '', 'joints': ()},
        'there is none. The joints of an arm are revolute, continuous, prismatic',
    ),
    ({'tip': 'panda_joint7'}, "is a joint, and the tip is a link: give 'panda_link7'"),
    (
        {'base': 'panda_leftfinger', 'tip': 'panda_rightfinger'},
        "ends at 'panda_link0' without rea",
    ),
    ({'joints': ('elbow', *PANDA[1:])}, "no joint 'elbow' in the URDF: its joints are"),
    ({'joints': PANDA[::-1]}, 'panda_joint7, in this order; got panda_joint7'),
    ({'joints': (*PANDA, 'panda_finger_joint1')}, 'choose another base or tip'),
    ({'base': 'panda_hand', 'joints': ()}, 'are none: choose another base or tip'),
    (
        {'text': WEIGHTLESS.replace('<mass value="0.015" />', '<mass value="0" />')},
        'nor has anything fixed to them: panda_link7 (moved by panda_joint7): add',
    ),
    (
        {'text': re.sub('<inertial>.*?</inertial>', '', PANDA_TEXT, flags=re.DOTALL)},
        'panda_link1 (moved by panda_joint1), panda_link2 (moved by panda_joint2), ',
    ),
)


def test_unusable_urdf_is_rejected_with_a_remedy():
    cases = [
        ({'text': changed(old, new, 1)}, message) for old, new, message in WRONG_TEXTS
    ]
    arm = {
        'text': PANDA_TEXT,
        'base': 'panda_link0',
        'tip': 'panda_hand_tcp',
        'joints': PANDA,
    }
    for changes, message in (*cases, *WRONG_CHAINS):
        with pytest.raises(BlfDscError) as caught:
            read_chain(**arm | changes)
        assert message in str(caught.value)


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


@pytest.mark.parametrize(
    ('joints', 'message'),
    [
        (  # a parallelogram
            ('base one', 'one two', 'base three', 'three two'),
            "a loop of 'j1' ('base' to 'one'), 'j2' ('one' to 'two'), 'j3' ('base' to 'three'), ",
        ),
        (  # below the arm
            ('base one', 'one two', 'two three', 'three two'),
            "'two' is the child of two joints, in a loop of 'j3' ('two' to 'three'), 'j4' ",
        ),
        (  # without a root
            ('base one', 'one two', 'two base'),
            "joints form a loop, 'j2' ('one' to 'two'), 'j3' ('two' to 'base'), 'j1' ('base' to",
        ),
        (
            ('base one', 'two two'),
            "joints form a loop, 'j2' ('two' to 'two'): only trees",
        ),
    ],
)
def test_loop_of_joints_is_told_with_its_links(joints, message):
    inertial = '<inertial><mass value="1" /></inertial>'
    links = [
        f'<link name="{name}">{inertial}</link>'
        for name in ('base', 'one', 'two', 'three')
    ]
    ends = [each.split() for each in joints]
    elements = [
        f'<joint name="j{k}" type="revolute"><parent link="{a}" /><child link="{b}" /></joint>'
        for k, (a, b) in enumerate(ends, 1)
    ]
    text = f'<robot name="loop">{"".join(links + elements)}</robot>'
    with pytest.raises(BlfDscError) as caught:
        read_chain(text, '', 'one', ())
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ('chains', 'message'),
    [
        (  # two arms with hands on a torso that also carries a head
            (
                ('torso', 'base', 1),
                ('head', 'torso1', 2),
                ('left', 'torso1', 7),
                ('thumb', 'left7', 4),
                ('index', 'left7', 4),
                ('right', 'torso1', 7),
            ),
            ' and 9 more. Set robot.tip to the last link of the arm, such as left7 or right7',
        ),
        (  # a head above the first joint of the arm
            (('yaw', 'base', 1), ('head', 'yaw1', 1), ('arm', 'yaw1', 6)),
            'such as arm6',
        ),
        ((('arm', 'base', 6), ('f', 'arm6', 1), ('g', 'arm6', 1)), 'such as arm6'),
    ],
)
def test_branching_arms_are_proposed_by_their_last_links(chains, message):
    with pytest.raises(BlfDscError) as caught:
        read_chain(tree(*chains), '', '', ())
    assert str(caught.value).endswith(message)


@pytest.mark.parametrize('joint', ['jointGripper', 'left_finger_joint', 'wrist'])
def test_last_joint_that_is_called_a_gripper_is_taken_for_one(joint):
    text = tree(('arm', 'base', 4)).replace('arm_joint4', joint)
    found = read_chain(text, '', '', ()).gripper
    assert found == ('' if joint == 'wrist' else joint)
