# SPDX-License-Identifier: Apache-2.0
"""Messages about a joint that slides are in m and N, beside one that turns."""

from __future__ import annotations

import re
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

import blf_dsc_controller as blf
from blf_dsc_controller.commissioning.page import _wider
from blf_dsc_controller.commissioning.planned import _check_posture
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build, change
from blf_dsc_controller.errors import BlfDscError, ConfigurationError, StartError
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.reference.approach import _braked, check_takeover, hold
from blf_dsc_controller.reference.retargeting import MotionError, _check_positions
from blf_dsc_controller.reference.terms import minimum_jerk, pack
from blf_dsc_controller.run import SLIDING, TURNING
from blf_dsc_controller.supervision import retuning
from blf_dsc_controller.supervision.bound_warnings import width_warnings
from blf_dsc_controller.supervision.config_warnings import config_warnings
from blf_dsc_controller.supervision.expected_errors import expectation
from blf_dsc_controller.supervision.gear_warnings import gear_warnings
from blf_dsc_controller.supervision.state_check import StateCheck

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


def test_units_are_those_of_the_urdf():
    assert arm().units == (TURNING, SLIDING)


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
            {'barrier.bound': [0.1, 0.1], 'barrier.initial_bound': [0.0, 0.05]},
            'got 0.05 m for sliding, .* at least barrier.bound, 0.1 m',
        ),
        (
            {'barrier.weight': [0.5, 4.0], 'barrier.slope_limit': [9.0, 3.0]},
            'got 3 N/m for sliding, but it must be above barrier.weight, 4 N/m',
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


def test_starts_that_the_law_cannot_take_over():
    reference = pack(2, [hold(NOW)])
    bound = np.array([0.1, 0.1])
    for q, dq, text in (
        ([0.0, 0.2], [0.0, 0.0], r'\+0.2 m from .* its bound of 0.1 m:'),
        ([0.2, 0.0], [0.0, 0.0], r'\+0.2 rad from .* its bound of 0.1 rad:'),
        ([0.0, 0.0], [0.0, 90.0], r'\+90 m/s from .* make up only [\d.]+ m/s:'),
    ):
        with pytest.raises(StartError, match=text):
            check_takeover(arm(), bound, np.array(q), np.array(dq), reference)
    with pytest.raises(StartError, match=r'moves at 90 m/s, .* limit is [\d.]+ m/s:'):
        _braked(arm(), NOW, np.array([0.0, 90.0]), 0.0)


def test_reference_that_would_pass_its_limits():
    away = minimum_jerk(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [0.0, 3.0]]))
    with pytest.raises(MotionError, match=r'at 3 m at .* are -1 to 1 m: send'):
        _check_positions(away, 0.0, 1.0, arm())


def test_velocities_that_cannot_be():
    check = StateCheck(JOINTS, arm().units, 1e-3)
    fault = check.contradicted(np.array([0.0, 0.5]), np.array([0.0, -0.5]))
    assert "'sliding' is -0.5 m/s, but its positions change by +0.5 m/s" in fault.text
    safety = arm().safety
    fault = check.invalid(safety, np.array([0.0, 0.0, 0.0, 90.0, 0.0, 0.0]))
    assert re.search(r"'sliding' is \+90 m/s: .*, [\d.]+ m/s$", fault.text)


def test_values_that_a_running_law_cannot_take():
    sample = SimpleNamespace(xi1=np.array([0.0, 5.0]), torque=np.array([0.0, 99.0]))
    running = SimpleNamespace(sample=sample)
    settings = settings_of_config(arm())
    (outside,) = retuning._outside_bound(running, arm(), settings, 0.0)
    assert re.search(r'sliding is 5 m from .* bound of [\d.]+ m: choose', outside)
    (held,) = retuning._above_torque_limit(running, arm())
    assert re.search(r'sliding is held with 99 N now, .* limit of 40 N: choose', held)


@pytest.mark.parametrize(
    ('at', 'text'),
    [
        ((0.0, 60.0), 'sliding would be at 60 m, beyond its limits, -1 to 1 m$'),
        ((0.0, 1.0), r'at 1 m, less than [\d.]+ m from its limits, -1 to 1 m$'),
        (
            (50.0, 0.0),
            'at 50 rad, beyond its limits, -1 to 1 rad; if this is in degrees',
        ),
    ],
)
def test_postures_that_cannot_be_measured(at, text):
    with pytest.raises(BlfDscError, match=text):
        _check_posture(arm(), np.array(at))


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
    (wide,) = width_warnings(change(arm(), {'barrier.bound': [0.3, 0.7]}), None)
    assert wide == 'barrier.bound: 0.7 m bounds nothing: is it in mm? Give 0.0007'
    unlimited = config_warnings(arm(URDF.replace('effort="40"', 'effort="0"')))
    (told,) = (each for each in unlimited if 'no effort' in each)
    assert told == (
        'torque.limit: no effort in the URDF for turning, sliding: 100 N m or 100 N is assumed; '
        'give the rated torque of each drive'
    )


def test_bounds_that_are_too_fine_or_become_wider():
    both_slide = URDF.replace('revolute', 'prismatic')
    given = {'robot.urdf': both_slide, 'robot.tip': 'tip', 'barrier.tool_bound': 1e-9}
    with pytest.raises(ConfigurationError, match=r'\w+ would be \S+ m, finer'):
        build(ControllerConfig, {'joints': list(JOINTS), **given})
    before, after = (
        change(arm(), {'barrier.bound': [0.1, bound]}) for bound in (0.05, 0.06)
    )
    found = SimpleNamespace(joints=JOINTS, before=before, config=after)
    assert _wider(found) == {'barrier.bound': ['sliding 0.06 m instead of 0.05']}


def test_errors_to_expect_and_gains_that_nobody_measured():
    assert re.fullmatch(
        r'\d+ mm by friction, .*; \d+ mm of sliding when 3 kg are picked up in motion',
        expectation(arm()),
    )
    damping = np.array([2.0, 1.0])
    settings = SimpleNamespace(feedback=SimpleNamespace(gain=damping))
    (soft,) = gear_warnings(arm(), settings)
    assert 'sliding with a damping of 1 N s/m.' in soft


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
