# SPDX-License-Identifier: Apache-2.0
"""No law throws an arm: what leaves of its torques keeps speeds, ranges and limits.

A law that works against its arm is at most 1.25 times as fast as each joint may be, is
stopped within 0.5 rad of where it began, and the arm comes to rest.  The speeds are the
true ones of the simulated arm.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from adversary_law import KINDS
from hypothesis import given, settings
from hypothesis import strategies as st
from nights import at_night
from scenario import Scenario

import blf_dsc_controller as blf

LAW = str(Path(__file__).with_name('adversary_law.py'))
BEGIN = 0.3  # s
PEAK = 1.25  # of the velocity limit of each joint
FAR = 0.5  # rad
REST = 0.05  # rad/s


def against(preset, kind, changes=None, plant=None, **gains):
    """Return an arm whose law works against it from BEGIN on."""
    given = {f'gains.{name}': value for name, value in gains.items()}
    given |= {
        'law': LAW,
        'reference.type': 'hold',
        'gains.kind': KINDS.index(kind),
        'gains.begin': BEGIN,
    }
    return Scenario(preset, given | (changes or {}), plant=plant)


def fastest(arm):
    """Return the velocity limits (n,) [rad/s] of the joints."""
    joints = arm.config.robot.chain(arm.config.joints).joints
    return np.array([joint.velocity for joint in joints])


def check_harmless(arm, seconds):
    """Run an arm; check its speeds, its way, its torques, and that it comes to rest."""
    record = arm.run(BEGIN + seconds)
    after = record.since(round(BEGIN / arm.T))
    assert (after.speed.max(axis=0) <= PEAK * fastest(arm)).all()
    assert np.abs(after.q - after.q[0]).max() < FAR
    assert (np.abs(after.torque) <= arm.config.torque.limit).all()
    if arm.text:
        assert any(name in arm.text for name in arm.config.joints)
        assert after.speed[-round(0.1 / arm.T) :].max() < REST
    return after


PANDA_AND_UR5E = [
    ('panda', 'constant', {'pattern': 0b0101010}),
    ('panda', 'zero', {}),
    ('panda', 'feeding', {'pattern': 5}),
    ('panda', 'square', {'frequency': 5.0}),
    ('ur5e', 'constant', {'pattern': 0b111111}),
    ('ur5e', 'reversed', {}),
    ('ur5e', 'square', {'frequency': 20.0}),
    ('ur5e', 'random', {'pattern': 3}),
]


@pytest.mark.parametrize(('preset', 'kind', 'gains'), PANDA_AND_UR5E)
def test_law_that_works_against_its_arm_is_stopped(preset, kind, gains):
    arm = against(preset, kind, **gains)
    check_harmless(arm, 1.7)
    assert arm.controller.phase is blf.Phase.SAFE_STOP
    assert arm.reason in {'velocity not plausible', 'oscillation', 'torque saturated'}


@pytest.mark.nightly
@settings(max_examples=int(os.environ.get('EXAMPLES', '300')))
@given(
    st.sampled_from(['panda', 'ur5e', 'fr3', 'openarm', 'yam']),
    st.sampled_from(KINDS),
    st.floats(0.1, 1.0),
    st.integers(0, 127),
    st.floats(0.5, 60.0),
)
def test_no_law_throws_an_arm(preset, kind, size, pattern, frequency):
    gains = {'size': size, 'pattern': pattern, 'frequency': frequency}
    check_harmless(against(preset, kind, **gains), 3.0)


def test_limit_of_speed_that_is_given_for_a_joint_holds_for_it():
    slow = [1.0, 2.6, 2.6, 2.6, 3.1, 3.1, 3.1]
    changes = {'safety.velocity_limit': slow, 'safety.error_ratio': 0.0}
    arm = against('panda', 'constant', changes, pattern=1, size=1.0)
    record = arm.run(1.0)
    # the elastic gear swings on by 0.2 rad/s beyond the 0.9 from which it is braked
    assert record.speed[:, 0].max() < 1.1
    assert arm.reason == 'velocity not plausible'


@pytest.mark.parametrize('end', ['lower', 'upper'])
def test_joint_can_stop_before_its_range_ends(end):
    config = blf.load_loop('panda').controller
    is_upper = end == 'upper'
    last = getattr(config.limits, f'position_{end}')[0]
    start = list(config.reference.offset)
    start[0] = last - 0.3 if is_upper else last + 0.3
    changes = {'reference.offset': start, 'safety.error_ratio': 0.0}
    plant = {'initial.position': start}
    gains = {'pattern': int(is_upper), 'size': 0.4}
    arm = against('panda', 'constant', changes, plant, **gains)
    past = (arm.run(1.0).q[:, 0] - last) * (1.0 if is_upper else -1.0)
    assert past.max() < config.barrier.bound[0]


PRESETS = ['panda', 'ur5e']
NIGHTLY = ['recommended', 'fr3', 'fr3_direct', 'openarm', 'yam', 'panda_rigid']


@pytest.mark.parametrize(
    'preset',
    [*PRESETS, *at_night(*NIGHTLY)],
)
def test_arm_in_order_is_never_braked(preset):
    arm = Scenario(preset)
    arm.run(3.0)
    assert arm.is_running
    assert arm.guard.envelope.braked == 0


def test_soft_limits_of_a_urdf_brake_a_joint_earlier():
    arm = blf.load_loop('panda').controller
    text = arm.robot.text
    soft = '<safety_controller k_position="2.0" k_velocity="8.0"/></joint>'
    head, _, tail = text.partition('name="panda_joint1"')
    body, _, rest = tail.partition('</joint>')
    changes = {'safety.error_ratio': 0.0}
    usual = against('panda', 'constant', changes, pattern=1).run(0.6)
    changes['robot.urdf'] = f'{head}name="panda_joint1"{body}{soft}{rest}'
    softer = against('panda', 'constant', changes, pattern=1).run(0.6)
    assert softer.speed[:, 0].max() < 0.7 * usual.speed[:, 0].max()


def test_torque_after_lost_states_changes_by_one_step():
    arm = Scenario('fr3_direct')
    arm.run(1.0)
    before = arm.guard.commanded.copy()
    gap = 30

    def lost(state):
        lost.count += 1
        return [] if lost.count <= gap else [state]

    lost.count = 0
    record = arm.run(0.05, spoil=lost)
    torques = np.vstack((before, record.torque))
    step = np.array(arm.config.torque.rate_limit) * arm.T
    assert (np.abs(np.diff(torques, axis=0)) <= step * (1.0 + 1e-6)).all()
