# SPDX-License-Identifier: Apache-2.0
"""Gains of elastic joints: how they are given, what is refused, and what is warned of."""

from __future__ import annotations

import re

import numpy as np
import pytest
from nights import at_night

from blf_dsc_controller import (
    ConfigurationError,
    ControllerConfig,
    StartError,
    change,
    load_loop,
    simulate,
)
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.factory.gains import law_gains
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.warnings.table import config_warnings, worsened

UR5E = {'robot.urdf': 'ur5e.urdf', 'robot.tip': 'tool0'}
GAINS = {
    'feedback.joint_stiffness': [900.0] * 3 + [240.0] * 3,
    'feedback.joint_damping': [60.0] * 3 + [16.0] * 3,
}
GEARS = {
    'robot.joint_stiffness': [3e4] * 6,
    'robot.rotor_inertia': [1.9] * 3 + [0.35] * 3,
}


def built(**changes):
    return build(ControllerConfig, UR5E | changes)


def test_an_arm_of_which_nothing_is_known_is_held_softly_and_says_so():
    config = built()
    assert config.feedback.inertia == 'none'
    # 21 1/s times the guess of the motors, effort / 400 rad/s^2 of 150 and 28 N m
    np.testing.assert_allclose(law_gains(config).feedback, [7.875] * 3 + [1.47] * 3)
    (warning,) = (text for text in config_warnings(config) if 'softly' in text)
    assert warning.startswith('feedback.joint_stiffness: nothing is known of the gears')


def test_an_arm_of_which_nothing_is_known_begins_its_motion():
    """A UR5e with 9 N m of friction at rest, of which its file says nothing."""
    loop = load_loop('ur5e')
    moves = {
        f'reference.{name}': value
        for name, value in vars(loop.controller.reference).items()
        if name in ('type', 'offset', 'amplitude', 'frequency', 'phase')
    }
    plant = change(loop.plant, {'duration': 6.0})
    run = simulate(built(**moves), plant).run()
    assert not run.stops
    assert not run.oscillations


@pytest.mark.parametrize(
    ('changes', 'problem'),
    [
        ({'feedback.joint_damping': [60.0] * 6}, 'one of them is given'),
        (
            GAINS | {'feedback.inertia': 'whole'},
            'only for a URDF with feedback.inertia none, but got whole',
        ),
        (
            {'feedback.inertia': 'whole', 'feedback.stiffness': 2.0},
            'feedback.stiffness: got 2 with feedback.inertia whole',
        ),
        (
            {
                'feedback.inertia': 'whole',
                'feedback.joint_damping_lag': [0.0, 0.005, 0.0, 0.0, 0.0, 0.0],
            },
            'feedback.joint_damping_lag: got 0.005 s with feedback.inertia whole',
        ),
        (
            {'feedback.joint_damping_lag': [0.003]},
            'feedback.joint_damping_lag: got 1, but 6 entries are needed',
        ),
        (
            GAINS | {'feedback.joint_damping': [60.0] * 5 + [0.0]},
            'got 0 for a joint, but each must be above 0',
        ),
    ],
)
def test_gains_that_contradict_each_other_are_refused(changes, problem):
    with pytest.raises(ConfigurationError, match=problem.replace('(', r'\(')):
        built(**changes)


def test_known_gears_choose_the_gains_and_bear_them():
    unknown, known = built(), built(**GEARS)
    assert law_gains(known).feedback[0] > 2.0 * law_gains(unknown).feedback[0]
    assert not [text for text in config_warnings(known) if 'joint_stiffness' in text]


def of_readme(stiffness, damping, **changes):
    """Return the UR5e of README's file with gains of its shoulder; a quarter at the wrist."""
    gains = {
        'feedback.joint_stiffness': [stiffness] * 3 + [stiffness / 4] * 3,
        'feedback.joint_damping': [damping] * 3 + [damping / 4] * 3,
    }
    return built(**gains, **changes)


def said_of(config):
    """Return what is said of gains that are too high, by their warning or refusal."""
    try:
        found = config_warnings(config)
    except StartError as error:
        return f'refused: {error}'
    return next((text for text in found if 'grow from' in text or 'rings' in text), '')


