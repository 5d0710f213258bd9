# SPDX-License-Identifier: Apache-2.0
"""The pole of the load observer by the measured response of joint torque sensors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import blf_dsc_controller as blf
from blf_dsc_controller.arms.joint_gains import linear
from blf_dsc_controller.arms.linear_loop import (
    Joints,
    Loop,
    Timing,
    TorqueLoop,
    arm_response,
    law_response,
    low_pass,
)
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.commissioning import simulated
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.factory.settings import settings_of_config

ROTORS = (0.3, 0.1)  # kg m^2
VISCOUS = (2.0, 1.0)  # N m s/rad
DRIVES = TorqueLoop()
POSTURE = np.array([0.3, 1.1])
LAG = 0.002  # s
ROBOT = {
    'robot.urdf': (blf.share_folder() / 'config' / 'two_link.urdf').read_text(),
    'robot.gravity': [0.0, 0.0, 0.0],
    'robot.rotor_inertia': list(ROTORS),
    'robot.lag': LAG,
    'robot.effort': 'whole',
    'robot.torque_loop': True,
}
CONFIG = build(
    blf.ControllerConfig, ROBOT | {'feedback.inertia': 'none', 'robot.payload': 0.1}
)
STIFF, SOFT = (2e4, 1e4), (2e3, 1e3)  # N m/rad
ARM = build(
    blf.PlantConfig,
    ROBOT
    | {
        'truth.rotor_inertia': list(ROTORS),
        'joint.stiffness': list(STIFF),
        'disturbance.constant': [0.0, 0.0],
        'disturbance.amplitude': [0.0, 0.0],
        'disturbance.viscous': list(VISCOUS),
        'actuator.delay': 1,
        'actuator.loop_gain': DRIVES.gain,
        'actuator.loop_damping': DRIVES.damping,
        'actuator.loop_lag': DRIVES.lag,
    },
)


@cache
def measured(springs=STIFF):
    """Return the run of an arm with these springs, and its configuration."""
    motion = blf.Commissioning(CONFIG).motion(POSTURE)
    return simulated.measured(
        motion, blf.change(ARM, {'joint.stiffness': list(springs)})
    )


@cache
def found(springs=STIFF):
    """Return what is found of the arm with these springs."""
    return result_of(CONFIG, measured(springs))


def result_of(config, run):
    return blf.Commissioning(config).result([run])


def links():
    """Return the true inertias of the links (1, 2, 2), in the posture."""
    settings = settings_of_config(CONFIG)
    P = settings.initial_estimate[: settings.p]
    return inertia_matrices(settings.model, P, POSTURE[None]) - np.diag(ROTORS)


def true_loop(springs, gains, inertia):
    """Return the linear loop without r."""
    joints = Joints(
        np.array(ROTORS), np.array(VISCOUS), np.array(springs), torque_loop=DRIVES
    )
    return Loop(links(), joints, Timing(1e-3, delay=1), linear(gains, inertia, 1))


def true_singular_values(springs, pole, model, f):
    """Return the least of I + L of the linear arm with r of a `model` of its links."""
    result = found(springs)
    loop = true_loop(springs, result.choice.gains, result.loops.inertia)
    s = 2j * np.pi * f
    z = np.exp(1e-3 * s)
    (G,) = arm_response(loop.links, loop.joints, loop.timing, s)
    (C,) = law_response(loop.feedback, loop.timing, s)
    difference = ((1.0 - 1.0 / z) / 1e-3)[:, None, None]
    sensed = low_pass(np.exp(-1e-3 / result.sensed.sensor_lag), z)[:, None, None]
    # efforts are the mean of the last sample
    effort = np.exp(-5e-4 * s)[:, None, None] * links() * s[:, None, None] ** 2 @ G
    r = low_pass(np.exp(-1e-3 * pole), z)[:, None, None] * (
        sensed * effort - model * difference**2 @ G
    )
    return np.linalg.svd(np.eye(2) + C @ G - r, compute_uv=False)[:, -1]


@pytest.mark.parametrize('springs', [STIFF, SOFT])
def test_efforts_of_a_run_are_the_torque_that_moves_the_links(springs):
    """G_e = M s^2 G_y, whatever drives, motors and gears do."""
    (response,) = found(springs).responses
    s = 2j * np.pi * response.frequency[:, None, None]
    true = links() * s**2 @ response.position
    counted = (response.frequency > 5.0) & (response.frequency < 60.0)
    largest = np.abs(true).max(axis=(1, 2), keepdims=True)
    apart = np.abs(response.sensed.effort - true) / largest
    assert np.median(apart[counted]) < 0.05


@pytest.mark.parametrize('factor', [1.0, 0.5])
@pytest.mark.parametrize('pole', [60.0, 250.0])
def test_margin_with_the_observer_is_that_of_the_linear_arm(pole, factor):
    """Also where the model of the links is wrong."""
    result = found(SOFT)
    sensed = result.sensed._replace(links=factor * result.sensed.links)
    ((value, doubt, _),) = sensed.singular_values(result.choice.gains, pole)
    f = result.responses[0].frequency
    true = true_singular_values(SOFT, pole, factor * links(), f)
    counted = result.responses[0].seen & (f > 5.0) & (f < 100.0)
    assert np.median(np.abs(value - true)[counted]) < 0.05
    assert (np.abs(value - true) < doubt + 0.1)[counted].mean() > 0.75


def test_arm_whose_gears_resonate_gets_a_slower_pole():
    assert found(SOFT).observer.pole < found(STIFF).observer.pole
    assert found(STIFF).observer.pole == 200.0  # rad/s, the fastest


def picked_up(springs, pole):
    """Return the run of the arm along its motion, with an r of this pole that begins at once."""
    config = blf.change(found(springs).config, {'disturbance.observer_bandwidth': pole})
    plant = blf.change(ARM, {'joint.stiffness': list(springs), 'duration': 6.0})
    return blf.simulate(config, plant).run()


def test_true_arm_bears_the_chosen_pole():
    run = picked_up(SOFT, found(SOFT).observer.pole)
    assert run.stops == ()


def judged(effort_of):
    """Return the pole that a run with other efforts gets, and why none."""
    run, config = measured()
    result = result_of(CONFIG, (replace(run, effort=effort_of(run)), config))
    return result, result.observer.pole, result.observer.why_none


@pytest.mark.parametrize('late', [0, 1, 3])
def test_efforts_that_are_commands_are_not_used(late):
    result, pole, why = judged(lambda run: np.roll(run.torque, late, axis=0))
    assert (pole, why) == (0.0, 'efforts are the commands, a few samples late')
    assert result.config.disturbance.observer_bandwidth == 0.0


@pytest.mark.parametrize(
    'effort_of',
    [
        lambda run: -run.effort,
        lambda run: 1000.0 * run.effort,
        lambda run: 0.1 * run.effort,
        lambda run: 0.0 * run.effort,
        lambda run: run.effort[:, ::-1],
    ],
    ids=['other sign', 'N mm', 'a tenth', 'nothing', 'other joint'],
)
def test_efforts_that_do_not_move_the_links_are_not_used(effort_of):
    _, pole, why = judged(effort_of)
    assert pole == 0.0
    assert why.startswith('efforts do not move the links: ')


def test_parameters_have_the_pole_only_where_sensors_are_declared_and_read():
    """Also if nothing had proven them: then the law did not use them."""
    name = 'disturbance.observer_bandwidth'
    assert CONFIG.disturbance.observer_bandwidth == 0.0
    assert found().parameters_but_bounds()[name] == found().observer.pole
    assert found().config.disturbance.observer_bandwidth == found().observer.pole
    run, config = measured()
    for effort in (None, np.nan * run.effort):
        result = result_of(CONFIG, (replace(run, effort=effort), config))
        assert result.observer is None
        assert name not in result.parameters_but_bounds()
