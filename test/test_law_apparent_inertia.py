# SPDX-License-Identifier: Apache-2.0
"""Arms whose drives are lighter than assumed: the gains follow what the law measures."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller import load_loop, simulate
from blf_dsc_controller.arms.tuning import over_postures
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.law.factory import controller_of
from sim_plant.plant import plant_settings

NOISY = {'sensor.velocity': 'measured', 'sensor.velocity_noise': 0.005}


def ran(preset, factor, plant=None, controller=None, sample_time=0.001):
    """Run a preset without a payload for 6 s, with rotors of `factor` times the guess."""
    given = {'sample_time': sample_time}
    truth = {'truth.rotor_factor': factor, 'duration': 6.0, 'events.begin': [100.0]}
    law, arm = given | (controller or {}), given | truth | (plant or {})
    loop = load_loop(preset, {'blf_dsc_controller': law, 'sim_plant': arm})
    return simulate(loop.controller, loop.plant)


PANDA = [('panda', factor, period) for factor in (0.0, 0.1, 0.4, 1.3) for period in (0.001, 0.002)]
OTHERS = [('ur5e', 0.2, 0.001), ('ur5e', 0.4, 0.002), ('fr3', 0.1, 0.001)]


@pytest.mark.parametrize(('preset', 'factor', 'sample_time'), [*PANDA, *OTHERS])
def test_arm_keeps_its_bound_whatever_its_rotors_are(preset, factor, sample_time):
    """A UR5e from 0.2 of the guess on, or 0.4."""
    run = ran(preset, factor, sample_time=sample_time).run()
    assert not run.stops
    assert np.abs(run.error / run.bound).max() < (0.8 if preset == 'fr3' else 1.0)


def test_wrist_that_its_friction_moves_more_than_its_gains_stops_with_the_reason():
    """1.1 N m of friction on 0.007 kg m^2: no gains that the delay allows hold 5 mrad."""
    (stop,) = ran('ur5e', 0.1, sample_time=0.002).run().stops
    assert 'its drive seems to have ' in stop.text
    assert 'give robot.rotor_inertia, or a wider bound' in stop.text


def test_the_guess_stops_the_same_arm_where_nothing_is_measured():
    config = load_loop('panda').controller
    guess = config.robot.rotors(config.robot.chain(config.joints))
    assert ran('panda', 0.1, controller={'robot.rotor_inertia': guess.tolist()}).run().stops


@pytest.mark.parametrize('plant', [{}, {'sensor.resolution': 2.0 * np.pi / 2**16}, NOISY])
@pytest.mark.parametrize('factor', [1.0, 1.3])
def test_noise_is_not_mistaken_for_a_light_arm(factor, plant):
    state = ran('panda', factor, plant).controller.state
    assert (state.gain_scale == 1.0).all()
    assert (state.rotor_error == 0.0).all()


def test_measured_inertia_is_that_of_the_arm_where_the_loop_was_unstable():
    """Between the true inertia and what the loop tolerates, for each joint that was measured."""
    record = ran('panda', 0.1)
    config, settings = record.config, record.controller.settings
    robot, chain = config.robot, config.robot.chain(config.joints)
    limits = config.limits.position_lower, config.limits.position_upper
    base, scale = parameters_of(robot, chain), record.controller.state.gain_scale
    P = tuple(base.of(chain.inertias, 0.1 * settings.unsure_rotor))
    true = over_postures(chain, base, robot.payload, P, *limits)[0]
    measured = scale < 0.6
    ratio = (scale * settings.joint_inertia / true)[measured]
    assert ratio.size >= 3
    assert ratio.min() > 0.7
    assert ratio.max() < 2.0


def test_integrator_takes_as_many_steps_as_friction_on_a_light_joint_needs():
    for factor, fewest, most in ((1.3, 1, 1), (0.1, 6, 1000)):
        loop = load_loop('ur5e', {'sim_plant': {'truth.rotor_factor': factor}})
        assert fewest <= plant_settings(loop.plant).steps <= most


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
