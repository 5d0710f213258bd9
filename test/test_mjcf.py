# SPDX-License-Identifier: Apache-2.0
"""Arms from MJCF: their dynamics are MuJoCo's own.

What no serial chain has is refused by name.
"""

from __future__ import annotations

import sys

import mujoco
import numpy as np
import pytest
from random_arm import CONFIG, PANDA, UR5E, cloud, words

from blf_dsc_controller import (
    BlfDscError,
    ControllerConfig,
    PlantConfig,
)
from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.arms.urdf import frames, read_chain
from blf_dsc_controller.configuration.files import resolve
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.configuration.schema import build, flatten

OPENARM = 'package://openarm_mujoco/v2/openarm_bimanual.xml'
FR3 = 'package://franky_sim/assets/fr3.xml'


def inertial(random):
    """Return the inertia of a random cloud of points."""
    mass, centre, I = cloud(random)
    entries = (I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2])
    return (
        f'<inertial pos="{words(centre)}" mass="{mass!r}" '
        f'fullinertia="{words(entries)}"/>'
    )


def pose(random):
    return f'pos="{words(random.normal(size=3) * 0.3)}" quat="{words(random.normal(size=4))}"'


def joint(random, name):
    """Return a joint whose anchor and reference position are anywhere."""
    kind = 'slide' if random.random() < 0.25 else 'hinge'
    return (
        f'<joint name="{name}" type="{kind}" axis="{words(random.normal(size=3))}" '
        f'pos="{words(random.normal(size=3) * 0.1)}" ref="{random.normal()!r}" '
        f'armature="{random.uniform(0.01, 0.3)!r}" damping="{random.uniform(0.0, 2.0)!r}" '
        f'frictionloss="{random.uniform(0.0, 1.0)!r}"/>'
    )


def random_mjcf(seed, n):
    """Return an arm with merged bodies between its joints, and a gripper with fingers."""
    random = np.random.default_rng(seed)
    begin, end = '', ''
    for i in range(1, n + 1):
        moving = inertial(random) + joint(random, f'joint{i}')
        begin += f'<body name="body{i}" {pose(random)}>{moving}'
        fixed = f'<body name="fixed{i}" {pose(random)}>{inertial(random)}'
        is_between = random.random() < 0.4
        begin += fixed if is_between else f'{fixed}</body>'
        end = ('</body></body>' if is_between else '</body>') + end
    fingers = ''.join(
        f'<body name="finger{k}" {pose(random)}>{inertial(random)}'
        f'{joint(random, f"gripper{k}")}</body>'
        for k in (1, 2)
    )
    return (
        f'<mujoco><compiler angle="radian"/><option gravity="{words(random.normal(size=3) * 6)}"/>'
        f'<worldbody><body name="base" {pose(random)}>{begin}{fingers}'
        f'<site name="hand" {pose(random)}/>{end}</body></worldbody></mujoco>'
    )


def robot_of(given):
    """Return robot and chain as a configuration has them."""
    config = build(PlantConfig, given)
    return config.robot, config.robot.chain(config.joints)


def torques(robot, chain, states):
    """Return M ddq + C dq + G + D dq of our kernels, (samples, n)."""
    q, dq, ddq = states
    arm = serial_chain(chain, robot.gravity)
    phi = np.column_stack((chain.inertias, robot.rotors(chain))).ravel()
    H = regressors_at(arm, q, dq, dq, ddq)
    damping = np.array([joint.damping for joint in chain.joints])
    return H @ phi + damping * dq


