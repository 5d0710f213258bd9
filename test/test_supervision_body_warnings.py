# SPDX-License-Identifier: Apache-2.0
"""Warnings about bodies and ranges that no arm has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import blf_dsc_controller as blf
from blf_dsc_controller import change
from blf_dsc_controller.arms.inertia import inertia_of, moved
from blf_dsc_controller.warnings.bodies import body_warnings
from blf_dsc_controller.warnings.table import config_warnings

PANDA = blf.load_loop('panda_rigid').controller
CHAIN = PANDA.robot.chain(PANDA.joints)


def with_joint(**changes):
    """Return the chain of a Panda with another second joint."""
    first, second, *others = CHAIN.joints
    return replace(CHAIN, joints=(first, second._replace(**changes), *others))


def body(*moments):
    """Return the ten of 2 kg with second moments [kg m^2] about a centre that is elsewhere."""
    place = np.eye(4)
    place[:3, 3] = 0.1, -0.2, 0.3
    return inertia_of(moved(np.diag([*moments, 2.0]), place))


@pytest.mark.parametrize('preset', ['panda', 'ur5e', 'fr3', 'openarm', 'widowx', 'yam'])
def test_nothing_is_said_of_arms_that_exist(preset):
    config = blf.load_loop(preset).controller
    assert list(body_warnings(config.robot.chain(config.joints))) == []


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'lower': -200.0, 'upper': 80.0}, 'turns 44.6 times from limit to limit'),
        ({'lower': -12.0, 'upper': 13.0}, ''),
        ({'lower': -200.0, 'upper': 80.0, 'kind': 'continuous'}, ''),
        ({'inertia': body(1e-6, 1e-6, 1e-6)}, 'has 2 kg within 1.2 mm of its centre'),
        ({'inertia': body(1e-2, 1e-2, 0.0)}, ''),  # a plate
        ({'inertia': body(1e-2, 1e-2, -4e-4)}, ''),  # as published figures are rounded
        ({'inertia': body(1e-2, 1e-2, -1e-3)}, 'no body has the inertia of what'),
        ({'inertia': np.zeros(10)}, ''),
    ],
)
def test_joint_that_no_arm_has_is_named(changes, said):
    found = list(body_warnings(with_joint(**changes)))
    assert len(found) == bool(said)
    for text in found:
        assert text.startswith('robot.urdf: ')
        assert 'panda_joint2' in text
        assert said in text


def test_arm_in_millimetres_is_asked_about():
    tip = CHAIN.tip_placement.copy()
    tip[0, 3] = 500.0
    (text,) = body_warnings(replace(CHAIN, tip_placement=tip))
    assert text.endswith('are its lengths in m?')


def test_they_are_among_the_warnings_of_a_configuration():
    inertia = 'ixx="0.007962" iyy="0.02811" izz="0.025995"'
    other = PANDA.robot.urdf.replace(inertia, 'ixx="0.09" iyy="0.02" izz="0.025995"')
    assert other != PANDA.robot.urdf
    found = config_warnings(change(PANDA, {'robot.urdf': other}))
    assert [text for text in found if 'no body has the inertia' in text]
