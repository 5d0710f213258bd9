# SPDX-License-Identifier: Apache-2.0
"""The law on arms from URDFs: gains and prior, and drives that are lighter than assumed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paper_case import configured, several
from plants import rigid_gears
from random_arm import PANDA_TEXT

from benchmark.studies import load_study
from blf_dsc_controller import (
    ConfigurationError,
    ControllerConfig,
    change,
    controller_of,
    load_loop,
    simulate,
)
from blf_dsc_controller.arms.tuning import over_postures
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.factory.estimate import (
    columns_of,
    estimate_names,
)
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.studies.monte_carlo import draw, plant_with
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


NOISY = {'sensor.velocity': 'measured', 'sensor.velocity_noise': 0.005}


def ran(preset, factor, plant=None, controller=None, sample_time=0.001):
    """Run a preset without a payload for 6 s, with rotors of `factor` times the guess."""
    given = {'sample_time': sample_time}
    truth = {'truth.rotor_factor': factor, 'duration': 6.0, 'events.begin': [100.0]}
    law = given | (controller or {})
    arm = given | truth | (plant or {})
    if preset == 'fr3':
        rigid = rigid_gears(7, 0.01)
        law = rigid['blf_dsc_controller'] | law
        arm = rigid['sim_plant'] | arm
    loop = load_loop(preset, {'blf_dsc_controller': law, 'sim_plant': arm})
    return simulate(loop.controller, loop.plant)


PANDA = [
    ('panda_rigid', factor, period)
    for factor in (0.0, 0.1, 0.4, 1.3)
    for period in (0.001, 0.002)
]
OTHERS = [('ur5e_rigid', 0.2, 0.001), ('ur5e_rigid', 0.4, 0.002), ('fr3', 0.1, 0.001)]


@pytest.mark.parametrize(('preset', 'factor', 'sample_time'), [*PANDA, *OTHERS])
def test_arm_keeps_its_bound_whatever_its_rotors_are(preset, factor, sample_time):
    """A UR5e from 0.2 of the guess on, or 0.4."""
    warned = {
        'safety.oscillation': 'warn'
    }  # a light arm oscillates until it is measured
    run = ran(preset, factor, controller=warned, sample_time=sample_time).run()
    assert not run.stops
    assert np.abs(run.error / run.bound).max() < (0.8 if preset == 'fr3' else 1.0)


def test_wrist_that_its_friction_moves_more_than_its_gains_stops_with_the_reason():
    """1.1 N m of friction on 0.007 kg m^2: no gains that the delay allows hold 5 mrad."""
    (stop,) = ran('ur5e_rigid', 0.1, sample_time=0.002).run().stops
    assert 'its drive seems to have ' in stop.text
    assert 'give robot.rotor_inertia, or a wider bound' in stop.text


def test_the_guess_stops_the_same_arm_where_nothing_is_measured():
    config = load_loop('panda_rigid').controller
    guess = config.robot.rotors(config.robot.chain(config.joints))
    assert (
        ran('panda_rigid', 0.1, controller={'robot.rotor_inertia': guess.tolist()})
        .run()
        .stops
    )


@pytest.mark.parametrize(
    'plant', [{}, {'sensor.resolution': 2.0 * np.pi / 2**16}, NOISY]
)
@pytest.mark.parametrize('factor', [1.0, 1.3])
def test_noise_is_not_mistaken_for_a_light_arm(factor, plant):
    state = ran('panda_rigid', factor, plant).controller.state
    assert (state.rotors.gain_scale == 1.0).all()
    assert (state.rotors.error == 0.0).all()


def test_measured_inertia_is_that_of_the_arm_where_the_loop_was_unstable():
    """Between the true inertia and what the loop tolerates, for each joint that was measured."""
    record = ran('panda_rigid', 0.1, controller={'safety.oscillation': 'warn'})
    config = record.config
    settings = record.controller.settings
    robot = config.robot
    chain = config.robot.chain(config.joints)
    limits = config.limits.position_lower, config.limits.position_upper
    base = parameters_of(robot, chain)
    scale = record.controller.state.rotors.gain_scale
    P = tuple(base.of(chain.inertias, 0.1 * settings.rotors.rotor))
    true = over_postures(chain, base, robot.payload, P, *limits)[0]
    measured = scale < 0.6
    ratio = (scale * settings.joint_inertia / true)[measured]
    assert ratio.size >= 3
    assert ratio.min() > 0.7
    assert ratio.max() < 2.0


def test_integrator_takes_as_many_steps_as_friction_on_a_light_joint_needs():
    for factor, fewest, most in ((1.3, 1, 1), (0.1, 6, 1000)):
        loop = load_loop('ur5e_rigid', {'sim_plant': {'truth.rotor_factor': factor}})
        assert fewest <= plant_settings(loop.plant).steps <= most


def swinging_panda(samples):
    """Return a law that has seen all joints swing at 64 Hz, and how to let them swing on."""
    law = controller_of(load_loop('panda_rigid').controller)
    q = law.reference_at(0.0)[0]

    def swing(first, after):
        for k in range(first, after):
            velocity = np.full(7, 0.1 * np.sin(0.4 * k))
            law.update(k * 1e-3, 1e-3, np.concatenate((q, velocity, np.zeros(7))))

    swing(0, samples)
    return law, swing


@pytest.mark.parametrize(('evidence', 'share'), [(1e6, 0.0), (-1e6, -1.0)])
def test_error_of_the_guess_is_between_no_rotor_and_the_guess(evidence, share):
    """Whatever the sums say: a heavier drive would need higher gains, which are not for granted."""
    law, swing = swinging_panda(199)
    law.state.rotors.sums[:2] = np.array([[evidence], [1e6]])
    swing(199, 200)
    np.testing.assert_allclose(
        law.state.rotors.error, share * law.settings.rotors.rotor, atol=1e-12
    )


@pytest.mark.parametrize('later', [-0.01, 0.0, 0.03, 0.06])
@pytest.mark.parametrize('prefix', ['', 'without.'])
def test_push_is_not_taken_for_light_drives(prefix, later):
    """A Panda whose drives are heavier than assumed, pushed by 9.4 N: error was up to 50 bounds."""
    study = load_study('monte_carlo_panda')
    plant = plant_with(study, draw(study, 325), prefix)
    assert plant.truth.rotor_factor > 1.2
    begin = tuple(moment + later for moment in plant.events.begin)
    plant = replace(plant, events=replace(plant.events, begin=begin), duration=12.0)
    run = simulate(study.laws()[prefix], plant, supervised=False).run()
    assert np.abs(run.error / run.bound).max() < 0.6