def mujocos_torques(model, joints, states):
    """Return the same by mj_inverse, the other joints at rest at 0, without constraints."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.body_gravcomp[:] = 0.0
    data = mujoco.MjData(model)
    at = [model.joint(name).id for name in joints]
    found = []
    for q, dq, ddq in zip(*states, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = 0.0
        data.qpos[model.jnt_qposadr[at]] = q
        data.qvel[model.jnt_dofadr[at]] = dq
        data.qacc[model.jnt_dofadr[at]] = ddq
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse[model.jnt_dofadr[at]])
    return np.array(found)


def states_of(n, seed=0):
    return np.random.default_rng(seed).normal(size=(3, 10, n))


def agrees(robot, chain, model):
    names = [joint.name for joint in chain.joints]
    states = states_of(len(names))
    np.testing.assert_allclose(
        torques(robot, chain, states),
        mujocos_torques(model, names, states),
        rtol=1e-9,
        atol=1e-9,
    )


@pytest.mark.parametrize('base', ['', 'base'])
@pytest.mark.parametrize('seed', range(8))
def test_torques_of_random_arms_are_mujocos(seed, base):
    """With tilted bases, anchors, reference positions, merged bodies and fingers that are held."""
    n = 1 + seed % 7
    text = random_mjcf(seed, n)
    robot, chain = robot_of(
        {'robot.urdf': text, 'robot.base': base, 'robot.tip': 'hand'}
    )
    model = mujoco.MjModel.from_xml_string(text)
    agrees(robot, chain, model)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    tip = frames(chain, np.zeros(n))[-1]
    rotation = data.body(base or 'world').xmat.reshape(3, 3)
    expected = rotation.T @ (data.site('hand').xpos - data.body(base or 'world').xpos)
    np.testing.assert_allclose(tip[:3, 3], expected, atol=1e-12)
    turned = rotation.T @ data.site('hand').xmat.reshape(3, 3)
    np.testing.assert_allclose(tip[:3, :3], turned, atol=1e-12)


@pytest.mark.parametrize(
    ('file', 'tip', 'rotors', 'efforts'),
    [
        (
            OPENARM,
            'openarm_left_ee_base_link',
            (0.0081, 0.0081, 0.16, 0.16, 0.01, 0.01, 0.01),
            (40, 40, 27, 27, 7, 7, 7),
        ),
        (
            FR3,
            'hand',
            (0.195, 0.195, 0.195, 0.195, 0.074, 0.074, 0.074),
            (87, 87, 87, 87, 12, 12, 12),
        ),
    ],
)
def test_public_arms_have_mujocos_torques_and_nothing_is_guessed(
    file, tip, rotors, efforts
):
    """Meshes need not be where the file says: franky-sim gives them to the compiler itself."""
    robot, chain = robot_of({'robot.urdf': file, 'robot.tip': tip})
    assert robot.rotor_inertia == rotors
    assert tuple(joint.effort for joint in chain.joints) == efforts
    spec = mujoco.MjSpec.from_file(str(resolve(file)))
    for geom in spec.geoms:  # of the world: all others have an <inertial>
        spec.delete(geom)
    for mesh in spec.meshes:
        spec.delete(mesh)
    agrees(robot, chain, spec.compile())


@pytest.mark.parametrize(
    ('name', 'joints', 'tip'),
    [
        ('panda', PANDA, 'panda_hand_tcp'),
        ('ur5e', UR5E, 'tool0'),
        ('fr3', (), 'fr3_link8'),
    ],
)
def test_mjcf_and_urdf_of_an_arm_are_the_same_chain(name, joints, tip):
    """MuJoCo itself writes the URDF as MJCF."""
    text = (CONFIG / f'{name}.urdf').read_text(encoding='utf-8')
    spec = mujoco.MjSpec.from_string(text)
    spec.compiler.fusestatic = False
    for geom in spec.geoms:
        spec.delete(geom)
    spec.compile()
    ours = read_chain(text, '', tip, joints)
    theirs = robot_of({'robot.urdf': spec.to_xml(), 'robot.tip': tip})[1]
    q = states_of(len(ours.joints))[0]
    for placement, expected in zip(
        frames(theirs, q)[1:], frames(ours, q)[1:], strict=True
    ):
        # of the figures that MuJoCo writes
        np.testing.assert_allclose(placement, expected, atol=1e-5)
    np.testing.assert_allclose(theirs.inertias, ours.inertias, atol=1e-5)
    for each, expected in zip(theirs.joints, ours.joints, strict=True):
        assert each.name == expected.name
        assert (each.lower, each.upper) == pytest.approx(
            (expected.lower, expected.upper), abs=1e-5
        )
        assert each.effort == expected.effort
        assert each.damping == pytest.approx(expected.damping)
        assert each.friction == pytest.approx(expected.friction)


ARM = """<mujoco>
  <compiler angle="radian"/>
  <default>
    <default class="drive"><joint armature="0.1" damping="0.5" frictionloss="0.2"/></default>
  </default>
  <worldbody>
    <body name="upper">
      <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint name="shoulder" class="drive" axis="0 1 0" {upper}/>
      <body name="lower" pos="0.3 0 0">
        <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <joint name="elbow" class="drive" axis="0 1 0" {lower}/>
        <site name="tool" pos="0.3 0 0"/>
        {beyond}
      </body>
    </body>
  </worldbody>
  {more}
