# SPDX-License-Identifier: Apache-2.0
"""The pole of the load observer by the measured response of joint torque sensors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from blf_dsc_controller import (
    ControllerConfig,
    PlantConfig,
    change,
    share_folder,
    simulate,
)
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
from blf_dsc_controller.commissioning.commissioned import commissioned
from blf_dsc_controller.commissioning.margin import BARELY, SingularValues
from blf_dsc_controller.commissioning.observer_pole import (
    ENOUGH,
    POLES,
    RESONANT,
    ObserverPole,
    SensedLoops,
)
from blf_dsc_controller.commissioning.page import sentences
from blf_dsc_controller.commissioning.picture import draw
from blf_dsc_controller.commissioning.planned import plan
from blf_dsc_controller.commissioning.response import Sensed
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.factory.settings import settings_of_config

ROTORS = (0.3, 0.1)  # kg m^2
VISCOUS = (2.0, 1.0)  # N m s/rad
DRIVES = TorqueLoop()
POSTURE = np.array([0.3, 1.1])
LAG = 0.002  # s
ROBOT = {
    'robot.urdf': (share_folder() / 'config' / 'two_link.urdf').read_text(),
    'robot.gravity': [0.0, 0.0, 0.0],
    'robot.rotor_inertia': list(ROTORS),
    'robot.lag': LAG,
    'robot.effort': 'whole',
    'robot.torque_loop': True,
}
CONFIG = build(
    ControllerConfig, ROBOT | {'feedback.inertia': 'none', 'robot.payload': 0.1}
)
STIFF, SOFT = (2e4, 1e4), (2e3, 1e3)  # N m/rad
ARM = build(
    PlantConfig,
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


def measured(springs=STIFF):
    """Return the run of an arm with these springs, and its configuration."""
    motion = plan(CONFIG, POSTURE[None])[0]
    return simulated.measured(motion, change(ARM, {'joint.stiffness': list(springs)}))


@cache
def found(springs=STIFF):
    """Return what is found of the arm with these springs."""
    return commissioned(CONFIG, [measured(springs)])


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
    assert found(STIFF).observer.pole == POLES[-1]


def test_pole_is_the_fastest_with_the_margin():
    result = found(SOFT)
    pole, margin, *_ = result.observer
    assert margin.value >= ENOUGH
    assert margin.frequency >= RESONANT
    f = result.responses[0].frequency
    counted = result.responses[0].seen & (f >= RESONANT)
    ((value, doubt, _),) = result.sensed.singular_values(result.choice.gains, pole)
    assert value[counted].min() == margin.value
    assert (value - doubt)[counted].min() >= BARELY
    faster = dict(pairwise(POLES))[pole]
    ((value, doubt, _),) = result.sensed.singular_values(result.choice.gains, faster)
    assert value[counted].min() < ENOUGH or (value - doubt)[counted].min() < BARELY


def picked_up(springs, pole):
    """Return the run of the arm along its motion, with an r of this pole that begins at once."""
    config = change(found(springs).config, {'disturbance.observer_bandwidth': pole})
    plant = change(ARM, {'joint.stiffness': list(springs), 'duration': 6.0})
    return simulate(config, plant).run()


def test_true_arm_bears_the_chosen_pole():
    run = picked_up(SOFT, found(SOFT).observer.pole)
    assert run.stops == ()
    assert run.oscillations == ()


def sensed_loops(noise):
    """Return loops whose efforts fit the model exactly, with that noise of [E; V]."""
    result = found()
    (response,) = result.responses
    T = 1e-3
    z = np.exp(2j * np.pi * response.frequency * T)[:, None, None]
    effort = result.sensed.links[0] * (1.0 - 1.0 / z) / T @ response.velocity
    exact = result.sensed._replace(
        sensed=(Sensed(effort, noise(z, result.sensed.links[0])),), sensor_lag=0.0
    )
    return result, exact


def nothing(z, _):
    return np.zeros((len(z), 4, 4), complex)


@pytest.mark.parametrize('pole', [10.0, 300.0])
def test_observer_of_an_exact_model_changes_no_margin(pole):
    """r is zero then."""
    result, exact = sensed_loops(nothing)
    ((value, _, _),) = exact.singular_values(result.choice.gains, pole)
    ((without, _, _),) = result.loops.singular_values(result.choice.gains)
    np.testing.assert_allclose(value, without, rtol=1e-9)


def test_what_shakes_a_link_is_no_noise_of_r_but_that_of_sensors_is():
    """Ripple moves the link, which shows in efforts and velocities alike."""

    def of_links(z, model):
        of_velocity = np.concatenate(
            (
                model * (1.0 - 1.0 / z) / 1e-3,
                np.broadcast_to(np.eye(2), (len(z), 2, 2)),
            ),
            axis=1,
        )
        return 1e-4 * of_velocity @ np.swapaxes(of_velocity, 1, 2).conj()

    def of_sensors(z, model):
        both = of_links(z, model)
        return both * np.eye(4)

    doubts = []
    for noise in (nothing, of_links, of_sensors):
        result, loops = sensed_loops(noise)
        ((_, doubt, _),) = loops.singular_values(result.choice.gains, 250.0)
        doubts.append(doubt)
    np.testing.assert_allclose(doubts[1], doubts[0], rtol=1e-4, atol=1e-5)
    assert np.median(doubts[2]) > 2.0 * np.median(doubts[0])


def test_noise_of_a_run_shows_that_what_shakes_a_link_is_none():
    """Torque noise of the drives is in efforts and in velocities."""
    motion = plan(CONFIG, POSTURE[None])[0]
    shaken = change(ARM, {'actuator.torque_noise': 0.1})
    result = commissioned(CONFIG, [simulated.measured(motion, shaken)])
    f = result.responses[0].frequency
    moved = (f > 5.0) & (f < 40.0)  # where the lags of both are about equal
    gains = result.choice.gains
    ((_, without, _),) = result.loops.singular_values(gains)
    ((_, doubt, _),) = result.sensed.singular_values(gains, 250.0)
    (sensed,) = result.sensed.sensed
    apart = sensed._replace(noise=sensed.noise * np.eye(4))
    ((_, uncorrelated, _),) = result.sensed._replace(sensed=(apart,)).singular_values(
        gains, 250.0
    )
    cost = doubt - without
    assert np.median((cost / (uncorrelated - without))[moved]) < 0.5


def test_efforts_wait_for_velocities_as_those_of_the_law_do():
    settings = settings_of_config(found().config)
    assert found().sensed.sensor_lag == pytest.approx(
        settings.observer.sensor_lag, rel=1e-2
    )


@pytest.mark.parametrize(
    ('at_10_hz', 'at_40_hz', 'noise', 'is_borne'),
    [
        (BARELY, ENOUGH, 0.01, True),
        (BARELY, ENOUGH - 1e-3, 0.01, False),
        (BARELY - 1e-3, ENOUGH, 0.01, False),  # an unknown load leaves M_l / M
        (BARELY, ENOUGH, ENOUGH - BARELY - 1e-3, True),
        (BARELY, ENOUGH, ENOUGH - BARELY + 1e-3, False),
    ],
)
def test_pole_leaves_enough_and_barely_what_noise_may_take(
    monkeypatch, at_10_hz, at_40_hz, noise, is_borne
):
    result = found()
    f = np.array([4.0, 10.0, 40.0])
    values = SingularValues(
        np.array([0.0, at_10_hz, at_40_hz]),
        noise * np.ones(3),
        np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
    )
    monkeypatch.setattr(SensedLoops, 'singular_values', lambda *_: [values])
    monkeypatch.setattr(SensedLoops, 'why_no_sensors', '')
    response = result.responses[0]._replace(frequency=f, seen=np.ones(3, bool))
    sensed = result.sensed._replace(loops=result.loops._replace(responses=[response]))
    chosen = sensed.fastest_pole(result.choice.gains)
    assert chosen.pole == (POLES[-1] if is_borne else 0.0)
    assert chosen.margin == (at_40_hz, 40.0, 0, 1)
    assert chosen.noise_hides == (noise > 0.1 and not is_borne)


def judged(effort_of):
    """Return the pole that a run with other efforts gets, and why none."""
    run, config = measured()
    result = commissioned(CONFIG, [(replace(run, effort=effort_of(run)), config)])
    return result, result.observer.pole, result.observer.why_none


@pytest.mark.parametrize('late', [0, 1, 3])
def test_efforts_that_are_commands_are_not_used(late):
    result, pole, why = judged(lambda run: np.roll(run.torque, late, axis=0))
    assert (pole, why) == (0.0, 'efforts are the commands, a few samples late')
    assert result.config.disturbance.observer_bandwidth == 0.0
    assert f'NO LOAD OBSERVER: {why}. Set robot.effort' in ' '.join(sentences(result))


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


def test_posture_with_a_load_does_not_speak_against_sensors():
    """Its links are heavier than those of the model, by up to several times."""
    result = found()
    (response,) = result.responses
    loaded = result.sensed._replace(links=0.2 * result.sensed.links)
    assert loaded.why_no_sensors.startswith('efforts do not move the links: 80 %')
    both = loaded._replace(
        loops=result.loops._replace(responses=[response, response]),
        sensed=2 * loaded.sensed,
        links=np.vstack((loaded.links, result.sensed.links)),
    )
    assert both.why_no_sensors == ''


def test_parameters_have_the_pole_only_where_the_law_uses_sensors():
    name = 'disturbance.observer_bandwidth'
    assert found().parameters_but_bounds()[name] == found().observer.pole
    assert found().config.disturbance.observer_bandwidth == found().observer.pole
    off = change(CONFIG, {name: 0.0})
    run, config = measured()
    for result in (
        commissioned(off, [(run, config)]),
        commissioned(CONFIG, [(replace(run, effort=None), config)]),
        commissioned(CONFIG, [(replace(run, effort=np.nan * run.effort), config)]),
    ):
        assert result.observer is None
        assert name not in result.parameters_but_bounds()
        assert not [each for each in sentences(result) if 'load observer' in each]


def test_page_says_the_pole_and_what_limits_it():
    def said(result):
        (text,) = [
            each for each in sentences(result) if 'load observer' in each.lower()
        ]
        return text

    fast, slow = found(STIFF), found(SOFT)
    assert 'a pole of 300 rad/s' in said(fast)
    assert 'a faster one gains little' in said(fast)
    assert f'a pole of {slow.observer.pole:g} rad/s' in said(slow)
    assert f'margin of {slow.observer.margin.value:.2g} near' in said(slow)
    assert 'a faster one less than 0.25' in said(slow)
    none = slow._replace(observer=ObserverPole(0.0, slow.observer.margin))
    assert said(none).startswith('NO LOAD OBSERVER: with the slowest pole, 10 rad/s')


def test_page_says_where_noise_hides_whether_a_faster_pole_is_borne():
    slow = found(SOFT)
    for pole, what in (
        (60.0, 'noise, friction or play hide whether a faster one is borne'),
        (0.0, 'friction or play hide whether the slowest pole, 10 rad/s, is borne'),
    ):
        observer = ObserverPole(pole, slow.observer.margin, noise_hides=True)
        text = ' '.join(sentences(slow._replace(observer=observer)))
        assert what in text
        assert 'a faster one less than' not in text


def test_picture_has_a_line_with_the_observer_if_there_is_one(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        SensedLoops,
        'singular_values',
        lambda sensed, gains, pole: (
            drawn.append(pole) or sensed.loops.singular_values(gains)
        ),
    )
    slow = found(SOFT)
    none = slow._replace(observer=ObserverPole(0.0, slow.observer.margin))
    for result in (slow, none, slow._replace(sensed=None, observer=None)):
        draw(result, ['posture 1'], tmp_path / 'page.png')
    assert drawn == [slow.observer.pole]