@pytest.mark.parametrize(
    ('config', 'said'),
    [
        (of_readme(900.0, 60.0), ''),
        # spectral radius 1.0142 if drives are as guessed, 0.996 if they are 7 times as heavy
        (of_readme(2700.0, 100.0), 'feedback.stiffness: '),
        (of_readme(9000.0, 200.0), 'feedback.stiffness: '),
        (of_readme(9000.0, 60.0), 'refused: '),  # 1.051 and 1.0055
        (
            built(**GEARS, **GAINS, **{'feedback.stiffness': 4.0}),
            'feedback.stiffness: ',
        ),
        (of_readme(9000.0, 200.0, **{'robot.rotor_inertia': [0.375] * 6}), 'refused: '),
    ],
)
def test_gains_that_are_too_high_are_named_with_joint_frequency_and_what_holds(
    config, said
):
    text = said_of(config)
    assert text.startswith(said)
    assert bool(text) == bool(said)
    if not text:
        return
    assert re.search(r'_joint oscillates at \d+ Hz', text)
    given = {
        f'feedback.joint_{name}': [float(each) for each in values.split(', ')]
        for name, values in re.findall(r'feedback.joint_(\w+): \[(.*?)\]', text)
    }
    assert given
    robot = {
        f'robot.{name}': getattr(config.robot, name)
        for name in ('rotor_inertia', 'joint_stiffness')
    }
    assert said_of(built(**robot, **given)) == ''


def test_gains_that_no_arm_bears_are_not_simulated_unless_they_are_insisted_on():
    plant = load_loop('ur5e', {'sim_plant': {'duration': 0.01}}).plant
    with pytest.raises(StartError, match=r'list feedback\.stiffness in insist'):
        simulate(of_readme(9000.0, 60.0), plant)
    insisted = of_readme(9000.0, 60.0, insist=['feedback.stiffness'])
    assert simulate(insisted, plant).run().time.size


@pytest.mark.parametrize(
    ('before', 'after', 'said'),
    [
        ({}, {'feedback.stiffness': 1.1}, ''),
        ({}, {'feedback.stiffness': 4.0}, 'oscillates at'),
        ({'feedback.stiffness': 4.0}, {'feedback.stiffness': 3.9}, ''),
        ({'feedback.stiffness': 4.0}, {'feedback.stiffness': 5.0}, 'oscillates at'),
        (
            {},
            {'feedback.joint_stiffness': [9000.0] * 3 + [2250.0] * 3},
            'list feedback.stiffness in insist',
        ),
    ],
)
def test_other_gains_of_a_running_law_make_no_loop_unstable(before, after, said):
    """Gains of a file with a warning may be changed back."""
    running = built(**GAINS, **before)
    found = worsened(running, change(running, after))
    assert bool(found) == bool(said)
    assert not said or any(said in text for text in found)


def test_adaptation_integrates_no_faster_than_the_disturbance_estimate():
    """Gamma times the variance of the gravity torque is at most gamma of each joint."""
    config = built(**GAINS)
    settings = settings_of_config(config)
    L = np.linalg.cholesky(np.linalg.inv(settings.information)[:40, :40])
    H = np.zeros((6, settings.p))
    q = np.zeros(6)
    settings.model.regressor(q, q, q, q, H)
    variance = ((H @ L[: settings.p, : settings.p]) ** 2).sum(axis=1)
    Gamma = settings.adaptation.adaptation_gain[0]
    assert (Gamma * variance <= 1.01 * settings.disturbance.gain).all()


@pytest.mark.parametrize(
    ('preset', 'changes', 'moving', 'picked'),
    [
        ('fr3_direct', {'joint.stiffness': [1e4] * 7}, 1.0, 25.0),
        ('ur5e', {'sensor.side': 'motor', 'joint.stiffness': [1e4] * 6}, 5.0, 15.0),
        *at_night(('fr3_direct', {}, 1.0, 25.0), ('ur5e', {}, 5.0, 15.0)),
    ],
)
def test_gains_of_the_presets_hold_on_elastic_joints(preset, changes, moving, picked):
    """With encoders on either side; 2 kg are picked up in motion [mrad].

    Without the integral, 2 kg at 0.7 m on 600 N m/rad are 23 mrad; friction of 6 N m on
    900 N m/rad is 7 mrad.
    """
    events = {
        'events.begin': [8.0],
        'events.duration': [0.0],
        'events.payload': [2.0],
    }
    loop = load_loop(preset, {'sim_plant': {'duration': 13.0, **events, **changes}})
    run = simulate(loop.controller, loop.plant).run()
    assert not run.stops
    error = 1e3 * np.abs(np.asarray(run.error)).max(axis=1)
    assert error[(run.time > 5.0) & (run.time < 8.0)].max() < moving
    assert error.max() < picked
    assert error[run.time > 11.0].max() < 1.5 * moving


def test_gains_of_rigid_gears_shake_an_elastic_arm():
    given = {'duration': 2.0, 'joint.stiffness': [1e4] * 7}
    rigid = {
        'feedback.inertia': 'whole',
        'feedback.joint_stiffness': None,
        'feedback.joint_damping': None,
    }
    loop = load_loop('fr3_direct', {'sim_plant': given, 'blf_dsc_controller': rigid})
    run = simulate(loop.controller, loop.plant).run()
    assert run.stops
