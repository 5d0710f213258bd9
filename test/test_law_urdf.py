# SPDX-License-Identifier: Apache-2.0
"""The law on arms from URDFs, and what it learns of their loads."""

from __future__ import annotations

import numpy as np
import pytest
from paper_case import configured, several
from random_arm import PANDA_TEXT, random_urdf

from blf_dsc_controller import simulate
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.schema import build, change
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.law.factory import (
    columns_of,
    controller_of,
    estimate_names,
    model_of,
    prior_covariance,
    settings_of_config,
)

ARM = {'model': 'urdf', 'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}


def panda(**changes):
    return build(ControllerConfig, ARM | {k.replace('__', '.'): v for k, v in changes.items()})


def test_urdf_and_tip_are_enough_to_configure_an_arm():
    config = panda()

    assert config.joints == tuple(f'panda_joint{i}' for i in range(1, 8))
    assert config.torque.limit == (87.0,) * 4 + (12.0,) * 3
    assert config.limits.position_upper[3] == pytest.approx(-0.0698)
    assert config.safety.torque == 'hold_gravity'
    assert config.safety.velocity_limit == pytest.approx(3.0 * 2.61)
    names = estimate_names(config)
    assert len(names) == 48 + 14
    assert {'m*cx7', 'rotor7', 'viscous panda_joint1', 'coulomb panda_joint7'} <= set(names)


def test_threads_share_no_working_memory():
    first, second = model_of(panda()), model_of(panda())
    assert not np.shares_memory(first.vector, second.vector)


def test_friction_of_the_urdf_is_known_unless_the_drives_compensate_it():
    config = load_loop('fr3').controller
    known = {'gravity': [0.003] * 7 + [0.2] * 7, 'gravity_and_friction': [0.0] * 14}
    for compensated, friction in known.items():
        given = change(config, {'robot.drive_compensates': compensated})
        assert [column.initial for column in columns_of(given)] == friction


def test_given_parameters_override_the_derived_ones():
    config, derived = panda(barrier__bound=[0.01] * 7, robot__lag=0.002), panda()
    assert config.barrier.bound == (0.01,) * 7
    expected = derived.feedback.damping_rate * 8e-3 / 5e-3
    assert config.feedback.damping_rate == pytest.approx(expected)
    assert change(config, {'feedback.damping_rate': 5.0}).feedback.damping_rate == 5.0
    heavy = panda(robot__rotor_inertia=[0.2] * 7)
    assert heavy.robot.rotors(heavy.robot.chain(heavy.joints)).tolist() == [0.2] * 7


def test_urdf_may_be_given_as_text_or_file(tmp_path):
    assert panda(robot__urdf=PANDA_TEXT).learning == panda().learning
    empty = tmp_path / 'arm.urdf'  # as a failed xacro leaves it: not to select the two-link arm
    empty.write_text('\n')
    with pytest.raises(ConfigurationError, match=r'arm.urdf.* is empty: did the xacro'):
        panda(robot__urdf=str(empty))


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'robot.urdf': 'nowhere.urdf'}, 'robot.urdf: .*nowhere.urdf.* cannot be read'),
        ({'robot.urdf': 'a\0.urdf'}, 'robot.urdf: .* cannot be read: embedded null'),
        ({'robot.urdf': '~nobody-here/a.urdf'}, 'robot.urdf: .* cannot be read: .*home directory'),
        ({'robot.urdf': 'package:///arm.urdf'}, "cannot be read: '' is not a valid package name"),
        ({'robot.urdf': __file__}, r"robot.urdf: '\S+' is not XML: give a URDF$"),
        ({'robot.tip': 'hand'}, "robot.urdf: no link 'hand' for the tip"),
        ({'robot.tip': ''}, 'robot.urdf: neither a tip .* not one chain: .*panda_finger_joint1'),
        ({'joints': ['a', 'b']}, "robot.urdf: no joint 'a' in the URDF"),
        ({'robot.urdf': 'package://no_such/arm.urdf'}, "package 'no_such' was not found"),
        ({'robot.rotor_inertia': [0.1]}, 'robot.rotor_inertia: got 1, but 7 entries are needed'),
        ({'robot.lag': 'short'}, 'robot.lag: got "short", but a double is expected'),
        ({'barrier.bound': [0.01] * 2}, 'barrier.bound: got 2, but 7 entries are needed'),
        (
            {'learning.initial_estimate': [1.0] * 3, 'learning.adaptation_gain': [0.5] * 3},
            'learning.initial_estimate: got 3, but model urdf has 48',
        ),
    ],
)
def test_problems_with_an_arm_are_reported(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        build(ControllerConfig, ARM | changes)


def test_prior_covers_the_deviations_of_links_drives_and_friction():
    config = panda()
    deviation, covariance = deviations(config), prior_covariance(config)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    assert deviation['rotor7'] >= 0.5 * 12.0 / 400.0
    assert deviation['coulomb panda_joint1'] == pytest.approx(0.05 * 87.0)
    known = deviations(panda(robot__coulomb=[0.7] * 7))
    assert known['coulomb panda_joint1'] == pytest.approx(0.35)
    information = settings_of_config(config).information
    np.testing.assert_allclose(information @ covariance, np.eye(62), atol=1e-5)


def deviations(config):
    """Standard deviation of the prior of each estimate."""
    names, covariance = estimate_names(config), prior_covariance(config)
    return dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))