</mujoco>
"""


def arm(**parts):
    return ARM.format(**{'upper': '', 'lower': '', 'beyond': '', 'more': ''} | parts)


@pytest.mark.parametrize(
    ('parts', 'effort'),
    [
        ({'lower': 'actuatorfrcrange="-3 3"'}, 3.0),
        (
            {
                'more': '<actuator><motor joint="elbow" ctrlrange="-2 2" gear="5"/></actuator>'
            },
            10.0,
        ),
        (
            {
                'more': '<actuator><position joint="elbow" forcerange="-4 4" gear="2"/></actuator>'
            },
            8.0,
        ),
        # of two directions, what both allow
        ({'lower': 'actuatorfrcrange="-5 3"'}, 3.0),
        (
            {'more': '<actuator><motor joint="elbow" ctrlrange="-2 3"/></actuator>'},
            2.0,
        ),
        ({}, np.inf),
    ],
)
def test_effort_is_what_joint_and_actuators_allow(parts, effort):
    chain = robot_of({'robot.urdf': arm(**parts), 'robot.tip': 'tool'})[1]
    assert [joint.effort for joint in chain.joints] == [np.inf, effort]


def test_actuators_add_to_armature_and_damping_through_their_gear():
    """As mj_inverse has it."""
    motor = '<motor joint="elbow" gear="2" armature="0.01" damping="0.03"/>'
    text = arm(more=f'<actuator>{motor}</actuator>')
    robot, chain = robot_of({'robot.urdf': text, 'robot.tip': 'tool'})
    assert robot.rotor_inertia == pytest.approx((0.1, 0.14))
    assert [joint.damping for joint in chain.joints] == pytest.approx([0.5, 0.62])
    agrees(robot, chain, mujoco.MjModel.from_xml_string(text))


def test_file_with_includes_becomes_one_text_that_needs_neither_files_nor_mujoco(
    tmp_path, monkeypatch
):
    """As a bag has it: on a computer without MuJoCo it gives the same arm."""
    drives = (
        '<default><default class="drive"><joint armature="0.3"/></default></default>'
    )
    (tmp_path / 'drives.xml').write_text(f'<mujoco>{drives}</mujoco>', encoding='utf-8')
    begin, _, _, end = arm().replace('</default>', '<default>').split('<default>')
    file = tmp_path / 'arm.xml'
    file.write_text(f'{begin}<include file="drives.xml"/>{end}', encoding='utf-8')
    given = {'robot.urdf': str(file), 'robot.tip': 'tool'}
    config = build(ControllerConfig, given)
    assert config.robot.rotor_inertia == (0.3, 0.3)
    for each in tmp_path.iterdir():
        each.unlink()
    monkeypatch.setitem(sys.modules, 'mujoco', None)
    assert build(ControllerConfig, flatten(config)) == config


def test_without_mujoco_the_error_says_how_to_install_it(monkeypatch, tmp_path):
    file = tmp_path / 'arm.xml'
    file.write_text(arm(), encoding='utf-8')
    monkeypatch.setitem(sys.modules, 'mujoco', None)
    with pytest.raises(BlfDscError, match=r'arm\.xml is MJCF.*pip install'):
        Robot(urdf=str(file)).chain(())
