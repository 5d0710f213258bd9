# SPDX-License-Identifier: Apache-2.0
"""Arms with joints that slide: their drives, and commissioning them."""

from __future__ import annotations

import re

import numpy as np
import pytest
import yaml

from blf_dsc_controller import BlfDscError, Commissioning, ControllerConfig
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, dump
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.configuration.schema import build


def joint(name, kind, parent, axis, place, limits, effort, mass):
    """Return a joint of a URDF and the link that it moves, a ball of 10 cm."""
    lower, upper = limits
    inertia = ' '.join(f'{each}="{4e-3 * mass:g}"' for each in ('ixx', 'iyy', 'izz'))
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}" />'
        f'<child link="{name}_link" /><origin xyz="{place}" /><axis xyz="{axis}" />'
        f'<limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="2" /></joint>'
        f'<link name="{name}_link"><inertial><mass value="{mass}" />'
        f'<inertia {inertia} ixy="0" ixz="0" iyz="0" /></inertial></link>'
    )


def urdf(*joints):
    return f'<robot name="arm"><link name="base" />{"".join(joints)}</robot>'


# Axes meet in a point, so that no link has a length.
GANTRY = urdf(
    joint('x', 'prismatic', 'base', '1 0 0', '0 0 1', (-0.6, 0.6), 600, 30),
    joint('y', 'prismatic', 'x_link', '0 1 0', '0 0 0', (-0.4, 0.4), 400, 12),
    joint('z', 'prismatic', 'y_link', '0 0 1', '0 0 0', (-0.3, 0.0), 300, 5),
)
SCARA = urdf(
    joint('shoulder', 'revolute', 'base', '0 0 1', '0 0 0.4', (-2.3, 2.3), 120, 6),
    joint('elbow', 'revolute', 'shoulder_link', '0 0 1', '0.3 0 0', (-2.5, 2.5), 60, 4),
    joint('quill', 'prismatic', 'elbow_link', '0 0 1', '0.25 0 0', (-0.2, 0.0), 200, 2),
)
# Screws for the gantry; the quill of the SCARA likewise.  Stiff: above 150 Hz.
ARMS = {
    'gantry': {
        'urdf': GANTRY,
        'rotors': [30.0, 20.0, 15.0],  # kg
        'coulomb': [25.0, 15.0, 10.0],  # N
        'springs': [2e7, 2e7, 2e7],  # N/m
        'start': [0.0, 0.0, -0.15],
        'amplitude': [0.2, 0.1, 0.08],
    },
    'scara': {
        'urdf': SCARA,
        'rotors': [1.0, 0.4, 15.0],
        'coulomb': [2.5, 1.5, 8.0],
        'springs': [3e4, 2e4, 2e7],
        'start': [0.3, 0.9, -0.1],
        'amplitude': [0.4, 0.4, 0.05],
    },
}


def files_of(name, folder):
    """Write the parameters of an arm and its simulated truth; return their path."""
    arm = ARMS[name]
    path = folder / f'{name}.yaml'
    path.with_suffix('.urdf').write_text(arm['urdf'])
    robot = {
        'robot.urdf': f'{name}.urdf',
        'robot.rotor_inertia': arm['rotors'],
        'robot.coulomb': arm['coulomb'],
        'robot.joint_stiffness': arm['springs'],
    }
    plant = {
        'truth.mass_deviation': 0.2,
        'truth.rotor_inertia': arm['rotors'],
        'disturbance.coulomb': arm['coulomb'],
        'disturbance.coulomb_velocity': 0.01,  # rad/s or m/s
        'joint.stiffness': arm['springs'],
        'sensor.resolution': 1e-6,  # rad or m
        'actuator.delay': 1,
        'actuator.time_constant': 0.002,  # s
        'actuator.torque_noise': 0.005,
        'initial.position': arm['start'],
        'duration': 10.0,
    }
    reference = {
        'reference.type': 'sinusoids',
        'reference.offset': arm['start'],
        'reference.amplitude': arm['amplitude'],
        'reference.frequency': [1.5],  # rad/s
        'reference.phase': [0.3],
    }
    dump(path, {'/**': robot, PLANT: plant, CONTROLLER: reference})
    return path


