# SPDX-License-Identifier: Apache-2.0
"""Arms whose drives are lighter than assumed: the gains follow what the law measures."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller import load_loop, simulate
from blf_dsc_controller.arms.tuning import over_postures
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.law.factory import controller_of, settings_of_config
from blf_dsc_controller.supervision.config_warnings import expectation
from sim_plant.plant import plant_settings

BITS_16 = 2.0 * np.pi / 2**16  # rad
NOISY = {'sensor.velocity': 'measured', 'sensor.velocity_noise': 0.005}


def ran(preset, factor, plant=None, controller=None, sample_time=0.001):
    """Run a preset without a payload for 6 s, with rotors of `factor` times the guess."""
    given = {'sample_time': sample_time}
    truth = {'truth.rotor_factor': factor, 'duration': 6.0, 'events.begin': [100.0]}
    overrides = {
        'blf_dsc_controller': given | (controller or {}),
        'sim_plant': given | truth | (plant or {}),
    }
    loop = load_loop(preset, overrides)
    return simulate(loop.controller, loop.plant)


@pytest.mark.parametrize('sample_time', [0.001, 0.002])
@pytest.mark.parametrize('factor', [0.0, 0.1, 0.4, 1.3])
def test_panda_keeps_its_bound_whatever_its_rotors_are(factor, sample_time):
    run = ran('panda', factor, sample_time=sample_time).run()
    assert not run.stops
    assert np.abs(run.error / run.bound).max() < 1.0


@pytest.mark.parametrize(
    ('preset', 'factor', 'sample_time', 'most'),
    [('ur5e', 0.2, 0.001, 1.0), ('ur5e', 0.4, 0.002, 1.0), ('fr3', 0.1, 0.001, 0.8)],
)
def test_other_arms_keep_their_bounds_with_light_rotors(preset, factor, sample_time, most):
    run = ran(preset, factor, sample_time=sample_time).run()
    assert not run.stops
    assert np.abs(run.error / run.bound).max() < most


@pytest.mark.parametrize(
    ('preset', 'joint', 'share'), [('ur5e', 'wrist_3_joint', 0.31), ('fr3', 'fr3_joint7', 0.054)]
)
def test_run_says_how_light_its_drives_may_be(preset, joint, share):
    text = expectation(load_loop(preset).controller)
    assert f'the drive of {joint} has less than {share:g} of the inertia assumed' in text
    assert ran(preset, 0.3 * share).run().stops


def test_run_says_nothing_of_drives_that_may_weigh_nothing_or_are_known():
    for preset, given in (('panda', {}), ('ur5e', {'robot.rotor_inertia': [0.5] * 6})):
        config = load_loop(preset, {'blf_dsc_controller': given}).controller
        assert 'rotor_inertia' not in expectation(config)


def test_wrist_that_its_friction_moves_more_than_its_gains_stops_with_the_reason():
    """1.1 N m of friction on 0.007 kg m^2: no gains that the delay allows hold 5 mrad."""
    (stop,) = ran('ur5e', 0.1, sample_time=0.002).run().stops
    assert 'its drive seems to have ' in stop.text
    assert 'give robot.rotor_inertia, or a wider bound' in stop.text


def test_the_guess_stops_the_same_arm_where_nothing_is_measured():
    chain = load_loop('panda').controller.robot
    guess = chain.rotors(chain.chain(load_loop('panda').controller.joints))
    given = {'robot.rotor_inertia': guess.tolist()}
    assert ran('panda', 0.1, controller=given).run().stops


@pytest.mark.parametrize('plant', [{}, {'sensor.resolution': BITS_16}, NOISY])
@pytest.mark.parametrize('factor', [1.0, 1.3])
def test_noise_is_not_mistaken_for_a_light_arm(factor, plant):
    state = ran('panda', factor, plant).controller.state
    assert (state.gain_scale == 1.0).all()
    assert (state.rotor_error == 0.0).all()


def test_measured_inertia_is_that_of_the_arm_where_the_loop_was_unstable():
    """Between the true inertia and what the loop tolerates, for each joint that was measured."""
    record = ran('panda', 0.1)
    config = record.config
    chain = config.robot.chain(config.joints)
    settings, scale = settings_of_config(config), record.controller.state.gain_scale
    rotors = settings.unsure_rotor
    limits = config.limits.position_lower, config.limits.position_upper
    parameters = parameters_of(config.robot, chain)
    P = tuple(parameters.of(chain.inertias, 0.1 * rotors))
    true = over_postures(chain, parameters, config.robot.payload, P, *limits)[0]
    ratio = scale * settings.joint_inertia / true
    measured = scale < 0.6
    assert measured.sum() >= 3
    assert (ratio[measured] > 0.7).all()
    assert (ratio[measured] < 2.0).all()


def test_integrator_takes_as_many_steps_as_friction_on_a_light_joint_needs():
    steps = [
        plant_settings(load_loop('ur5e', {'sim_plant': {'truth.rotor_factor': factor}}).plant).steps
        for factor in (1.3, 0.1)
    ]
    assert steps[0] == 1
    assert steps[1] > 5


@pytest.mark.parametrize(('evidence', 'share'), [(1e6, 0.0), (-1e6, -1.0)])
def test_error_of_the_guess_is_between_no_rotor_and_the_guess(evidence, share):
    """Whatever the sums say: a heavier drive would need higher gains, which are not for granted."""
    law = controller_of(load_loop('panda').controller)
    q = law.reference_at(0.0)[0]
    for k in range(200):
        swing = np.full(7, 0.1 * np.sin(0.4 * k))  # 64 Hz
        if k == 199:
            law.state.rotor_sums[:] = np.array([[evidence], [1e6]])
        law.update(k * 1e-3, 1e-3, np.concatenate((q, swing, np.zeros(7))))
    np.testing.assert_allclose(law.state.rotor_error, share * law.settings.unsure_rotor, atol=1e-12)
