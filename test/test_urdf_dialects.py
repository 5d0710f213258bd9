# SPDX-License-Identifier: Apache-2.0
"""URDF and MJCF as people have them: newer versions, odd XML, grippers, parts beside the arm."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
from random_arm import ARMS, PANDA, PANDA_CHAIN, PANDA_TEXT

from blf_dsc_controller import BlfDscError, ControllerConfig, PlantConfig
from blf_dsc_controller.arms.urdf import frames, read_chain
from blf_dsc_controller.configuration.nodes import load
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.configuration.schema import build
from sim_plant.plant import plant_of

Q = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 7))


def chain_of(text):
    return read_chain(text, 'panda_link0', 'panda_hand_tcp', PANDA)


def quaternion_of(rpy):
    """The quaternion (x, y, z, w) of roll, pitch and yaw about fixed axes."""
    found = np.zeros(4)
    mujoco.mju_euler2Quat(found, np.array(rpy), 'XYZ')
    return found[[1, 2, 3, 0]]


def with_quaternions(text):
    """A URDF with `quat_xyzw` instead of every `rpy`; twice as long is as good."""

    def replaced(match):
        numbers = 2.0 * quaternion_of([float(word) for word in match[1].split()])
        return f'quat_xyzw="{" ".join(map(repr, numbers.tolist()))}"'

    return re.sub(r'rpy="([^"]*)"', replaced, text)


def test_quaternions_of_urdf_1_1_are_read():
    text = with_quaternions(PANDA_TEXT)
    assert text.count('quat_xyzw') == PANDA_TEXT.count('rpy=') > 20
    found = chain_of(text)
    np.testing.assert_allclose(found.inertias, PANDA_CHAIN.inertias, atol=1e-12)
    for ours, theirs in zip(frames(found, Q), frames(PANDA_CHAIN, Q), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def limited(more='', soft=''):
    """The Panda with other attributes of the first limit, and a safety controller."""
    text = re.sub(r'<limit ', f'<limit {more} ', PANDA_TEXT, count=1)
    return re.sub('(<limit [^>]*>)', rf'\1{soft}', text, count=1)


def test_accelerations_of_urdf_1_2_limit_the_motion():
    text = limited('acceleration="3.0" deceleration="2.0"')
    assert chain_of(text).joints[0].acceleration == 2.0
    values = {'robot.tip': 'panda_hand_tcp', 'joints': PANDA}
    usual, lower = (
        build(ControllerConfig, {**values, 'robot.urdf': each}).limits.acceleration
        for each in (PANDA_TEXT, text)
    )
    assert usual[0] > 2.0
    assert lower == (2.0, *usual[1:])


def test_safety_controllers_narrow_the_limits():
    soft = '<safety_controller soft_lower_limit="-9.0" soft_upper_limit="1.0" />'
    joint = chain_of(limited(soft=soft)).joints[0]
    assert (joint.lower, joint.upper) == (PANDA_CHAIN.joints[0].lower, 1.0)
    # without both, they are not known
    joint = chain_of(limited(soft='<safety_controller k_velocity="5" />')).joints[0]
    assert joint.upper == PANDA_CHAIN.joints[0].upper


@pytest.mark.parametrize(
    'changed',
    [
        lambda text: '\ufeff' + text,
        lambda text: text.replace('<robot ', '<robot xmlns="http://www.ros.org" ', 1),
        lambda text: text.replace(
            '</robot>', '<gazebo><sensor:camera a:b="c" /></gazebo></robot>'
        ),
    ],
    ids=['byte order mark', 'namespace', 'prefix'],
)
def test_what_urdfdom_reads_is_read(changed, tmp_path):
    text = changed(PANDA_TEXT)
    path = tmp_path / 'panda.urdf'
    path.write_text(text, encoding='utf-8')
    for given in (text, str(path)):
        chain = Robot(urdf=given, tip='panda_hand_tcp').chain(PANDA)
        np.testing.assert_array_equal(chain.inertias, PANDA_CHAIN.inertias)


def arm_in_mjcf(damping, limits=''):
    """Two links in MJCF, which has no velocities."""
    body = (
        '<body name="{0}" pos="0.3 0 0"><joint name="{0}" axis="0 1 0" damping="{1}" {2} />'
        '<inertial mass="3" pos="0.15 0 0" diaginertia="0.02 0.02 0.02" />'
    )
    bodies = ''.join(body.format(name, damping, limits) for name in ('a', 'b'))
    return f'<mujoco><worldbody>{bodies}</body></body></worldbody></mujoco>'


@pytest.mark.parametrize('limits', ['', 'actuatorfrcrange="-80 80"'])
def test_damping_that_no_drive_overcomes_is_a_placeholder_without_velocities(limits):
    """60 N m s/rad take 120 N m at 2 rad/s; 3 take 6."""
    for damping, is_placeholder in ((60.0, True), (3.0, False)):
        robot = Robot(urdf=arm_in_mjcf(damping, limits))
        chain = robot.chain(('a', 'b'))
        expected = 0.0 if is_placeholder else damping
        assert robot.friction(chain)['viscous'] == (expected, expected)


# Grippers, and arms beside their configuration.


def test_urdf_is_found_beside_the_file_that_names_it(tmp_path, monkeypatch):
    folder = tmp_path / 'robot'
    folder.mkdir()
    (folder / 'mine.urdf').write_text(PANDA_TEXT)
    path = folder / 'mine.yaml'
    path.write_text(
        '/**:\n  ros__parameters:\n    sample_time: 0.001\n'
        '    robot: {urdf: mine.urdf, tip: panda_hand_tcp}\n'
    )
    monkeypatch.chdir(tmp_path)
    assert load(path, 'blf_dsc_controller', ControllerConfig).joints == PANDA
    # that of the current folder takes precedence
    (tmp_path / 'mine.urdf').write_text('<robot name="other" />')
    with pytest.raises(BlfDscError, match='the links are none'):
        load(path, 'blf_dsc_controller', ControllerConfig)


# MuJoCo, with parts beside the arm.

BESIDE = {
    'fingers that mimic': (
        '<link name="thumb"><inertial><mass value="0.1" /><inertia ixx="1e-4" ixy="0" ixz="0" '
        'iyy="1e-4" iyz="0" izz="1e-4" /></inertial></link><link name="finger" />'
        '<joint name="thumb" type="prismatic"><parent link="tip" /><child link="thumb" />'
        '<limit lower="0" upper="0.1" effort="20" velocity="0.1" /></joint>'
        '<joint name="finger" type="prismatic"><parent link="tip" /><child link="finger" />'
        '<limit lower="0" upper="0.1" effort="20" velocity="0.1" /><mimic joint="thumb" /></joint>'
    ),
    'a free body': (
        '<link name="ball"><inertial><mass value="1" /><inertia ixx="1" ixy="0" ixz="0" '
        'iyy="1" iyz="0" izz="1" /></inertial></link>'
        '<joint name="free" type="floating"><parent link="base" /><child link="ball" /></joint>'
    ),
    'an IMU without mass': (
        '<link name="imu"><inertial><mass value="0" /><inertia ixx="0" ixy="0" ixz="0" iyy="0" '
        'iyz="0" izz="0" /></inertial></link>'
        '<joint name="imu" type="fixed"><parent link="tip" /><child link="imu" /></joint>'
    ),
    'a part of the base that is not physical': (
        '<link name="cover"><inertial><mass value="1" /><inertia ixx="9" ixy="0" ixz="0" iyy="1" '
        'iyz="0" izz="1" /></inertial></link>'
        '<joint name="lid" type="revolute"><parent link="base" /><child link="cover" />'
        '<limit lower="0" upper="1" effort="20" velocity="0.1" /></joint>'
    ),
}


def mass_matrix(text, joints):
    values = {'robot.urdf': text, 'robot.tip': 'tip', 'joints': joints}
    model = plant_of(build(PlantConfig, {**values, 'physics': 'mujoco'})).model
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M


@pytest.mark.parametrize('beside', BESIDE)
def test_parts_beside_the_arm_do_not_matter_in_mujoco(beside):
    text, joints, *_ = ARMS['three']
    expected = mass_matrix(text, joints)
    assert expected.shape == (3, 3)
    found = mass_matrix(text.replace('</robot>', f'{BESIDE[beside]}</robot>'), joints)
    if 'fingers' in beside:  # they have a mass
        assert (np.diag(found) > np.diag(expected)).all()
    else:
        np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize(
    ('rpy', 'expected'),
    [
        ((0.0, 0.0, 0.7), (0.0, 0.0, -9.81)),
        ((np.pi / 2, 0.0, 0.0), (0.0, -9.81, 0.0)),
        ((np.pi, 0.0, 0.0), (0.0, 0.0, 9.81)),
        ((0.0, np.pi / 2, 0.0), (9.81, 0.0, 0.0)),
    ],
)
def test_gravity_turns_with_the_fixed_joints_below_the_base(rpy, expected):
    """A bimanual OpenArm got -10.1 instead of -0.06 N m."""
    stand = (
        '<link name="stand"/><joint name="mount" type="fixed"><parent link="stand"/>'
        f'<child link="panda_link0"/><origin rpy="{" ".join(map(str, rpy))}"/></joint></robot>'
    )
    given = {
        'robot.urdf': PANDA_TEXT.replace('</robot>', stand),
        'robot.base': 'panda_link0',
        'robot.tip': 'panda_hand_tcp',
        'joints': PANDA,
    }
    np.testing.assert_allclose(
        build(ControllerConfig, given).robot.gravity, expected, atol=1e-9
    )