def test_gravity_is_compensated_with_the_initial_estimate():
    """At rest on the reference the torque is G of the URDF, whatever the gains."""
    config = panda(robot__gravity=[0.0, -9.81, 0.0])
    q = np.array(config.reference.offset)
    chain = config.robot.chain(config.joints)
    base = parameters_of(config.robot, chain)
    H = np.zeros((7, base.model.p))
    base.model.regressor(q, *np.zeros((3, 7)), H)
    gravity = H @ base.of(chain.inertias, config.robot.rotors(chain))
    assert np.abs(gravity).max() > 5.0
    torque = controller_of(config).update(0.0, 1e-3, np.concatenate((q, np.zeros(14))))
    np.testing.assert_allclose(torque, gravity, atol=0.02)  # P^(0) has four digits


def test_bound_starts_as_a_funnel_where_an_unknown_load_makes_the_arm_sag():
    barrier = panda().barrier
    assert barrier.initial_bound[0] == 0.0  # its axis is vertical
    assert 0.01 < barrier.initial_bound[5] < 0.03
    assert panda(robot__payload=0.0).barrier.initial_bound[5] < 0.2 * barrier.initial_bound[5]
    wide = panda(barrier__bound=[0.03] * 7).barrier
    assert wide.initial_bound == (0.0,) * 7
    assert panda(barrier__initial_bound=[0.0] * 7).barrier.widest == (0.002,) * 7


def test_bound_holds_from_the_start_with_an_undeclared_rated_load():
    def run(law):
        config = configured('panda', 1.5, law, several({'begin': 0.0, 'payload': 3.0}))
        return simulate(config.controller, config.plant).run()

    result = run({})
    assert np.abs(result.error).max() > 0.005
    assert np.all(np.abs(result.error) < 0.6 * result.bound)
    assert np.all(result.bound[-1] < 0.0051)
    assert not result.stops
    assert run({'barrier.initial_bound': [0.0] * 7}).stops  # with a constant bound


def test_drives_with_unknown_effort_limit_get_a_finite_prior():
    text = PANDA_TEXT.replace('effort="12"', 'effort="0"')
    config = panda(robot__urdf=text)
    assert np.all(np.isfinite(settings_of_config(config).information))
    rotor = config.robot.rotors(config.robot.chain(config.joints))[6]  # from the weight carried
    assert deviations(config)['rotor7'] == pytest.approx(0.5 * rotor)
    assert 0.005 < rotor < 0.03


def test_random_arm_with_prismatic_joints_needs_only_its_urdf():
    given = {'model': 'urdf', 'robot.urdf': random_urdf(4, seed=3)[0]}  # one chain: no tip needed
    config = build(ControllerConfig, given)
    assert config.joints == ('j1', 'j2', 'j3', 'j4')
    assert np.all(np.isfinite(settings_of_config(config).information))
