# SPDX-License-Identifier: Apache-2.0
"""Chains are read from a URDF by its rules; unusable files are rejected with a remedy."""

from __future__ import annotations

import re
from math import inf

import numpy as np
import pytest
from random_arm import PANDA, PANDA_TEXT, chain_of

from blf_dsc_controller.arms.urdf import inertia_of, pseudo_inertia, read_chain
from blf_dsc_controller.errors import BlfDscError


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
    np.testing.assert_allclose(fingers[:4], (last.inertia - alone.inertia)[:4], atol=1e-12)
    assert not any(joint.held.any() for joint in whole.joints[:6])
    shorter = read_chain(PANDA_TEXT, 'panda_link0', 'panda_link7', PANDA)
    np.testing.assert_allclose(shorter.joints[6].inertia, last.inertia)


def test_chain_may_begin_and_end_inside_the_arm():
    chain = read_chain(PANDA_TEXT, 'panda_link2', 'panda_link4', PANDA[2:4])
    whole = panda(PANDA_TEXT)
    np.testing.assert_allclose(chain.joints[0].inertia, whole.joints[2].inertia)
    # The wrist is then a rigid load.
    assert chain.joints[1].inertia[0] == pytest.approx(sum(j.inertia[0] for j in whole.joints[3:]))


def test_pseudo_inertia_is_positive_only_for_physical_bodies():
    inertia = chain_of('ur5e').joints[1].inertia.copy()
    np.testing.assert_allclose(inertia_of(pseudo_inertia(inertia)), inertia, atol=1e-15)
    assert np.linalg.eigvalsh(pseudo_inertia(inertia))[0] > 0.0
    inertia[9] = 3.0 * inertia[4] + 3.0 * inertia[6]  # Izz > Ixx + Iyy
    assert np.linalg.eigvalsh(pseudo_inertia(inertia))[0] < 0.0


def panda(text):
    return read_chain(text, 'panda_link0', 'panda_hand_tcp', PANDA)


def changed(old, new, count=-1):
    assert old in PANDA_TEXT
    return PANDA_TEXT.replace(old, new, count)


LINK7 = PANDA_TEXT[PANDA_TEXT.index('<link name="panda_link7">') :]
LINK7_INERTIAL = LINK7[LINK7.index('<inertial>') : LINK7.index('</inertial>')] + '</inertial>'
WEIGHTLESS = changed(LINK7_INERTIAL, '').replace('<mass value="0.73" />', '<mass value="0" />')

FIRST_JOINT = '"panda_joint1" type="revolute"'
AXIS, MASS, LINK8 = '<axis xyz="0 0 1" />', '<mass value="0.73" />', '<link name="panda_link8" />'
WRONG_TEXTS = (  # what is replaced, by what, and the remedy
    (LINK8, '<link name="${name}_link8" />', 'xacro FILE > robot.urdf'),
    (LINK8, '<xacro:hand />', 'xacro FILE > robot.urdf'),
    (PANDA_TEXT, 'l1: 1.0', 'not a URDF, as it is not valid XML'),
    (PANDA_TEXT, '<sdf />', 'is <robot>, not <sdf>'),
    (AXIS, f'<mimic joint="j" />{AXIS}', "'panda_joint1' mimics"),
    (FIRST_JOINT, FIRST_JOINT.replace('revolute', 'floating'), 'expected fixed, revolute'),
    ('finger_joint1" type="prismatic"', 'finger_joint1" type="floating"', "on 'panda_hand' is fl"),
    ('effort="87"', 'effort="-87"', 'has <limit effort="-87">: it is a magnitude, so give 87'),
    ('velocity="2.175"', 'velocity="-2"', 'so give 2'),
    (MASS, '<mass value="-0.73" />', "link 'panda_hand' has a mass of -0.73 kg"),
    ('izz="0.0017"', 'izz="-0.0017"', 'none can be negative'),
    (AXIS, '<axis xyz="0 0 0" />', 'is zero'),
    ('upper="2.8973"', 'upper="-3"', 'empty range, -2.8973 to -3'),
    (MASS, '<mass value="heavy" />', '<mass value="heavy">: expected 1 finite number'),
    (AXIS, '<axis xyz="0 1" />', 'expected 3 finite number'),
    (LINK8, '<link name="panda_link7" />', 'each link needs a unique name'),
    (LINK8, '', "has the child 'panda_link8', but the links are"),
    ('child link="panda_right', 'child link="panda_left', "'panda_leftfinger' is the child of two"),
)
WRONG_CHAINS = (
    ({'tip': 'tool'}, "no link 'tool' for the tip: the links are panda_link0, "),
    ({'base': 'world'}, "no link 'world' for the base"),
    ({'base': 'panda_leftfinger', 'tip': 'panda_rightfinger'}, "ends at 'panda_link0' without rea"),
    ({'joints': ('elbow', *PANDA[1:])}, "no joint 'elbow' in the URDF: its joints are"),
    ({'joints': PANDA[::-1]}, 'panda_joint7, in this order; got panda_joint7'),
    ({'joints': PANDA[:6]}, 'panda_joint7, in this order'),
    ({'joints': (*PANDA, 'panda_finger_joint1')}, 'choose another base or tip'),
    ({'base': 'panda_hand', 'joints': ()}, 'are none'),
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
    cases = [({'text': changed(old, new, 1)}, message) for old, new, message in WRONG_TEXTS]
    arm = {'text': PANDA_TEXT, 'base': 'panda_link0', 'tip': 'panda_hand_tcp', 'joints': PANDA}
    for changes, message in (*cases, *WRONG_CHAINS):
        with pytest.raises(BlfDscError) as caught:
            read_chain(**arm | changes)
        assert message in str(caught.value)


def test_all_zero_tensor_and_rounding_below_zero_are_accepted():
    given = 'ixx="0.001" iyy="0.0025" izz="0.0017"'
    for izz in ('0', '-2e-35'):
        assert panda(changed(given, f'ixx="0" iyy="0" izz="{izz}"')).joints[6].inertia[0] > 0.73


def test_expanded_file_may_still_declare_the_xacro_namespace():
    text = changed('<robot name', '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name')
    assert len(panda(text).joints) == 7
