# SPDX-License-Identifier: Apache-2.0
"""Messages about a joint that slides are in m and N, beside one that turns."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest

import blf_dsc_controller as blf
from blf_dsc_controller import ConfigurationError, ControllerConfig, change
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.warnings.table import config_warnings

JOINTS = ('turning', 'sliding')
NOW = np.zeros(2)
URDF = (
    '<robot name="arm"><link name="base" />'
    + ''.join(
        f'<joint name="{name}" type="{kind}"><parent link="{parent}" /><child link="{child}" />'
        f'<origin xyz="0.3 0 0" /><axis xyz="{axis}" />'
        '<limit lower="-1" upper="1" effort="40" velocity="1" /></joint>'
        f'<link name="{child}"><inertial><origin xyz="0.1 0 0" /><mass value="2" /><inertia '
        'ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0" /></inertial></link>'
        for name, kind, axis, parent, child in (
            ('turning', 'revolute', '0 1 0', 'base', 'upper'),
            ('sliding', 'prismatic', '0 0 1', 'upper', 'tip'),
        )
    )
    + '</robot>'
)


@cache
def arm(urdf=URDF):
    return build(ControllerConfig, {'joints': list(JOINTS), 'robot.urdf': urdf})


@pytest.mark.parametrize(
    ('given', 'text'),
    [
        (
            {'limits.position_upper': [1.0, -2.0]},
            'got -2 m for sliding, but it must be above limits.position_lower, -1 m',
        ),
        (
            {'limits.position_upper': [-2.0, 1.0]},
            'got -2 rad for turning, but it must be above limits.position_lower, -1 rad',
        ),
        (
            {'torque.limit': [40.0, 90.0]},
            'got 90 N for sliding, but the URDF gives its drive 40 N;',
        ),
    ],
)
def test_problems_of_a_configuration(given, text):
    with pytest.raises(ConfigurationError, match=text):
        change(arm(), given)


def test_warnings_of_a_narrow_bound_and_of_efforts_that_are_not_given():
    narrow = change(arm(), {'barrier.bound': [0.9, 1e-4]})
    found = [each for each in config_warnings(narrow) if 'sliding' in each]
    (pick_up,) = (each for each in found if 'picked up' in each)
    assert re.search(
        r'to be [\d.]+ m from its reference, .* bound of 0.0001 m:', pick_up
    )
    (alone,) = (each for each in found if 'alone are' in each)
    assert re.search(
        r'to move sliding [\d.]+ m from its reference: give .* m, or', alone
    )
    unlimited = config_warnings(arm(URDF.replace('effort="40"', 'effort="0"')))
    (told,) = (each for each in unlimited if 'no effort' in each)
    assert told == (
        'torque.limit: no effort in the URDF for turning, sliding: 100 N m or 100 N is assumed; '
        'give the rated torque of each drive'
    )


def test_stop_at_the_bound():
    """An arm that is pushed past its bound while the law holds it."""
    with blf.ArmController(change(arm(), {'reference.type': 'hold'})) as controller:
        for k in range(2000):
            pushed = 0.5 * 1e-3 * max(0, k - 100)
            controller.update(
                1.0 + 1e-3 * k, (0.0, pushed), (0.0, 0.5 * (k > 100)), (0.0, 0.0)
            )
            if controller.reason:
                break
    assert re.search(
        r"'sliding' is \+[\d.]+ m from its reference: .* bound of [\d.]+ m\b",
        controller.reason,
    )


@pytest.mark.parametrize(
    ('velocity', 'text'),
    [
        (90.0, r"'sliding' is \+90 m/s"),
        (-0.5, r"'sliding' is -[\d.]+ m/s, but its positions change by \+[\d.]+ m/s:"),
    ],
)
def test_velocities_that_cannot_be(velocity, text):
    """Faster than any drive, and contrary to the motion."""
    with blf.ArmController(change(arm(), {'reference.type': 'hold'})) as controller:
        for k in range(400):
            after = max(0, k - 20)
            moved = (0.0, 0.5e-3 * after)
            dq = (0.0, velocity if after else 0.0)
            controller.update(1.0 + 1e-3 * k, moved, dq, NOW)
            if controller.reason:
                break
    assert re.search(text, controller.reason)
