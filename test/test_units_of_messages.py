# SPDX-License-Identifier: Apache-2.0
"""Messages about a joint that slides are in m and N, beside one that turns."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

import blf_dsc_controller as blf
from blf_dsc_controller.analysis.metrics_table import contacts_text
from blf_dsc_controller.arms.joint_gains import JointGains
from blf_dsc_controller.bags.table import table
from blf_dsc_controller.cli.commission_robot import _limits
from blf_dsc_controller.commissioning import page
from blf_dsc_controller.commissioning.commissioning import Commissioning
from blf_dsc_controller.commissioning.planned import _check_posture
from blf_dsc_controller.commissioning.proof import Errors
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build, change
from blf_dsc_controller.control.goal_tolerances import tolerances
from blf_dsc_controller.errors import BlfDscError, ConfigurationError, StartError
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law.torque_sensors import OFF
from blf_dsc_controller.messages.named_values import external_names
from blf_dsc_controller.reference.approach import _braked, check_takeover, hold
from blf_dsc_controller.reference.retargeting import MotionError, _check_positions
from blf_dsc_controller.reference.terms import minimum_jerk, pack
from blf_dsc_controller.run import SLIDING, TURNING, Series
from blf_dsc_controller.supervision import first_torque, gain_limits, retuning
from blf_dsc_controller.supervision.bound_warnings import width_warnings
from blf_dsc_controller.supervision.config_warnings import config_warnings
from blf_dsc_controller.supervision.contact import contact_of
from blf_dsc_controller.supervision.digits import largest_error
from blf_dsc_controller.supervision.expected_errors import expectation
from blf_dsc_controller.supervision.gear_warnings import gear_warnings
from blf_dsc_controller.supervision.not_sensors import text_of
from blf_dsc_controller.supervision.oscillation_check import OscillationCheck
from blf_dsc_controller.supervision.state_check import StateCheck
from blf_dsc_controller.supervision.stop_cause import chatter_of
from blf_dsc_controller.view import texts

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
    assert page._wider(found) == {'barrier.bound': ['sliding 0.06 m instead of 0.05']}


def test_errors_to_expect_and_gains_that_nobody_measured():
    assert re.fullmatch(
        r'\d+ mrad and \d+ mm by friction, .*; \d+ mrad of turning and \d+ mm of sliding '
        'when 3 kg are picked up in motion',
        expectation(arm()),
    )
    unlike = [TURNING, SLIDING, TURNING]
    assert largest_error(np.array([3e-3, 1e-3, 2e-3]), unlike) == '3 mrad and 1 mm'
    alike = largest_error(np.array([3e-3, 4e-3]), [SLIDING] * 2, JOINTS)
    assert alike == '4 mm of sliding'
    damping = np.array([2.0, 1.0])
    settings = SimpleNamespace(feedback=SimpleNamespace(gain=damping))
    (soft,) = gear_warnings(arm(), settings)
    assert 'sliding with a damping of 1 N s/m.' in soft


def law(**state):
    """A controller of which only this is known; the second joint slides."""
    limits = SimpleNamespace(limit=np.array([40.0, 40.0]))
    return SimpleNamespace(settings=SimpleNamespace(torque=limits), **state)


@pytest.mark.parametrize(
    ('noise', 'why'), [(1e-8, 'in steps of 3 mm, and'), (1.0, 'velocity is noisy')]
)
def test_force_that_chatters(noise, why):
    sensor = SimpleNamespace(resolution=np.array([0.0, 3e-3]), noise=np.full(2, noise))
    effect = SimpleNamespace(chatter=np.array([0.0, 81.0]))
    controller = law(checks=SimpleNamespace(effect=effect, sensor=sensor))
    told = chatter_of(controller, arm())
    assert 'the torque of sliding changes by 9 N rms each sample: ' in told
    assert why in told


def test_force_that_oscillates():
    waves = SimpleNamespace(amplitude=np.array([0.0, 25.0]), half=np.full(2, 0.05))
    controller = law(checks=SimpleNamespace(oscillation=waves))
    shaking = OscillationCheck(arm(), controller)._find(np.array([False, True]))
    assert shaking.text == "joint 'sliding' oscillates at 10 Hz with +-25 N"


def test_contact_with_a_joint_that_slides():
    felt = {'external': np.array([0.1, -7.0]), 'interval': np.array([2.0, 3.0])}
    sample = SimpleNamespace(
        external=felt['external'], external_interval=felt['interval'], contact=[0, 9.0]
    )
    contact = contact_of(SimpleNamespace(sample=sample), arm(), 0)
    assert "the external torque is -7 N on joint 'sliding', and " in contact.text
    assert ' explain at most 3 N (' in contact.text
    now = SimpleNamespace(felt_at=1, **felt)
    assert re.search(
        r'on sliding: -7 N, of .* at most 3 N$',
        texts.contact_of(arm().robot.chain(JOINTS).joints, now),
    )
    measured = SimpleNamespace(
        contacts=[{'time': 2.0, **contact._asdict()}],
        units=dict(zip(JOINTS, arm().units, strict=True)).__getitem__,
    )
    assert contacts_text(measured).startswith('1: at 2.000 s -7 N on sliding (')


def test_forces_that_efforts_do_not_show_or_drives_do_not_tolerate():
    sensors = SimpleNamespace(fault=[OFF], joint=[1])
    off = SimpleNamespace(differences=np.array([[0.0, -3.0]]))
    controller = law(
        state=SimpleNamespace(sensors=sensors), signals=SimpleNamespace(sensors=off)
    )
    assert "of joint 'sliding' is off -3 N from" in text_of(controller, arm())
    gentle = change(arm(), {'torque.first_step': [2.0, 2.0]})
    told = first_torque._too_large_step(gentle, np.array([0.0, 5.0]), NOW)
    assert "step to 5 N on joint 'sliding', more than the 2 N that" in told
    needs = SimpleNamespace(torque=[10.0, 90.0])
    *_, found = gain_limits._limits_of_torque(arm(), needs)
    assert re.match(r'has 40 N, .* needs 90 N: .* at least 112 N if', found.text)


def test_efforts_that_no_drive_has_are_those_of_the_joints_that_are_named():
    """The greatest effort of all is infinite: none is given for the joint that turns."""
    large = URDF.replace('effort="40"', 'effort="0"', 1).replace('"40"', '"1e6"')
    (told,) = (each for each in config_warnings(arm(large)) if 'placeholder' in each)
    assert told.startswith('torque.limit: an effort of up to 1e+06 N for sliding looks')


def test_goal_that_a_joint_misses():
    missed = tolerances(JOINTS, ()).violation(
        arm(), np.array([[0.0, 0.2], [0.0, 0.0]]), np.array([0.1, 0.1])
    )
    assert missed == "'sliding' is +0.2 m from its reference, and 0.1 m are allowed"


def test_motion_of_a_commissioning_before_it_is_made():
    commissioning = Commissioning(
        change(arm(), {'reference.type': 'hold'}), [[0.1, 0.2]]
    )
    planned = commissioning.motions
    (described,) = map(page.description, planned)
    assert re.search(r'\[0.1, 0.2\] rad or m; the tool .* at \S+ (rad|m)/s$', described)
    options = SimpleNamespace(torque=0.1, travel=0.01)
    told = '\n'.join(_limits(options, commissioning, planned, 10.0))
    for text in (
        'at 0.3 rad/s or m/s at most: keep',
        'torques of 4, 4 N m or N (rms); torque.limit is 40, 40 N m or N',
        ' rad or m, any other check',
    ):
        assert text in told


def test_page_of_a_commissioned_arm():
    found = SimpleNamespace(
        joints=JOINTS,
        before=arm(),
        coulomb=None,
        assumed=np.array([0.5, 2.0]),
        unseen=np.array([0.0, 0.7]),
        choice=SimpleNamespace(
            gains=JointGains(np.array([9.0, 8.0]), np.array([2.0, 1.0]))
        ),
        findings=SimpleNamespace(
            inertia=np.array([0.6, np.nan]),
            unfit=np.zeros((1, 2), dtype=bool),
            damping=np.array([1.0, 1.0]),
            friction=np.array([0.1, 30.0]),
            resonances=(),
            rate=1e3,
            jitter=0.0,
            lost=0.0,
            resolution=np.array([1e-5, 2e-3]),
            drive_lag=np.nan,
        ),
    )
    *_, units, _, _ = page.table(found).splitlines()
    assert 'kg m^2 or kg' in units
    assert 'N m/rad or N/m' in units
    (states,) = page._of_states(found)
    assert states.endswith('positions in steps of 2 mm')
    *_, hidden = page._of_hidden(found, is_simulated=True)
    assert hidden.endswith('count it: sliding 0.7 kg')
    *_, friction = page._of_friction(found, is_simulated=True)
    assert 'sliding 30 N instead of' in friction
    errors = Errors(np.array([0.01, 0.02]), np.array([0.01, 0.02]))
    assert 'mrad or mm' in page.errors_table(arm(), errors)


def test_columns_of_a_recorded_run(tmp_path):
    config = change(arm(), {'reference.type': 'hold'})
    with blf.ArmController(config, record=tmp_path / 'bag') as controller:
        for k in range(3):
            controller.update(1.0 + 1e-3 * k, NOW, NOW, NOW)
    run = blf.read_run(tmp_path / 'bag')
    names = external_names(JOINTS)
    external = Series(names, run.stamp, np.zeros((run.stamp.size, len(names))))
    assert {
        'position sliding [m]',
        'torque sliding [N]',
        'torque turning [N m]',
        'monitor disturbance sliding [N]',
        'monitor viscous sliding [N s/m]',
        'monitor viscous turning [N m s/rad]',
        'monitor distance_to_bound sliding [m]',
        'external sliding [N]',
        'external sliding +- [N]',
        'external turning +- [N m]',
    } <= {*table(replace(run, external=external))}


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
