# SPDX-License-Identifier: Apache-2.0
"""Values that no arm can mean are refused, with a word to insist on them."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_arm import random_urdf

from blf_dsc_controller import (
    ConfigurationError,
    ControllerConfig,
    PlantConfig,
)
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.warnings.table import config_warnings

UR5E = {'robot.urdf': 'ur5e.urdf', 'robot.tip': 'tool0'}  # reaches 1.04 m
EFFORTS = np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0])  # N m, of ur5e.urdf
COMPENSATED = UR5E | {'robot.drive_compensates': 'gravity'}
LOADED = COMPENSATED | {'robot.drive_payload': 0.7}


def each(value):
    return [float(value)] * 6


# What is refused, what may be meant, and a value that is none of another unit, but large.
CASES = {
    'torque twice': (UR5E, 'torque.limit', list(2.0 * EFFORTS), '150 N m', EFFORTS),
    'torque in mN m': (UR5E, 'torque.limit', list(1e3 * EFFORTS), '150 N m', EFFORTS),
    'velocity': (UR5E, 'safety.velocity_limit', each(180.0), 'Give 3.14', each(30.0)),
    'velocity of two links': (
        {},
        'safety.velocity_limit',
        [180.0] * 2,
        'Give 3.14',
        [100.0] * 2,
    ),
    'motion': (UR5E, 'limits.velocity', each(90.0), 'Give 1.57', each(3.1)),
    'upper': (UR5E, 'limits.position_upper', each(180.0), 'Give 3.14', each(3.2)),
    'lower': (UR5E, 'limits.position_lower', each(-180.0), 'Give -3.14', each(-3.2)),
    'bound': (
        UR5E,
        'barrier.bound',
        each(5.0),
        r'Give 0.0873; in mrad. Give 0.005',
        each(0.5),
    ),
    'bound of two links': ({}, 'barrier.bound', [5.0, 5.0], 'Give 0.0873', [0.5] * 2),
    'tool': (UR5E, 'barrier.tool_bound', 3.0, 'mm. Give 0.003', 0.1),
    'angle': (UR5E, 'barrier.tool_angle_bound', 2.0, 'Give 0.0349', 0.3),
    'gravity': (UR5E, 'robot.gravity', [0.0, 0.0, -9810.0], 'Give 9.81', [0, 0, 25.0]),
    'gravity of drives': (
        COMPENSATED,
        'robot.drive_gravity',
        [0.0, 0.0, -9810.0],
        'Give 9.81',
        [0, 0, 25.0],
    ),
    'payload': (UR5E, 'robot.payload', 5000.0, 'in g. Give 5', 20.0),
    'told': (COMPENSATED, 'robot.drive_payload', 700.0, 'in g. Give 0.7', 20.0),
    'centre': (
        LOADED,
        'robot.drive_payload_centre',
        [0.0, 0.0, 30.0],
        r'mm. Give \[0.0, 0.0, 0.03\]',
        [0.0, 0.0, 0.3],
    ),
    'rotor': (UR5E, 'robot.rotor_inertia', each(2e3), 'effort allows 150', each(1.0)),
    'coulomb': (UR5E, 'robot.coulomb', each(200.0), 'effort allows 150', each(20.0)),
    'viscous': (UR5E, 'robot.viscous', each(200.0), 'effort allows 150', each(20.0)),
}
OF_PLANT = {
    'bits': ('sensor.resolution', 20.0, 'bits. Give 5.99e-06', 0.01),
    'noise': ('sensor.position_noise', 0.1, 'degrees. Give 0.00175', 0.01),
    'lag': ('actuator.time_constant', 5.0, 'in ms. Give 0.005', 0.05),
}


@pytest.mark.parametrize('case', CASES)
def test_value_of_another_unit_or_arm_is_refused_and_can_be_insisted_on(case):
    is_refused(ControllerConfig, *CASES[case])


@pytest.mark.parametrize('case', OF_PLANT)
@pytest.mark.parametrize('arm', [{}, UR5E])
def test_value_of_a_simulated_arm_likewise(case, arm):
    is_refused(PlantConfig, arm, *OF_PLANT[case])


def is_refused(config, arm, name, value, words, large):
    with pytest.raises(ConfigurationError) as caught:
        build(config, arm | {name: value})
    (problem,) = caught.value.problems
    assert re.match(
        rf'{name}: got .*{words}.*; if it is meant, list {name} in', problem
    )
    insisting = build(config, arm | {name: value, 'insist': [name]})
    assert insisting.insist == (name,)
    given = [*map(float, np.ravel(large))] if np.ndim(large) else large
    build(config, arm | {name: given})


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(1, 7),
    unlimited=st.integers(0, 7),
    effort=st.floats(1e-2, 1e4),
    velocity=st.floats(1e-2, 1e2),
    width=st.floats(0.05, 10.0),
)
def test_what_follows_from_any_urdf_is_accepted(
    seed, n, unlimited, effort, velocity, width
):
    """Weak and strong arms, slow and fast, of narrow and wide ranges, or of none in part."""
    text, _ = random_urdf(n, seed)
    limit = (
        f'<limit lower="{-width / 2!r}" upper="{width / 2!r}" velocity="{velocity!r}" '
        f'effort="{effort!r}" />'
    )
    text = re.sub('<limit [^>]*>', limit, text)
    text = text.replace(limit, '', unlimited).replace('revolute', 'continuous')
    arm = {'robot.urdf': text, 'robot.tip': 'tip'}
    build(ControllerConfig, arm)
    build(PlantConfig, arm)


def test_joints_without_an_effort_have_that_of_an_arm_of_their_weight():
    """Four times the weight of the stretched UR5e with 3 kg, 98 N m."""
    text = build(ControllerConfig, UR5E).robot.text
    unknown = UR5E | {'robot.urdf': re.sub(r'effort="[^"]*"', 'effort="0"', text)}
    assert build(ControllerConfig, unknown).torque.limit == (100.0,) * 6
    build(ControllerConfig, unknown | {'torque.limit': each(390.0)})
    with pytest.raises(ConfigurationError, match='no drive of an arm of this weight'):
        build(ControllerConfig, unknown | {'torque.limit': each(400.0)})


@pytest.mark.parametrize(
    ('given', 'words'),
    [
        # Of the six joints, the widest may err by 0.73 rad.
        ({'barrier.tool_angle_bound': 1.5}, 'barrier.tool_angle_bound: .* give less'),
        ({'barrier.bound': each(0.5)}, 'barrier.bound: 0.5 rad is 28.6 degrees'),
        ({'safety.state_timeout': 40.0}, 'safety.state_timeout: in 40 s .* Give 0.04'),
        (
            {'safety.saturation_time': 500.0},
            'safety.saturation_time: in 500 s .* in ms',
        ),
    ],
)
def test_value_that_may_be_of_another_unit_is_named_before_the_start(given, words):
    found = config_warnings(build(ControllerConfig, UR5E | given))
    assert [text for text in found if re.match(words, text)], found
    usual = config_warnings(build(ControllerConfig, UR5E))
    assert not [text for text in usual if re.match(words, text)]
