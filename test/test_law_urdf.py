# SPDX-License-Identifier: Apache-2.0
"""The law on arms from URDFs: gains and prior, and drives that are lighter than assumed."""

from __future__ import annotations

import numpy as np
import pytest
from nights import at_night
from paper_case import configured, several
from random_arm import PANDA_TEXT

from blf_dsc_controller import (
    ConfigurationError,
    ControllerConfig,
    change,
    load_loop,
    simulate,
)
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.factory.estimate import (
    columns_of,
    estimate_names,
)
from blf_dsc_controller.factory.settings import settings_of_config
from sim_plant.settings import plant_settings

ARM = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}


def panda(**changes):
    whole = {'feedback.inertia': 'whole'}
    return build(
        ControllerConfig,
        ARM | whole | {k.replace('__', '.'): v for k, v in changes.items()},
    )


def test_urdf_and_tip_are_enough_to_configure_an_arm():
    config = panda()

    assert config.joints == tuple(f'panda_joint{i}' for i in range(1, 8))
    assert config.torque.limit == (87.0,) * 4 + (12.0,) * 3
    assert config.limits.position_upper[3] == pytest.approx(-0.0698)
    assert config.safety.torque == 'hold_gravity'
    speeds = [1.2 * 2.175] * 4 + [1.2 * 2.61] * 3
    assert config.safety.velocity_limit == pytest.approx(speeds)
    names = estimate_names(config)
    assert len(names) == 48 + 14
    assert {'m*cx7', 'rotor7', 'viscous panda_joint1', 'coulomb panda_joint7'} <= set(
        names
    )


def test_friction_of_the_urdf_is_known_unless_the_drives_compensate_it():
    config = load_loop('fr3').controller
    known = {'gravity': [0.003] * 7 + [0.2] * 7, 'gravity_and_friction': [0.0] * 14}
    for compensated, friction in known.items():
        given = change(config, {'robot.drive_compensates': compensated})
        assert [column.initial for column in columns_of(given)] == friction


def test_urdf_may_be_given_as_text_or_file(tmp_path):
    assert panda(robot__urdf=PANDA_TEXT).learning == panda().learning
    echoed = tmp_path / 'echoed.urdf'  # as `ros2 topic echo` writes the text
    echoed.write_text(f'{PANDA_TEXT}\n---\n')
    assert panda(robot__urdf=str(echoed)).learning == panda().learning
    # as a failed xacro leaves it: not to select the two-link arm
    empty = tmp_path / 'arm.urdf'
    empty.write_text('\n')
    with pytest.raises(ConfigurationError, match=r'arm.urdf.* is empty: did the xacro'):
        panda(robot__urdf=str(empty))


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'robot.urdf': 'nowhere.urdf'}, 'robot.urdf: .*nowhere.urdf.* cannot be read'),
        ({'robot.urdf': 'a\0.urdf'}, 'robot.urdf: .* cannot be read: embedded null'),
        (
            {'robot.urdf': '~nobody-here/a.urdf'},
            'robot.urdf: .* cannot be read: .*home directory',
        ),
        (
            {'robot.urdf': 'package:///arm.urdf'},
            "cannot be read: '' is not a valid package name",
        ),
        (
            {'robot.urdf': __file__},
            r"robot.urdf: '\S+' is not XML: give a URDF or MJCF$",
        ),
        ({'robot.tip': 'hand'}, "robot.urdf: no link 'hand' for the tip"),
        (
            {'robot.tip': ''},
            'robot.urdf: neither a tip .* not one chain: .*panda_finger_joint1',
        ),
        (
            {'robot.urdf': 'package://no_such/arm.urdf'},
            "package 'no_such' was not found",
        ),
        (
            {'robot.rotor_inertia': [0.1]},
            'robot.rotor_inertia: got 1, but 7 entries are needed',
        ),
        ({'robot.lag': 'short'}, 'robot.lag: got "short", but a double is expected'),
        (
            {'barrier.bound': [0.01] * 2},
            'barrier.bound: got 2, but 7 entries are needed',
        ),
    ],
)
def test_problems_with_an_arm_are_reported(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        build(ControllerConfig, ARM | changes)


def test_bound_starts_as_a_funnel_where_an_unknown_load_makes_the_arm_sag():
    def started(**given):
        return settings_of_config(panda(**given)).barrier.initial_bound

    bound = started()
    assert bound[0] == 0.002  # its axis is vertical
    assert 0.01 < bound[5] < 0.03
    assert started(robot__payload=0.0)[5] < 0.2 * bound[5]
    assert (started(barrier__bound=[0.03] * 7) == 0.03).all()


def test_bound_holds_from_the_start_with_an_undeclared_rated_load():
    def run(law):
        config = configured(
            'panda_rigid', 1.5, law, several({'begin': 0.0, 'payload': 3.0})
        )
        return simulate(config.controller, config.plant).run()

    result = run({})
    assert np.abs(result.error).max() > 0.005
    assert np.all(np.abs(result.error) < 0.6 * result.bound)
    assert np.all(result.bound[-1] < 0.0051)
    assert not result.stops


@pytest.mark.parametrize('preset', ['panda_rigid', *at_night('ur5e_rigid')])
def test_drives_much_lighter_than_guessed_oscillate_and_stop_unless_they_are_given(
    preset,
):
    truth = {'truth.rotor_factor': 0.3, 'duration': 6.0, 'events.begin': [100.0]}
    loop = load_loop(preset, {'sim_plant': truth})
    robot = loop.controller.robot
    guess = robot.rotors(robot.chain(loop.controller.joints))
    (stop,) = simulate(loop.controller, loop.plant).run().stops
    assert 'oscillates at' in stop.text
    known = {'robot.rotor_inertia': (0.3 * guess).tolist()}
    told = load_loop(preset, {'sim_plant': truth, 'blf_dsc_controller': known})
    run = simulate(told.controller, loop.plant).run()
    assert not run.stops
    assert np.abs(run.error / run.bound).max() < 0.8


def test_integrator_takes_as_many_steps_as_friction_on_a_light_joint_needs():
    for factor, fewest, most in ((1.3, 1, 1), (0.1, 6, 1000)):
        loop = load_loop('ur5e_rigid', {'sim_plant': {'truth.rotor_factor': factor}})
        assert fewest <= plant_settings(loop.plant).steps <= most