def commission(name, folder, capsys):
    """Commission a simulated arm, where it starts; return what the command wrote and printed."""
    out = folder / 'commissioned.yaml'
    words = ['commission', '--config', str(files_of(name, folder)), '--out', str(out)]
    assert main([*words, '--posture', *map(str, ARMS[name]['start'])]) == 0
    sections = yaml.safe_load(out.read_text())
    values = {}
    for section in sections.values():
        values |= section['ros__parameters']
    return values, capsys.readouterr().out + out.read_text().split('/**:')[0]


def largest(text, unit):
    """Return the largest error of the simulated arm with its new gains."""
    (found,) = re.findall(
        rf'follows its own motion for 10 s, with ([\d.]+) {unit} at most', text
    )
    return float(found)


@pytest.mark.nightly
def test_stiff_gantry_gets_stiff_gains_in_newtons(tmp_path, capsys):
    values, text = commission('gantry', tmp_path, capsys)
    # a critically damped mass of 80, 50 or 25 kg at 1 Hz has as much
    stiffness = np.array(values['feedback.joint_stiffness'])
    assert (stiffness > np.array([80.0, 50.0, 25.0]) * (2.0 * np.pi) ** 2).all()
    assert largest(text, 'mm') < 2.5  # friction of 30 N by 1.5e4 N/m
    for unit in ('kg', 'N s/m', 'N/m', ' N ', ' mm'):
        assert unit in text
    assert not re.search(r'\b(m?rad|N m|kg m\^2)\b', text)


def test_scara_has_the_units_of_each_joint(tmp_path, capsys):
    values, text = commission('scara', tmp_path, capsys)
    # as above, 18 kg
    assert values['feedback.joint_stiffness'][2] > 18.0 * (2.0 * np.pi) ** 2
    for unit in ('kg m^2 or kg', 'N m/rad or N/m', 'N m s/rad or N s/m', 'N m or N'):
        assert unit in text
    assert re.search(r'with [\d.]+ mrad and [\d.]+ mm at most', text)
    told = re.sub(r'\n(# )?', ' ', text)
    assert re.search(r'gains: [\d.]+ mrad and [\d.]+ mm by friction', told)
    assert re.search(r'mrad of (shoulder|elbow) and [\d.]+ mm of quill when 3 kg', told)


def robot_of(text, **given):
    robot = Robot(urdf=text, **given)
    names = tuple(re.findall(r'joint name="(\w+)"', text))
    return robot, robot.chain(names)


def test_drives_of_a_gantry_are_no_placeholders():
    """They push 12, 20 and 38 times 1 m/s^2 and more: 40 times the weight is too much."""
    robot, chain = robot_of(GANTRY)
    assert robot.placeholder_efforts(chain) == ()
    np.testing.assert_array_equal(robot.efforts(chain), [600.0, 400.0, 300.0])
    # drives that reach 100 m/s^2 alone
    np.testing.assert_allclose(robot.rotors(chain), [6.0, 4.0, 3.0])
    weight = 9.81 * np.array([50.0, 20.0, 8.0])  # with 3 kg
    strong, chain = robot_of(GANTRY.replace('"300"', f'"{41.0 * weight[0]:.0f}"'))
    assert strong.placeholder_efforts(chain) == ('z',)
    np.testing.assert_allclose(
        strong.efforts(chain), np.minimum([600.0, 400.0, np.inf], weight)
    )
    unknown, chain = robot_of(GANTRY.replace('"400"', '"0"'))
    np.testing.assert_allclose(unknown.efforts(chain), [600.0, weight[1], 300.0])


def test_postures_of_a_joint_that_slides_may_be_2_cm_from_its_limits():
    config = build(ControllerConfig, {'robot.urdf': SCARA})
    (motion,) = Commissioning(config, [[0.3, 0.9, -0.021]]).motions
    assert motion.excitation.travel <= 0.01
    with pytest.raises(BlfDscError, match=r'at -0.019 m, less than 0.02 m from its'):
        _ = Commissioning(config, [[0.3, 0.9, -0.019]]).motions
    with pytest.raises(BlfDscError, match=r'at 2.26 rad, less than 0.05 rad from its'):
        _ = Commissioning(config, [[2.26, 0.9, -0.1]]).motions
